// The contact solve on a CPU: a pass over vectors of contacts, then one over vectors of bodies, in each iteration.
//
// A contact's impulses on its two bodies are computed once, and written to a record among those of each body.
#pragma once
#include "rigid/contact_lines.h"

#if !defined(__CUDA_ARCH__)
namespace warpmag {

inline int rounded(int count) { return (count + WIDTH - 1) / WIDTH * WIDTH; }

// What one thread finds out: how many contacts and bodies take part, and where each has its place.
struct Lists {
    int contacts, bodies, lines;
};
inline Lists list_contacts(const Arrays& a) {
    Lists lists = {0, 0, 0};
    for (int b = 0; b < a.bodies; ++b) a.side_count[b] = 0, a.slot[b] = -1;
    for (int c = 0, found = a.found(); c < found; ++c) {
        int ends[2];
        if (!ends_of(a, c, ends)) continue;
        a.entry[lists.contacts++] = c;
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

// Writes the contacts that take part, as their second bodies see them, in vectors; the last is filled up with contacts
// that are never closed.
inline void write_contacts(const Arrays& a, const Lists& lists) {
    for (int k = 0; k < rounded(lists.contacts); ++k) {
        Real* const place = rows_at(a.side, SIDE, k);
        int* const other = list_at(a.other, 4, 0, k);
        for (int end = 0; end < 2; ++end) {
            other[end * CHUNK] = a.lines - 1;
            other[(2 + end) * CHUNK] = 2 * a.contact_max + k / WIDTH; // of nothing that moves
        }
        for (int r = 0; r < 3 * a.with_levers; ++r) rows_at(a.pressed, 3, k)[r * CHUNK] = 0;
        a.wide[k / WIDTH] = 0;
        if (k >= lists.contacts) {
            for (int r = 0; r < SIDE; ++r) place[r * CHUNK] = r == 3 ? -1 : 0;
            continue;
        }
        put_side(a, a.entry[k], 1, place, CHUNK);
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
    put_vector(a, places, 0, scaled(-1, linear));
    put_vector(a, places, 1, other);
    put_vector(a, places + CHUNK, 0, linear);
    put_vector(a, places + CHUNK, 1, own);
}

struct Pair {
    Contact contact;
    Body own, other;
    const int *own_line, *other_line;
};
inline Pair pair_at(const Arrays& a, int k) {
    const int* const lines = list_at(a.other, 4, 0, k);
    const Real* const rows = rows_at(a.side, SIDE, k);
    auto body = [&](const int* j) { return read_body([&](int quarter) { return four_at(a.motion, quarter, j); }); };
    auto row = [&](int r) { return numbers(rows + r * CHUNK); };
    auto fours = [&](int q) { return Four{row(4 * q), row(4 * q + 1), row(4 * q + 2), row(4 * q + 3)}; };
    return {read_contact(fours), body(lines + CHUNK), body(lines), lines + CHUNK, lines};
}
inline auto matter_at(const Arrays& a, const int* j) {
    return [&a, j](int quarter) { return four_at(a.matter, quarter, j); };
}

inline void press_contacts(const Arrays& a, int k, Real rate, Real dt) {
    const Pair p = pair_at(a, k);
    const Vector r = arm(p.own, p.contact.point), other_r = arm(p.other, p.contact.other_point);
    const Number distance = gap(p.contact, p.own, p.other, r, other_r);
    // what was written in an iteration in which none was closed still holds
    int& quiet = a.wide[k / WIDTH];
    const bool closed = any(distance < 0);
    if (!closed && quiet) return;
    quiet = !closed;
    const Inertia own = read_inertia(matter_at(a, p.own_line)), other = read_inertia(matter_at(a, p.other_line));
    auto drifts = [&](int end) {
        const int* const line = end == 1 ? p.own_line : p.other_line;
        return read_drift([&](int quarter) { return four_at(a.motion, quarter, line); });
    };
    const Impulse found =
        contact_impulse(p.contact, p.own, p.other, own, other, distance, r, other_r, drifts, rate, dt);
    put_records(a, k, found.linear, found.own, found.other);
    if (!a.with_levers) return;
    Real* const pressed = rows_at(a.pressed, 3, k);
    put_vector(pressed, sum(own_vector(pressed), found.linear));
}

inline void correct_levers(const Arrays& a, int k, Real dt) {
    const Pair p = pair_at(a, k);
    const Vector linear = own_vector(rows_at(a.pressed, 3, k)), none = scaled(0, linear);
    auto correction = [&](const Body& body, const int* line, Vector point, Vector impulse) {
        const Body first = read_body([&](int quarter) { return four_at(a.first_motion, quarter, line); });
        const Vector spin = scaled(Real(0.5), sum(body.spin, first.spin));
        return lever_correction(body, spin, point, impulse, dt);
    };
    put_records(a, k, none, correction(p.own, p.own_line, p.contact.point, linear),
                correction(p.other, p.other_line, p.contact.other_point, scaled(-1, linear)));
}

inline void move_bodies(const Arrays& a, int i, Real dt) {
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
    Drift drift = read_drift(motion);
    Whole whole = read_whole(drift, [&](int quarter) { return own_four(a.matter, quarter, i); });
    apply(body, whole, {linear.x, linear.y, linear.z}, {angular.x, angular.y, angular.z}, dt);
    put_body(a.motion, i, body, {whole.v, drift.kinematic});
}

inline void solve_contacts(const Arrays& a, int iterations, Real rate, Real dt, int threads, Word* team) {
    const Lists lists = list_contacts(a);
    if (lists.contacts == 0) return;
    write_contacts(a, lists);
    for (int i = 0; i < lists.lines; i += WIDTH) begin_lines(a, i);
    begin_lines(a, a.lines - WIDTH);
    const int helpful = lists.contacts / CONTACTS_PER_THREAD;
    threads = helpful < 1 ? 1 : helpful < threads ? helpful : threads;
    const int passes = 2 * (iterations + a.with_levers);
    for (int first = 0; first < passes; first += MOST_PASSES) {
        const int last = passes - first < MOST_PASSES ? passes - first : MOST_PASSES;
        auto items = [&](int pass) { return pass % 2 == 0 ? lists.contacts : lists.bodies; };
        run_passes(team, threads, 0, last, items, WIDTH, [&](int pass, int i) {
            if (pass % 2 == 1) move_bodies(a, i, dt);
            else if (first + pass < 2 * iterations) press_contacts(a, i, rate, dt);
            else correct_levers(a, i, dt);
        });
    }
    for (int i = 0; i < lists.bodies; i += WIDTH) {
        auto motion = [&](int quarter) { return own_four(a.motion, quarter, i); };
        end_lines(a, read_body(motion), read_drift(motion), i, lists.bodies - i);
    }
}
}
#endif
