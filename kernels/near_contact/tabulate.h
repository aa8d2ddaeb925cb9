// Tables of the near pairs of one arrangement: directions, radial factors, windows, conductances from the table of two
// balls, and, for each contact, the index of the other ball's part of the force.
//
// From Python: the windows of contact_table.py, and the nodes of its table.
#pragma once
#include "near_contact/select.h"

namespace warpmag {

// A near pair: radii a and b, their sum and its inverse ``unit`` [1/m], distance d and 1/d, weight of both balls,
// window of the ratio of radii, and lanes of weight > 0.
struct NearPair {
    Number a, b, sum, unit, d, inverse, weight, similarity;
    Mask live;
};

// U, g1 d, g2 d² and g3 d³ of two homogeneous balls of radii a and b, ``apart`` = |a − b|.
struct Potential {
    Number u, g1, g2, g3;
};
CUDA_CALLABLE inline Potential potential(Number d, Number a, Number b, Number apart) {
    const Number i1 = 1 / d, i2 = i1 * i1;
    const Mask overlap = d < a + b;
    const Potential f = {i1, -i2, 3 * i2 * i1, -15 * i2 * i2};
    if (!any(overlap)) return f;
    const Factors<Number> g = averaged_factors(d, a, b, apart);
    return {overlap ? averaged_potential(d, a, b, apart) : f.u, overlap ? g.g1 * d : f.g1, overlap ? g.g2 * d : f.g2,
            overlap ? g.g3 : f.g3};
}

// Writes the rows of slot s of ball i, a pair in direction u; zeros in lanes without a pair.
CUDA_CALLABLE inline void tabulate_pair(const NearArrays& arrays, int i, int s, Vector u, const NearPair& p) {
    const Number a = p.a, b = p.b, unit = p.unit, zero = a * Real(0);
    Real *const rows = arrays.pair(s, i), *const slopes = arrays.pair_slope(s, i);
    auto write = [=](int row, Number n) { put(rows + row * CHUNK, p.live ? n : zero); };
    write(0, u.x);
    write(1, u.y);
    write(2, u.z);
    // lengths in units of the distance in contact, because powers of meters overflow float32
    const Number y = unit * p.d, third = unit * unit * unit, x = HALF_RANGE * unit;
    const Number apart = larger(a - b, b - a);
    const Potential all = potential(y, unit * a, unit * b, unit * apart), far = potential(y, x * a, x * b, x * apart);
    const Number short_range = y < HALF_RANGE ? p.weight : zero; // fades with the balls' weights
    write(3, short_range * unit * (all.u - far.u));
    write(4, short_range * unit * unit * (all.g1 - far.g1));
    write(5, short_range * third * (all.g2 - far.g2));
    write(6, p.inverse);
    put(slopes, p.live ? short_range * third * (unit * (all.g3 - far.g3)) : zero);
    const Fade quadrupole =
        window(2 * y - 2, QUADRUPOLE_GAP_LOW, QUADRUPOLE_GAP_HIGH, QUADRUPOLE_OVERLAP_LOW, QUADRUPOLE_OVERLAP_HIGH);
    write(7, p.weight * p.similarity * quadrupole.value);
    put(slopes + CHUNK, p.live ? p.weight * p.similarity * 2 * unit * quadrupole.slope : zero);
}

// B-spline at a gap [radii]: first of four nodes, their weights, and the weights of the derivative.
struct Spline {
    Index node;
    Number weight[4], slope[4];

    CUDA_CALLABLE explicit Spline(Number gap) {
        const Number zero = gap * Real(0), unit = zero + 1, outside = larger(gap, unit * SMALLEST_GAP);
        const Number z = smaller(gap - SMALLEST_GAP, zero) * (1 / SOFTNESS), steep = 1 / root(1 + z * z);
        Number x = logarithm(outside) + (SOFTNESS / SMALLEST_GAP) * z * steep;
        x = smaller(larger((x - FIRST_NODE) * NODES_PER_UNIT, zero), unit * (NODES - 1));
        node = truncated(smaller(x, unit * (NODES - 2)));
        const Number v = x - number_of(node), u = 1 - v, sixth = unit * Real(1.0 / 6.0);
        const Number scale = Real(0.5) * NODES_PER_UNIT * steep * steep * steep / outside;
        weight[0] = sixth * u * u * u;
        weight[1] = sixth * (4 - 6 * v * v + 3 * v * v * v);
        weight[2] = sixth * (4 - 6 * u * u + 3 * u * u * u);
        weight[3] = sixth * v * v * v;
        slope[0] = -scale * u * u;
        slope[1] = scale * (3 * v * v - 4 * v);
        slope[2] = scale * (4 * u - 3 * u * u);
        slope[3] = scale * v * v;
    }
};

// Interpolates values and derivatives of four of the table's functions, at the nodes from ``lines`` on.
CUDA_CALLABLE inline void interpolate(const Real* tables, int quarter, const int* lines, const Spline& spline,
                                      Four& value, Four& change) {
    const Number zero = spline.weight[0] * Real(0);
    value = change = {zero, zero, zero, zero};
    for (int k = 0; k < 4; ++k) {
        const Four node = four_at(tables + LINE * k, quarter, lines);
        const Number w = spline.weight[k], slope = spline.slope[k];
        value = {value.x + w * node.x, value.y + w * node.y, value.z + w * node.z, value.w + w * node.w};
        change = {change.x + slope * node.x, change.y + slope * node.y, change.z + slope * node.z,
                  change.w + slope * node.w};
    }
}

// Writes the conductances of slot s of ball i and their derivatives. Adds the ball's self-conductances to two sums.
CUDA_CALLABLE inline void tabulate_contact(const NearArrays& arrays, int i, int s, const NearPair& p, Number weight,
                                           Index kind, Index other_kind, Number& sources, Number& dipoles) {
    const Number zero = p.a * Real(0), scale = 2 * p.a * p.b * p.unit;
    const auto touches = weight > zero;
    const Number gap = touches ? (p.d - p.sum) / scale : zero + 1; // NaN for a point dipole
    Real *const rows = arrays.conductance(s, i), *const slopes = arrays.conductance_slope(s, i);
    const Spline spline(gap);
    const Fade fade = window(gap, CONTACT_GAP_LOW, CONTACT_GAP_HIGH, DEEPEST_LOW, DEEPEST_HIGH);
    const Number part_value = scale * weight * fade.value, part_slope = weight * fade.slope,
                 part_change = weight * fade.value;
    auto write = [=](int row, Number value) { put(rows + row * CHUNK, touches ? part_value * value : zero); };
    auto store = [=](int row, Number value, Number change) {
        write(row, value);
        put(slopes + row * CHUNK, touches ? part_change * change + part_slope * value : zero);
    };
    int lines[WIDTH];
    put_indices(lines, (kind * arrays.kinds + other_kind) * (NODES + 2) + spline.node);
    Four value, change;
    for (int quarter = 0; quarter < 4; ++quarter) {
        interpolate(arrays.tables, quarter, lines, spline, value, change);
        store(4 * quarter, value.x, change.x);
        store(4 * quarter + 1, value.y, change.y);
        if (quarter == 0) sources += touches ? part_value * value.x : zero;
        if (quarter == 1) dipoles += touches ? part_value * (value.x + 2 * value.z) : zero;
        if (quarter == 3) break;
        store(4 * quarter + 2, value.z, change.z);
        store(4 * quarter + 3, value.w, change.w);
    }
    if (arrays.kinds == 1) return;
    put_indices(lines, (other_kind * arrays.kinds + kind) * (NODES + 2) + spline.node);
    interpolate(arrays.tables, 0, lines, spline, value, change);
    write(14, value.w);
    interpolate(arrays.tables, 2, lines, spline, value, change);
    write(15, value.y);
    write(16, value.w);
}

// Finds the index of the other ball's part of a contact's force. If there is none, it is the index of the last entries,
// which are zero.
CUDA_CALLABLE inline void find_counterpart(const NearArrays& a, int i, int s, int j) {
    int other_slot = -1;
    auto takes_part = [&](int ball) { return a.positions[LINE * (size_t)ball + 4] > 0; };
    if (s < a.contact_count[i] && j < a.balls && takes_part(i) && takes_part(j)) // an image's is its ball's, mirrored
        for (int slot = 0; slot < a.contact_count[j]; ++slot)
            other_slot = *list_at(a.near, NEAR_SLOTS, slot, j) == i ? slot : other_slot;
    *list_at(a.counterpart, CONTACT_SLOTS, s, i) =
        other_slot < 0 ? CONTACT_SLOTS * 3 * a.balls : (int)(a.pair_force(other_slot, j) - a.pair_forces);
}

// Sets the state of balls without near balls to zero, so that they start cold when they have one again.
CUDA_CALLABLE inline void reset_isolated(const NearArrays& a, int i, Mask isolated) {
    if (!any(isolated)) return;
    const Number zero = numbers(a.radius + i) * Real(0);
    for (int quarter = 0; quarter < 3; ++quarter) {
        const Four f = own_four(a.sources, quarter, i);
        put_four(a.sources, quarter, i,
                 {isolated ? zero : f.x, isolated ? zero : f.y, isolated ? zero : f.z, isolated ? zero : f.w});
    }
    for (int c = 0; c < 2 * STATE_ROWS; ++c) {
        Real* const row = rows_at(c < STATE_ROWS ? a.state : a.last_state, STATE_ROWS, i) + c % STATE_ROWS * CHUNK;
        put(row, isolated ? zero : numbers(row));
    }
}

// Tabulates the slots of a ball. Slots that are no longer used are emptied: they hold the ball itself, and zeros.
CUDA_CALLABLE inline void tabulate(const NearArrays& a, int i) {
    int *const used = a.used + i, *const used_contacts = used + a.balls;
    const int contact_slots = largest_count(a.contact_count + i), counted = largest_count(a.near_count + i),
              emptied = largest_count(used);
    const int slots = counted > emptied ? counted : emptied, emptied_contacts = largest_count(used_contacts);
    const Number counts = number_of(indices(a.near_count + i)),
                 contact_counts = number_of(indices(a.contact_count + i));
    const Four own = own_four(a.positions, 0, i), own_weight_and_kind = own_four(a.positions, 1, i);
    const Number size = own.w, zero = size * Real(0), unit = zero + 1;
    Number sources = zero, dipoles = zero;
    for (int s = share(); s < slots; s += SHARES) {
        int* const list = list_at(a.near, NEAR_SLOTS, s, i);
        for (int l = 0; l < WIDTH; ++l)
            if (s >= a.near_count[i + l]) list[l] = i + l; // other threads read only the slots in use
        const Four other = four_at(a.positions, 0, list), weight_and_kind = four_at(a.positions, 1, list);
        const Number weight = counts > Real(s) ? own_weight_and_kind.x * weight_and_kind.x : zero;
        const Mask live = weight > zero;
        const Number b = live ? other.w : size + (size > zero ? zero : unit), sum = size + b;
        const Vector r = {other.x - own.x, other.y - own.y, other.z - own.z};
        const Polar separation = polar(1 / sum * r);
        // bounded below, so that powers of 1/d do not overflow; overlapping balls do not use them
        const Number d = live ? sum * larger(separation.d, zero + Real(1e-12)) : sum;
        const Number ratio = smaller(size, b) / larger(size, b);
        const Number similarity =
            smoothstep((ratio - LEAST_RATIO_LOW) * (1 / (LEAST_RATIO_HIGH - LEAST_RATIO_LOW))).value;
        const NearPair pair = {size, b, sum, 1 / sum, d, 1 / d, weight, similarity, live};
        tabulate_pair(a, i, s, separation.u, pair);
        if (s >= contact_slots && s >= emptied_contacts) continue;
        const Number contact_weight = contact_counts > Real(s) ? weight * similarity : zero;
        tabulate_contact(a, i, s, pair, contact_weight, truncated(own_weight_and_kind.y), truncated(weight_and_kind.y),
                         sources, dipoles);
        for (int l = 0; l < WIDTH; ++l) find_counterpart(a, i + l, s, list[l]);
    }
    sources = group_total(sources);
    dipoles = group_total(dipoles) * Real(1.0 / 3.0);
    if (share() > 0) return;
    put(a.relaxation + i, size / (size + OWN_SOURCE * sources));
    put(a.relaxation + a.balls + i, size / (size + OWN_DIPOLE * dipoles));
    put_indices(used, indices(a.near_count + i));
    put_indices(used_contacts, indices(a.contact_count + i));
    reset_isolated(a, i, counts == zero);
}

// Two passes: select near balls, then tabulate them.
struct Pairs {
    const NearArrays a;
    CUDA_CALLABLE void operator()(int pass, int i) const {
        if (pass == 0) select(a, i);
        else tabulate(a, i);
    }
};
}
