// The contact solver on a CPU. Each iteration is a pass over vectors of contacts, then one over vectors of bodies.
//
// The impulse of a contact is computed once and written to two records, one in the list of each body. A body sums up
// its own records in a fixed order.
#pragma once
#include "contacts/solve_arrays.h"

#if !defined(__CUDA_ARCH__)
namespace warpmag {

inline int rounded(int count) { return (count + WIDTH - 1) / WIDTH * WIDTH; }

// Numbers of contacts, movable bodies and lines in the solve; ``frictional`` is true if any contact has friction.
struct Lists {
    int contacts, bodies, lines;
    bool frictional;
};
// Lists the contacts that can move a body, assigns lines to bodies and counts the sides of each body, in one thread.
inline Lists list_contacts(const Arrays& a) {
    Lists lists = {0, 0, 0, false};
    for (int b = 0; b < a.body_count; ++b) a.side_count[b] = 0, a.slot[b] = -1;
    for (int c = 0, count = a.contact_count(); c < count; ++c) {
        int ends[2];
        if (!find_bodies(a, c, ends)) continue;
        a.entry[lists.contacts++] = c;
        lists.frictional |= a.has_friction(c);
        for (int end = 0; end < 2; ++end) {
            if (ends[end] < 0) continue;
            if (a.movable(ends[end])) ++a.side_count[ends[end]];
            else a.slot[ends[end]] = 0;
        }
    }
    int sides = 0;
    for (int b = 0; b < a.body_count; ++b) {
        if (a.side_count[b] == 0) continue;
        a.range[2 * lists.bodies] = a.range[2 * lists.bodies + 1] = sides;
        sides += a.side_count[b];
        a.body[a.slot[b] = lists.bodies++] = b;
    }
    lists.lines = rounded(lists.bodies);
    for (int i = lists.bodies; i < lists.lines; ++i) a.body[i] = -1, a.range[2 * i] = a.range[2 * i + 1] = 0;
    for (int b = 0; b < a.body_count; ++b)
        if (a.slot[b] == 0 && !a.movable(b)) a.body[a.slot[b] = lists.lines++] = b;
    for (const int end = rounded(lists.lines); lists.lines < end; ++lists.lines) a.body[lists.lines] = -1;
    return lists;
}

// Writes the listed contacts in vectors, with the second body as own body. The last vector is padded with open
// contacts, which receive no impulse.
inline void write_contacts(const Arrays& a, const Lists& lists) {
    for (int k = 0; k < rounded(lists.contacts); ++k) {
        Real* const contact = rows_at(a.side, CONTACT_SIZE, k);
        int* const other = list_at(a.other, 4, 0, k);
        for (int end = 0; end < 2; ++end) {
            other[end * CHUNK] = a.line_count - 1;
            other[(2 + end) * CHUNK] = 2 * a.contact_max + k / WIDTH; // record of an immovable body
        }
        for (int r = 0; r < IMPULSE_SIZE; ++r) rows_at(a.impulse, IMPULSE_SIZE, k)[r * CHUNK] = 0;
        a.records_zero[k / WIDTH] = 0;
        if (k >= lists.contacts) {
            for (int r = 0; r < CONTACT_SIZE; ++r) contact[r * CHUNK] = r == 3 ? -1 : 0;
            continue;
        }
        write_detected(a, a.entry[k], 1, contact, CHUNK);
        int ends[2];
        find_bodies(a, a.entry[k], ends);
        for (int end = 0; end < 2; ++end) {
            other[end * CHUNK] = a.line_of_body(ends[end]);
            if (a.movable(ends[end])) other[(2 + end) * CHUNK] = a.range[2 * a.slot[ends[end]] + 1]++;
        }
    }
}

// Writes four numbers of each contact to one half of the records at ``places``.
template <int FIRST> inline void write_halves(Real* half, const int* places, Number row) {
    const Quarter q = __builtin_shufflevector(row, row, FIRST, FIRST + 1, FIRST + 2, FIRST + 3);
    memcpy(half + RECORD_SIZE * (size_t)places[FIRST], &q, sizeof(q));
    if constexpr (FIRST + 4 < WIDTH) write_halves<FIRST + 4>(half, places, row);
}
inline void write_record_half(const Arrays& a, const int* places, int half, Vector v) {
    const Number zero = 0;
    const Four rows = transposed(v.x, v.y, v.z, zero);
    const Number row[4] = {rows.x, rows.y, rows.z, rows.w};
    for (int r = 0; r < 4; ++r) write_halves<0>(a.record + 4 * half, places + r, row[r]);
}
// Writes the impulses and angular impulses of a vector of contacts to the records of both bodies.
inline void write_records(const Arrays& a, int k, Vector linear, Vector own_angular, Vector other_angular) {
    const int* const places = list_at(a.other, 4, 2, k);
    write_record_half(a, places, 0, -linear);
    write_record_half(a, places, 1, other_angular);
    write_record_half(a, places + CHUNK, 0, linear);
    write_record_half(a, places + CHUNK, 1, own_angular);
}

// Bodies of a vector of contacts, and their lines.
struct Pair {
    Body own, other;
    const int *own_line, *other_line;
};
inline auto fours_at(const Real* lines, const int* j) {
    return [=](int quarter) { return four_at(lines, quarter, j); };
}
inline Pair pair_at(const Arrays& a, int k) {
    const int* const lines = list_at(a.other, 4, 0, k);
    return {read_body(fours_at(a.motion, lines + CHUNK)), read_body(fours_at(a.motion, lines)), lines + CHUNK, lines};
}
// Functions that read and write four rows of CHUNK, as lines are read by quarters.
inline auto rows_of(Real* rows) {
    return [=](int q) {
        auto row = [=](int r) { return numbers(rows + (4 * q + r) * CHUNK); };
        return Four{row(0), row(1), row(2), row(3)};
    };
}
inline auto put_rows(Real* rows) {
    return [=](int q, Four f) {
        const Number row[4] = {f.x, f.y, f.z, f.w};
        for (int r = 0; r < 4; ++r) put(rows + (4 * q + r) * CHUNK, row[r]);
    };
}

// Prepares a vector of contacts for the iterations, with the slip kept from the last substep.
inline void prepare_contacts(const Arrays& a, int k, const Lists& lists, Real relaxation, Real dt) {
    const Pair p = pair_at(a, k);
    Real *const rows = rows_at(a.side, CONTACT_SIZE, k), *const return_velocity =
                                                             rows_at(a.return_velocity, RETURN_SIZE, k);
    Slip slip = {};
    if (lists.frictional) {
        for (int l = 0; l < WIDTH; ++l) {
            Real kept_slip[6] = {};
            if (k + l < lists.contacts) read_kept_slip(a, a.entry[k + l], kept_slip);
            for (int r = 0; r < 6; ++r) return_velocity[r * CHUNK + l] = kept_slip[r];
        }
        slip = read_slip(rows_of(return_velocity));
    }
    auto inertia = [&](const int* line) { return read_inertia(fours_at(a.motion, line)); };
    auto pose = [&](const int* line) { return read_pose(fours_at(a.pose, line)); };
    const Contact c = prepare_contact(read_detected(rows_of(rows)), pose(p.own_line), pose(p.other_line), p.own,
                                      p.other, inertia(p.own_line), inertia(p.other_line), slip, relaxation, dt);
    write_contact(c, put_rows(rows));
    if (lists.frictional) write_slip(c.return_velocity, put_rows(return_velocity));
}

inline Contact contacts_at(const Arrays& a, int k, bool frictional) {
    Slip return_velocity = {};
    if (frictional) return_velocity = read_slip(rows_of(rows_at(a.return_velocity, RETURN_SIZE, k)));
    return read_contact(rows_of(rows_at(a.side, CONTACT_SIZE, k)), return_velocity);
}

// Performs an iteration of a vector of contacts.
inline void iterate_contacts(const Arrays& a, int k, bool frictional, Real momentum) {
    const Pair p = pair_at(a, k);
    const Contact c = contacts_at(a, k, frictional);
    Real* const rows = rows_at(a.impulse, IMPULSE_SIZE, k);
    AccumulatedImpulse impulse = read_impulse(rows_of(rows));
    const Impulse added = iterate_contact(c, p.own, p.other, impulse, momentum);
    // after an iteration that added nothing, the records are zero and need not be written again
    int& zero = a.records_zero[k / WIDTH];
    const bool adds = any(dot(added.linear, added.linear) + dot(added.angular, added.angular) != 0);
    write_impulse(impulse, put_rows(rows));
    if (!adds && zero) return;
    zero = !adds;
    write_records(a, k, added.linear, own_angular_impulse(c, added), other_angular_impulse(c, added));
}

// Adds the impulses of an iteration to the bodies of a vector of lines.
inline void move_bodies(const Arrays& a, int i) {
    typedef Real Record __attribute__((ext_vector_type(RECORD_SIZE)));
    Real totals[WIDTH * LINE];
    for (int l = 0; l < WIDTH; ++l) {
        const int begin = a.range[2 * (i + l)], end = a.range[2 * (i + l) + 1];
        Record total = 0;
        for (int k = begin; k < end; ++k) {
            Record record;
            memcpy(&record, a.record + RECORD_SIZE * (size_t)k, sizeof(record));
            total += record;
        }
        memcpy(totals + LINE * l, &total, sizeof(total));
    }
    const Four linear = own_four(totals, 0, 0), angular = own_four(totals, 1, 0);
    auto motion = [&](int quarter) { return own_four(a.motion, quarter, i); };
    Body body = read_body(motion);
    apply_impulse(body, read_inertia(motion), {linear.x, linear.y, linear.z}, {angular.x, angular.y, angular.z});
    write_body(a.motion, i, body);
}

// Keeps the accumulated slip of a vector of contacts for the next substep.
inline void keep_slips(const Arrays& a, int k, const Lists& lists, Real relaxation, Real dt) {
    const Pair p = pair_at(a, k);
    const Impulse last = read_impulse(rows_of(rows_at(a.impulse, IMPULSE_SIZE, k))).last;
    const Slip slip = accumulated_slip(contacts_at(a, k, true), p.own, p.other, last, relaxation, dt);
    Real rows[RETURN_SIZE * CHUNK];
    write_slip(slip, put_rows(rows));
    for (int l = 0; l < WIDTH && k + l < lists.contacts; ++l)
        for (int end = 0; end < 2; ++end) {
            const int place = list_at(a.other, 4, 2 + end, k)[l];
            if (place >= 2 * a.contact_max) continue;
            Real own_slip[6];
            for (int r = 0; r < 6; ++r) own_slip[r] = end == 1 ? rows[r * CHUNK + l] : -rows[r * CHUNK + l];
            keep_slip(a, place, a.entry[k + l], own_slip);
        }
}
inline void keep_ranges(const Arrays& a, const Lists& lists) {
    for (int b = 0; b < a.body_count; ++b) {
        const bool kept = lists.frictional && a.side_count[b] > 0;
        const int* const range = a.range + (kept ? 2 * a.slot[b] : 0);
        keep_range(a, b, kept ? range[0] : 0, kept ? range[1] : 0);
    }
}

// Solves all contacts of a substep, with up to ``threads`` threads.
inline void solve_contacts(const Arrays& a, int iterations, Real relaxation, Real dt, int threads, Word* team) {
    const Lists lists = list_contacts(a);
    if (lists.contacts == 0) return keep_ranges(a, lists);
    write_contacts(a, lists);
    for (int i = 0; i < lists.lines; i += WIDTH) load_lines(a, i);
    load_lines(a, a.line_count - WIDTH);
    const int useful = lists.contacts / CONTACTS_PER_THREAD;
    threads = useful < 1 ? 1 : useful < threads ? useful : threads;
    const int passes = 2 * iterations, all = passes + lists.frictional;
    for (int first = 0; first < all; first += MOST_PASSES) {
        const int last = all - first < MOST_PASSES ? all - first : MOST_PASSES;
        auto items = [&](int pass) { return pass % 2 == 0 ? lists.contacts : lists.bodies; };
        run_passes(team, threads, 0, last, items, WIDTH, [&](int pass, int i) {
            if (first + pass == 0) prepare_contacts(a, i, lists, relaxation, dt);
            if (pass % 2 == 1) move_bodies(a, i);
            else if (first + pass == passes) keep_slips(a, i, lists, relaxation, dt);
            else iterate_contacts(a, i, lists.frictional, momentum_at((first + pass) / 2, iterations));
        });
    }
    for (int i = 0; i < lists.bodies; i += WIDTH) {
        const Body body = read_body([&](int quarter) { return own_four(a.motion, quarter, i); });
        store_velocities(a, body, i, lists.bodies - i);
    }
    keep_ranges(a, lists);
}
}
#endif
