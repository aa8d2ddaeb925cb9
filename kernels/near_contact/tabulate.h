// What does not change of near pairs while balls stand still: directions, radial factors, windows, conductances by the
// table, and the place of what the other ball has of a contact's forces.
//
// From Python: the windows of contact_table.py, and the nodes of its table.
#pragma once
#include "near_contact/select.h"

namespace warpmag {

// A near pair: radii, directed distance, and how far both balls take part.
struct NearPair {
    Number a, b, sum, unit, d, inverse, weight, alike;
    Mask live;
};

// U of two homogeneous balls and its radial factors.
struct Potential {
    Number u, g1, g2, g3;
};
CUDA_CALLABLE inline Potential factors(Number d, Number i1, Number a, Number b) { // i1 = 1/d
    const Number s = a + b, i2 = i1 * i1, i3 = i2 * i1;
    Potential f = {i1, -i3, 3 * i3 * i2, -15 * i3 * i2 * i2};
    if (!any(mask_of(d < s))) return f;
    const Number p = a * b, c = 1 / (160 * p * p * p), squares = a * a + b * b;
    Number e = s - d, e2 = e * e, q0 = 5 * squares - 20 * p;
    const Number q = q0 * i1 - 4 * s - d, q1 = -q0 * i2 - 1, q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1;
    const Number w1 = c * e2 * e * (e * q1 - 4 * q) * i1;
    const Number w2 = c * e2 * (12 * q - 8 * e * q1 + e2 * q2) * i2;
    const Number w3 = c * e * (36 * e * q1 - 24 * q - 12 * e2 * q2 + e2 * e * q3) * i3;
    Number g1 = w1 - i3, g2 = w2 - (w1 - 3 * i3) * i2, g3 = w3 - 3 * (w2 - w1 * i2) * i2 - 15 * i3 * i2 * i2;
    const auto deep = d <= Real(0.5) * s;
    if (any(deep)) {
        const Number delta = a - b, delta2 = delta * delta, k = 5 * delta2 * delta2 * (delta2 + 6 * p);
        const Number u1 = 45 * s * s * delta2, u2 = -40 * s * (delta2 + p), u3 = 15 * (delta2 + 2 * p);
        g1 = deep ? c * (2 * u2 + 3 * u3 * d - 5 * d * d * d + (u1 - k * i2) * i1) : g1;
        g2 = deep ? c * (3 * u3 * i1 - 15 * d + (3 * k * i2 - u1) * i3) : g2;
        g3 = deep ? c * ((3 * u1 - 15 * k * i2) * i3 * i2 - 3 * u3 * i3 - 15 * i1) : g3;
        const auto within = d <= larger(delta, -delta);
        const Number large = larger(a, b);
        g1 = within ? -1 / (large * large * large) : g1;
        g2 = within ? 0 * d : g2;
        g3 = within ? 0 * d : g3;
    }
    const Number x = larger(d, Real(0.05) * s); // nearly concentric ones as touching
    e = s - x;
    e2 = e * e;
    const Number u = (1 + e2 * e2 * (5 * squares - 20 * p - 4 * s * x - x * x) * c) / x;
    return {d < s ? u : f.u, d < s ? g1 : f.g1, d < s ? g2 : f.g2, d < s ? g3 : f.g3};
}

// Writes the rows of slot s of ball i, a pair at separation r, zeros where none is.
CUDA_CALLABLE inline void tabulate_pair(const Arrays& arrays, int i, int s, Vector r, const NearPair& p) {
    const Number a = p.a, b = p.b, unit = p.unit, zero = a * Real(0);
    Real *const rows = arrays.pair(s, i), *const slopes = arrays.pair_slope(s, i);
    auto keep = [=](int row, Number n) { put(rows + row * CHUNK, p.live ? n : zero); };
    keep(0, r.x * p.inverse);
    keep(1, r.y * p.inverse);
    keep(2, r.z * p.inverse);
    // in units of the distance in contact: powers of metres overflow float32
    const Number y = unit * p.d, over_y = p.sum * p.inverse, third = unit * unit * unit;
    const Potential all = factors(y, over_y, unit * a, unit * b);
    const Potential far = factors(y, over_y, HALF_RANGE * unit * a, HALF_RANGE * unit * b);
    const Number short_range = y < HALF_RANGE ? zero + 1 : zero;
    keep(3, short_range * unit * (all.u - far.u));
    keep(4, short_range * unit * unit * ((all.g1 - far.g1) * y));
    keep(5, short_range * third * ((all.g2 - far.g2) * y * y));
    keep(6, p.inverse);
    put(slopes, p.live ? short_range * third * (unit * ((all.g3 - far.g3) * y * y * y)) : zero);
    const Fade quadrupole = window(2 * y - 2, QUADRUPOLE_GAP_LOW, QUADRUPOLE_GAP_HIGH, QUADRUPOLE_OVERLAP_LOW, QUADRUPOLE_OVERLAP_HIGH);
    keep(7, p.weight * p.alike * quadrupole.value);
    put(slopes + CHUNK, p.live ? p.weight * p.alike * 2 * unit * quadrupole.slope : zero);
}

// Where the spline of a gap [radii] is read: first of four nodes, their weights, and those of the derivative.
struct Spline {
    Index node;
    Number weight[4], slope[4];

    CUDA_CALLABLE explicit Spline(Number gap) {
        const Number zero = gap * Real(0), one = zero + 1, outside = larger(gap, one * SMALLEST_GAP);
        const Number z = smaller(gap - SMALLEST_GAP, zero) * (1 / SOFTNESS), steep = 1 / root(1 + z * z);
        Number x = logarithm(outside) + (SOFTNESS / SMALLEST_GAP) * z * steep;
        x = smaller(larger((x - FIRST_NODE) * NODES_PER_UNIT, zero), one * (NODES - 1));
        node = whole(smaller(x, one * (NODES - 2)));
        const Number v = x - number_of(node), u = 1 - v, sixth = one * Real(1.0 / 6.0);
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

// Four of the table's functions at nodes that begin at ``lines``.
CUDA_CALLABLE inline Four interpolated(const Real* tables, int quarter, const int* lines, const Number* weight) {
    const Number zero = weight[0] * Real(0);
    Four value = {zero, zero, zero, zero};
    for (int k = 0; k < 4; ++k) {
        const Four node = four_at(tables + LINE * k, quarter, lines);
        value = {value.x + weight[k] * node.x, value.y + weight[k] * node.y, value.z + weight[k] * node.z,
                 value.w + weight[k] * node.w};
    }
    return value;
}

// Writes the conductances of slot s of ball i and their derivatives, and adds those of its own sources and dipoles.
CUDA_CALLABLE inline void tabulate_contact(const Arrays& arrays, int i, int s, const NearPair& p, Number both, Index kind,
                                           Index its_kind, Number& sources, Number& dipoles) {
    const Number zero = p.a * Real(0), scale = 2 * p.a * p.b * p.unit, gap = (p.d - p.sum) / scale;
    const auto touches = both > zero;
    Real *const rows = arrays.conductance(s, i), *const slopes = arrays.conductance_slope(s, i);
    const Spline spline(gap);
    const Fade fade = window(gap, CONTACT_GAP_LOW, CONTACT_GAP_HIGH, DEEPEST_LOW, DEEPEST_HIGH);
    const Number part_value = scale * both * fade.value, part_slope = both * fade.slope, part_change = both * fade.value;
    auto keep = [=](int row, Number value) { put(rows + row * CHUNK, touches ? part_value * value : zero); };
    auto store = [=](int row, Number value, Number change) {
        keep(row, value);
        put(slopes + row * CHUNK, touches ? part_change * change + part_slope * value : zero);
    };
    int lines[WIDTH];
    put_indices(lines, (kind * arrays.kinds + its_kind) * (NODES + 2) + spline.node);
    for (int quarter = 0; quarter < 4; ++quarter) {
        const Four value = interpolated(arrays.tables, quarter, lines, spline.weight);
        const Four change = interpolated(arrays.tables, quarter, lines, spline.slope);
        store(4 * quarter, value.x, change.x);
        store(4 * quarter + 1, value.y, change.y);
        if (quarter == 0) sources += touches ? part_value * value.x : zero;
        if (quarter == 1) dipoles += touches ? part_value * (value.x + 2 * value.z) : zero;
        if (quarter == 3) break;
        store(4 * quarter + 2, value.z, change.z);
        store(4 * quarter + 3, value.w, change.w);
    }
    if (arrays.kinds == 1) return;
    put_indices(lines, (its_kind * arrays.kinds + kind) * (NODES + 2) + spline.node);
    const Four of_fields = interpolated(arrays.tables, 0, lines, spline.weight);
    const Four of_gradients = interpolated(arrays.tables, 2, lines, spline.weight);
    keep(14, of_fields.w);
    keep(15, of_gradients.y);
    keep(16, of_gradients.w);
}

// Finds where the other ball of a contact has its part of the force; the last place, of zeros, is for none.
CUDA_CALLABLE inline void find_counterpart(const Arrays& a, int i, int s, int j) {
    int place = -1;
    auto takes_part = [&](int ball) { return a.places[LINE * (size_t)ball + 4] > 0; };
    if (s < a.contact_count[i] && takes_part(i) && takes_part(j))
        for (int slot = 0; slot < a.contact_count[j]; ++slot)
            place = *list_at(a.near, NEAR_SLOTS, slot, j) == i ? slot : place;
    *list_at(a.counterpart, CONTACT_SLOTS, s, i) =
        place < 0 ? CONTACT_SLOTS * 3 * a.balls : (int)(a.pair_force(place, j) - a.pair_forces);
}

// A ball that has no near ball any more starts cold when it has one again.
CUDA_CALLABLE inline void forget_where_alone(const Arrays& a, int i, Mask alone) {
    if (!any(alone)) return;
    const Number zero = numbers(a.radius + i) * Real(0);
    for (int quarter = 0; quarter < 3; ++quarter) {
        const Four f = own_four(a.sources, quarter, i);
        put_four(a.sources, quarter, i,
                 {alone ? zero : f.x, alone ? zero : f.y, alone ? zero : f.z, alone ? zero : f.w});
    }
    for (int c = 0; c < 2 * STATE_ROWS; ++c) {
        Real* const row = rows_at(c < STATE_ROWS ? a.state : a.last_state, STATE_ROWS, i) + c % STATE_ROWS * CHUNK;
        put(row, alone ? zero : numbers(row));
    }
}

// Tabulates the slots of a ball. Those that are no longer used are emptied: they hold the ball itself, and zeros.
CUDA_CALLABLE inline void tabulate(const Arrays& a, int i) {
    int *const used = a.used + i, *const used_contacts = used + a.balls;
    const int contact_slots = most(a.contact_count + i), counted = most(a.near_count + i), emptied = most(used);
    const int slots = counted > emptied ? counted : emptied, emptied_contacts = most(used_contacts);
    const Number counts = number_of(indices(a.near_count + i)), contact_counts = number_of(indices(a.contact_count + i));
    const Four own = own_four(a.places, 0, i), own_part = own_four(a.places, 1, i);
    const Number size = own.w, zero = size * Real(0), one = zero + 1;
    Number sources = zero, dipoles = zero;
    for (int s = share(); s < slots; s += SHARES) {
        int* const list = list_at(a.near, NEAR_SLOTS, s, i);
        for (int l = 0; l < WIDTH; ++l) list[l] = s < a.near_count[i + l] ? list[l] : i + l;
        const Four other = four_at(a.places, 0, list), part = four_at(a.places, 1, list);
        const Number weight = counts > Real(s) ? own_part.x * part.x : zero;
        const Mask live = weight > zero;
        const Number b = live ? other.w : size + (size > zero ? zero : one), sum = size + b;
        const Vector r = {other.x - own.x, other.y - own.y, other.z - own.z};
        const Number distance = length(r), least = Real(1e-6) * size;
        const Number d = live ? (distance > least ? distance : least) : sum;
        const Number ratio = smaller(size, b) / larger(size, b);
        const Number alike = smoothstep((ratio - LEAST_RATIO_LOW) * (1 / (LEAST_RATIO_HIGH - LEAST_RATIO_LOW))).value;
        const NearPair pair = {size, b, sum, 1 / sum, d, 1 / d, weight, alike, live};
        tabulate_pair(a, i, s, r, pair);
        if (s >= contact_slots && s >= emptied_contacts) continue;
        const Number both = contact_counts > Real(s) ? weight * alike : zero;
        tabulate_contact(a, i, s, pair, both, whole(own_part.y), whole(part.y), sources, dipoles);
        for (int l = 0; l < WIDTH; ++l) find_counterpart(a, i + l, s, list[l]);
    }
    sources = group_total(sources);
    dipoles = group_total(dipoles) * Real(1.0 / 3.0);
    if (share() > 0) return;
    put(a.relaxation + i, size / (size + OWN_SOURCE * sources));
    put(a.relaxation + a.balls + i, size / (size + OWN_DIPOLE * dipoles));
    put_indices(used, indices(a.near_count + i));
    put_indices(used_contacts, indices(a.contact_count + i));
    forget_where_alone(a, i, counts == zero);
}

template <class Addresses>
CUDA_CALLABLE inline void publish_places(int thread, int first, int last, int threads, unsigned long long* team,
                                         const Addresses& addresses) {
    const Arrays a(addresses);
    make_passes(thread, first, last, threads, team, a.balls, [&](int, int i) { publish_place(a, i); });
}

// Two passes: select near balls, then tabulate them.
template <class Addresses>
CUDA_CALLABLE inline void find_pairs(int thread, int first, int last, int threads, unsigned long long* team,
                                     const Addresses& addresses) {
    const Arrays a(addresses);
    make_passes(thread, first, last, threads, team, a.balls, [&](int pass, int i) {
        if (pass == 0) select(a, i);
        else tabulate(a, i);
    });
}
}
