// The contact solve on a CPU: a pass over vectors of contacts, then one over vectors of bodies, in each iteration.
//
// A contact's impulses on its two bodies are computed once, and written to a record among those of each body.
#pragma once
#include "contacts/solve_arrays.h"

#if !defined(__CUDA_ARCH__)
namespace warpmag {

inline int rounded(int count) { return (count + WIDTH - 1) / WIDTH * WIDTH; }

// What one thread finds out: how many contacts and bodies take part, where each has its place, and whether any sticks.
struct Lists {
    int contacts, bodies, lines;
    bool sticking;
};
inline Lists list_contacts(const Arrays& a) {
    Lists lists = {0, 0, 0, false};
    for (int b = 0; b < a.bodies; ++b) a.side_count[b] = 0, a.slot[b] = -1;
    for (int c = 0, found = a.found(); c < found; ++c) {
        int ends[2];
        if (!ends_of(a, c, ends)) continue;
        a.entry[lists.contacts++] = c;
        lists.sticking |= a.sticks(c);
        for (int end = 0; end < 2; ++end) {
            if (ends[end] < 0) continue;
            if (a.movable(ends[end])) ++a.side_count[ends[end]];
            else a.slot[ends[end]] = 0;
        }
    }
    int sides = 0;
    for (int b = 0; b < a.bodies; ++b) {
        if (a.side_count[b] == 0) continue;
        a.range[2 * lists.bodies] = a.range[2 * lists.bodies + 1] = sides;
        sides += a.side_count[b];
        a.body[a.slot[b] = lists.bodies++] = b;
    }
    lists.lines = rounded(lists.bodies);
    for (int i = lists.bodies; i < lists.lines; ++i) a.body[i] = -1, a.range[2 * i] = a.range[2 * i + 1] = 0;
    for (int b = 0; b < a.bodies; ++b)
        if (a.slot[b] == 0 && !a.movable(b)) a.body[a.slot[b] = lists.lines++] = b;
    for (const int end = rounded(lists.lines); lists.lines < end; ++lists.lines) a.body[lists.lines] = -1;
    return lists;
}

// Puts down the contacts that take part, as their second bodies see them, in vectors; the last is filled up with
// contacts that are never closed.
inline void write_contacts(const Arrays& a, const Lists& lists) {
    for (int k = 0; k < rounded(lists.contacts); ++k) {
        Real* const place = rows_at(a.side, TOUCH, k);
        int* const other = list_at(a.other, 4, 0, k);
        for (int end = 0; end < 2; ++end) {
            other[end * CHUNK] = a.lines - 1;
            other[(2 + end) * CHUNK] = 2 * a.contact_max + k / WIDTH; // of nothing that moves
        }
        for (int r = 0; r < GIVEN; ++r) rows_at(a.given, GIVEN, k)[r * CHUNK] = 0;
        a.wide[k / WIDTH] = 0;
        if (k >= lists.contacts) {
            for (int r = 0; r < TOUCH; ++r) place[r * CHUNK] = r == 3 ? -1 : 0;
            continue;
        }
        put_touch(a, a.entry[k], 1, place, CHUNK);
        int ends[2];
        ends_of(a, a.entry[k], ends);
        for (int end = 0; end < 2; ++end) {
            other[end * CHUNK] = a.line_of(ends[end]);
            if (a.movable(ends[end])) other[(2 + end) * CHUNK] = a.range[2 * a.slot[ends[end]] + 1]++;
        }
    }
}

// Puts four numbers of each contact into one half of the records that ``places`` are.
template <int FIRST> inline void put_halves(Real* half, const int* places, Number row) {
    const Quarter q = __builtin_shufflevector(row, row, FIRST, FIRST + 1, FIRST + 2, FIRST + 3);
    memcpy(half + RECORD * (size_t)places[FIRST], &q, sizeof(q));
    if constexpr (FIRST + 4 < WIDTH) put_halves<FIRST + 4>(half, places, row);
}
inline void put_vector(const Arrays& a, const int* places, int half, Vector v) {
    const Number none = 0;
    const Four rows = transposed(v.x, v.y, v.z, none);
    const Number row[4] = {rows.x, rows.y, rows.z, rows.w};
    for (int r = 0; r < 4; ++r) put_halves<0>(a.record + 4 * half, places + r, row[r]);
}
// Writes the impulses of a vector of contacts on their second and first bodies into the records of these.
inline void put_records(const Arrays& a, int k, Vector linear, Vector own, Vector other) {
    const int* const places = list_at(a.other, 4, 2, k);
    put_vector(a, places, 0, -linear);
    put_vector(a, places, 1, other);
    put_vector(a, places + CHUNK, 0, linear);
    put_vector(a, places + CHUNK, 1, own);
}

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
// Reads and writes rows by four.
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

// Prepares contacts of a vector, which have slipped as far as was kept.
inline void prepare_contacts(const Arrays& a, int k, const Lists& lists, Real relaxation, Real dt) {
    const Pair p = pair_at(a, k);
    Real *const rows = rows_at(a.side, TOUCH, k), *const back = rows_at(a.back, BACK, k);
    Slip slipped = {};
    if (lists.sticking) {
        for (int l = 0; l < WIDTH; ++l) {
            Real its[6] = {};
            if (k + l < lists.contacts) slipped_before(a, a.entry[k + l], its);
            for (int r = 0; r < 6; ++r) back[r * CHUNK + l] = its[r];
        }
        slipped = read_slip(rows_of(back));
    }
    auto inertia = [&](const int* line) { return read_inertia(fours_at(a.motion, line)); };
    auto pose = [&](const int* line) { return read_pose(fours_at(a.pose, line)); };
    const Contact c = prepared(read_touch(rows_of(rows)), pose(p.own_line), pose(p.other_line), p.own, p.other,
                               inertia(p.own_line), inertia(p.other_line), slipped, relaxation, dt);
    put_contact(c, put_rows(rows));
    if (lists.sticking) put_slip(c.back, put_rows(back));
}

inline Contact contacts_at(const Arrays& a, int k, bool sticking) {
    Slip back = {};
    if (sticking) back = read_slip(rows_of(rows_at(a.back, BACK, k)));
    return read_contact(rows_of(rows_at(a.side, TOUCH, k)), back);
}

inline void press_contacts(const Arrays& a, int k, bool sticking, Real momentum) {
    const Pair p = pair_at(a, k);
    const Contact c = contacts_at(a, k, sticking);
    Real* const rows = rows_at(a.given, GIVEN, k);
    Given given = read_given(rows_of(rows));
    const Impulse added = press(c, p.own, p.other, given, momentum);
    // what was written in an iteration that added nothing still holds
    int& quiet = a.wide[k / WIDTH];
    const bool adds = any(dot(added.linear, added.linear) + dot(added.turn, added.turn) != 0);
    put_given(given, put_rows(rows));
    if (!adds && quiet) return;
    quiet = !adds;
    put_records(a, k, added.linear, on_own(c, added), on_other(c, added));
}

inline void move_bodies(const Arrays& a, int i) {
    typedef Real Record __attribute__((ext_vector_type(RECORD)));
    Real totals[WIDTH * LINE];
    for (int l = 0; l < WIDTH; ++l) {
        const int begin = a.range[2 * (i + l)], end = a.range[2 * (i + l) + 1];
        Record total = 0;
        for (int k = begin; k < end; ++k) {
            Record one;
            memcpy(&one, a.record + RECORD * (size_t)k, sizeof(one));
            total += one;
        }
        memcpy(totals + LINE * l, &total, sizeof(total));
    }
    const Four linear = own_four(totals, 0, 0), angular = own_four(totals, 1, 0);
    auto motion = [&](int quarter) { return own_four(a.motion, quarter, i); };
    Body body = read_body(motion);
    apply(body, read_inertia(motion), {linear.x, linear.y, linear.z}, {angular.x, angular.y, angular.z});
    put_body(a.motion, i, body);
}

// Keeps how far a vector of contacts has slipped, for the next substep.
inline void keep_contacts(const Arrays& a, int k, const Lists& lists, Real relaxation, Real dt) {
    const Pair p = pair_at(a, k);
    const Impulse last = read_given(rows_of(rows_at(a.given, GIVEN, k))).last;
    const Slip slipped = slipped_so_far(contacts_at(a, k, true), p.own, p.other, last, relaxation, dt);
    Real rows[BACK * CHUNK];
    put_slip(slipped, put_rows(rows));
    for (int l = 0; l < WIDTH && k + l < lists.contacts; ++l)
        for (int end = 0; end < 2; ++end) {
            const int place = list_at(a.other, 4, 2 + end, k)[l];
            if (place >= 2 * a.contact_max) continue;
            Real its[6];
            for (int r = 0; r < 6; ++r) its[r] = end == 1 ? rows[r * CHUNK + l] : -rows[r * CHUNK + l];
            keep(a, place, a.entry[k + l], its);
        }
}
inline void keep_ranges(const Arrays& a, const Lists& lists) {
    for (int b = 0; b < a.bodies; ++b) {
        const bool some = lists.sticking && a.side_count[b] > 0;
        const int* const range = a.range + (some ? 2 * a.slot[b] : 0);
        keep_range(a, b, some ? range[0] : 0, some ? range[1] : 0);
    }
}

inline void solve_contacts(const Arrays& a, int iterations, Real relaxation, Real dt, int threads, Word* team) {
    const Lists lists = list_contacts(a);
    if (lists.contacts == 0) return keep_ranges(a, lists);
    write_contacts(a, lists);
    for (int i = 0; i < lists.lines; i += WIDTH) begin_lines(a, i);
    begin_lines(a, a.lines - WIDTH);
    const int helpful = lists.contacts / CONTACTS_PER_THREAD;
    threads = helpful < 1 ? 1 : helpful < threads ? helpful : threads;
    const int passes = 2 * iterations, all = passes + lists.sticking;
    for (int first = 0; first < all; first += MOST_PASSES) {
        const int last = all - first < MOST_PASSES ? all - first : MOST_PASSES;
        auto items = [&](int pass) { return pass % 2 == 0 ? lists.contacts : lists.bodies; };
        run_passes(team, threads, 0, last, items, WIDTH, [&](int pass, int i) {
            if (first + pass == 0) prepare_contacts(a, i, lists, relaxation, dt);
            if (pass % 2 == 1) move_bodies(a, i);
            else if (first + pass == passes) keep_contacts(a, i, lists, relaxation, dt);
            else press_contacts(a, i, lists.sticking, momentum_at((first + pass) / 2, iterations));
        });
    }
    for (int i = 0; i < lists.bodies; i += WIDTH) {
        const Body body = read_body([&](int quarter) { return own_four(a.motion, quarter, i); });
        end_lines(a, body, i, lists.bodies - i);
    }
    keep_ranges(a, lists);
}
}
#endif
