// Forces between permanent moments and a ball in their non-uniform field, from multipoles of the ball of degree 2 and
// more. nonuniform.py has the equations.
//
// Lengths are in radii R of the ball, moments are divided by R³. Symmetric traceless tensors of degrees 2 to 4 have 21
// rows: xx, yy, xy, yz, zx; xxx, yyy, xxy, xxz, yyx, yyz, xyz; xxxx, yyyy, xxyy, xxxy, xxxz, yyyx, yyyz, xxyz, yyzx.
// The next row is the polarizability of higher degrees. From Python: RESPONSE_ROWS, and the windows of
// contact_table.py.
#pragma once
#include "near_contact/select.h"
#include "near_contact/state.h"
#include "shared/inverse_root.h"

namespace warpmag {

// A permanent moment relative to a ball: direction, 1/d, weight w with its derivative by d, and lanes of weight > 0.
struct MomentView {
    Vector u;
    Number inverse, weight, slope;
    Mask live;
};

// View of a moment at r [m] from the center of a ball. b is the radius [m] of the moment's own ball. ``single`` is 1
// for the only moment of a body, 0 for a cell.
CUDA_CALLABLE inline MomentView view_moment(Vector r, Number inverse_radius, Number b, Number single, Mask is_partner) {
    const Number zero = inverse_radius * Real(0), unit = zero + 1;
    const Vector s = inverse_radius * r;
    const Number d2 = dot(s, s), size = inverse_radius * b, is_single = single > Real(0) ? unit : zero;
    const Number depth = larger(size * (CELL_DEPTH + (1 - CELL_DEPTH) * is_single), zero + LEAST_MAGNET);
    const Number deepest = 1 + (1 - MAGNET_OVERLAP_HIGH) * depth, shallow = 1 + (1 - MAGNET_OVERLAP_LOW) * depth;
    const Mask live = is_partner & (d2 < MAGNET_REACH_HIGH * MAGNET_REACH_HIGH) & (d2 > deepest * deepest);
    if (!any(live)) return {{zero, zero, zero}, unit, zero, zero, live};
    const Number inverse = Real(0.5) * twice_inverse_root(live ? d2 : unit), d = d2 * inverse;
    Number weight = live ? unit : zero, slope = zero;
    if (any(live & (size > CELL_SIZE_LOW) & (is_single < unit))) {
        const Number coarse = smoothstep((size - CELL_SIZE_LOW) * (1 / (CELL_SIZE_HIGH - CELL_SIZE_LOW))).value;
        weight = weight * (1 - coarse * (1 - is_single));
    }
    if (any(live & (d > MAGNET_REACH_LOW))) {
        const Fade outer = smoothstep((MAGNET_REACH_HIGH - d) * (1 / (MAGNET_REACH_HIGH - MAGNET_REACH_LOW)));
        slope = -weight * outer.slope * (1 / (MAGNET_REACH_HIGH - MAGNET_REACH_LOW));
        weight = weight * outer.value;
    }
    if (any(live & (d < shallow))) { // far from the outer window, unless the magnet is far larger than the ball
        const Number width = 1 / (shallow - deepest);
        const Fade inner = smoothstep((d - deepest) * width);
        slope = slope * inner.value + weight * inner.slope * width;
        weight = weight * inner.value;
    }
    return {(live ? inverse : zero) * s, inverse, weight, slope, live & (weight > zero)};
}

// Components of full symmetric tensors: of degree 2 xx, yy, zz, xy, yz, zx; of degree 3 xxx, yyy, zzz, xxy, xxz, yyx,
// yyz, zzx, zzy, xyz; of degree 4 xxxx, yyyy, zzzz, xxxy, xxxz, yyyx, yyyz, zzzx, zzzy, xxyy, yyzz, zzxx, xxyz, yyzx,
// zzxy.
constexpr int FULL = 31;

// Adds the derivatives of a moment's potential. At degree l they are w/d^(l+2) times the symmetric part of y u..u, with
// y = l m − (2l + 1) (u·m) u. ``write_response`` removes the traces.
CUDA_CALLABLE inline void add_derivatives(Number (&sum)[FULL], const MomentView& s, Vector m) {
    const Vector u = s.u;
    const Number a = dot(u, m), x = u.x * u.x, y = u.y * u.y, z = u.z * u.z;
    const Number xy = u.x * u.y, yz = u.y * u.z, zx = u.z * u.x;
    const Number k2 = s.weight * s.inverse * s.inverse * s.inverse * s.inverse;
    const Number k3 = k2 * s.inverse * Real(1.0 / 3.0), k4 = k2 * s.inverse * s.inverse * Real(0.25);
    const Vector p = k2 * (m - Real(2.5) * a * u);
    sum[0] += 2 * p.x * u.x;
    sum[1] += 2 * p.y * u.y;
    sum[2] += 2 * p.z * u.z;
    sum[3] += p.x * u.y + p.y * u.x;
    sum[4] += p.y * u.z + p.z * u.y;
    sum[5] += p.z * u.x + p.x * u.z;
    const Vector q = k3 * (Number(Real(3)) * m - 7 * a * u);
    sum[6] += 3 * q.x * x;
    sum[7] += 3 * q.y * y;
    sum[8] += 3 * q.z * z;
    sum[9] += 2 * q.x * xy + q.y * x;
    sum[10] += 2 * q.x * zx + q.z * x;
    sum[11] += 2 * q.y * xy + q.x * y;
    sum[12] += 2 * q.y * yz + q.z * y;
    sum[13] += 2 * q.z * zx + q.x * z;
    sum[14] += 2 * q.z * yz + q.y * z;
    sum[15] += q.x * yz + q.y * zx + q.z * xy;
    const Vector r = k4 * (Number(Real(4)) * m - 9 * a * u);
    const Vector by_x = x * r, by_y = y * r, by_z = z * r;
    sum[16] += 4 * by_x.x * u.x;
    sum[17] += 4 * by_y.y * u.y;
    sum[18] += 4 * by_z.z * u.z;
    sum[19] += 3 * by_x.x * u.y + by_x.y * u.x;
    sum[20] += 3 * by_x.x * u.z + by_x.z * u.x;
    sum[21] += 3 * by_y.y * u.x + by_y.x * u.y;
    sum[22] += 3 * by_y.y * u.z + by_y.z * u.y;
    sum[23] += 3 * by_z.z * u.x + by_z.x * u.z;
    sum[24] += 3 * by_z.z * u.y + by_z.y * u.z;
    sum[25] += 2 * (by_y.x * u.x + by_x.y * u.y);
    sum[26] += 2 * (by_z.y * u.y + by_y.z * u.z);
    sum[27] += 2 * (by_x.z * u.z + by_z.x * u.x);
    sum[28] += 2 * xy * u.z * r.x + by_x.y * u.z + by_x.z * u.y;
    sum[29] += 2 * xy * u.z * r.y + by_y.z * u.x + by_y.x * u.z;
    sum[30] += 2 * xy * u.z * r.z + by_z.x * u.y + by_z.y * u.x;
}

// Writes the response B_l = p_l (2l − 1)!!/l! b_l, where b_l is the traceless part of the sums plus the derivatives of
// the field of ``sources``.
CUDA_CALLABLE inline void write_response(Real* rows, const Real* sources, const Number (&s)[FULL], Number slope) {
    const Number k2 = Real(1.5) * polarizability(slope, 2), k3 = Real(2.5) * polarizability(slope, 3);
    const Number k4 = Real(4.375) * polarizability(slope, 4), third = (s[0] + s[1] + s[2]) * Real(1.0 / 3.0);
    auto write = [=](int row, Number k, Number n) {
        put(rows + row * CHUNK, k * (sources ? n + numbers(sources + row * CHUNK) : n));
    };
    write(0, k2, s[0] - third);
    write(1, k2, s[1] - third);
    write(2, k2, s[3]);
    write(3, k2, s[4]);
    write(4, k2, s[5]);
    const Number fifth = Real(0.2), x = fifth * (s[6] + s[11] + s[13]), y = fifth * (s[7] + s[9] + s[14]);
    const Number z = fifth * (s[8] + s[10] + s[12]);
    write(5, k3, s[6] - 3 * x);
    write(6, k3, s[7] - 3 * y);
    write(7, k3, s[9] - y);
    write(8, k3, s[10] - z);
    write(9, k3, s[11] - x);
    write(10, k3, s[12] - z);
    write(11, k3, s[15]);
    const Number xx = s[16] + s[25] + s[27], yy = s[17] + s[25] + s[26], zz = s[18] + s[26] + s[27];
    const Number xy = s[19] + s[21] + s[30], yz = s[22] + s[24] + s[28], zx = s[20] + s[23] + s[29];
    const Number all = (xx + yy + zz) * Real(1.0 / 35.0), k = Number(Real(1.0 / 7.0));
    write(12, k4, s[16] - 6 * k * xx + 3 * all);
    write(13, k4, s[17] - 6 * k * yy + 3 * all);
    write(14, k4, s[25] - k * (xx + yy) + all);
    write(15, k4, s[19] - 3 * k * xy);
    write(16, k4, s[20] - 3 * k * zx);
    write(17, k4, s[21] - 3 * k * xy);
    write(18, k4, s[22] - 3 * k * yz);
    write(19, k4, s[28] - k * yz);
    write(20, k4, s[29] - k * zx);
    put(rows + TENSOR_ROWS * CHUNK, polarizability(slope, 6)); // of degree 5 and up
}

// Tensor of degree 3 or 4 from row ``first`` on, contracted with u to degree 2.
template <class Get> CUDA_CALLABLE inline Traceless contracted_3(const Get& b, int first, Vector u) {
    auto along = [=](Number x, Number y, Number z) { return x * u.x + y * u.y + z * u.z; };
    const Number xxx = b(first), yyy = b(first + 1), xxy = b(first + 2), xxz = b(first + 3), yyx = b(first + 4);
    const Number yyz = b(first + 5), xyz = b(first + 6);
    return {along(xxx, xxy, xxz), along(yyx, yyy, yyz), along(xxy, yyx, xyz), along(xyz, yyz, -(xxy + yyy)),
            along(xxz, xyz, -(xxx + yyx))};
}
template <class Get> CUDA_CALLABLE inline Traceless contracted_4(const Get& b, int first, Vector u) {
    const Number z = u.z * u.z, x = u.x * u.x - z, y = u.y * u.y - z;
    const Number xy = 2 * u.x * u.y, yz = 2 * u.y * u.z, zx = 2 * u.z * u.x;
    auto along = [=](Number a, Number c, Number d, Number e, Number f) {
        return a * x + c * y + d * xy + e * yz + f * zx;
    };
    const Number xxxx = b(first), yyyy = b(first + 1), xxyy = b(first + 2), xxxy = b(first + 3), xxxz = b(first + 4);
    const Number yyyx = b(first + 5), yyyz = b(first + 6), xxyz = b(first + 7), yyzx = b(first + 8);
    const Number yyzz = -(xxyy + yyyy), zzxx = -(xxxx + xxyy), zzxy = -(xxxy + yyyx);
    return {along(xxxx, xxyy, xxxy, xxyz, xxxz), along(xxyy, yyyy, yyyx, yyyz, yyzx),
            along(xxxy, yyyx, xxyy, yyzx, xxyz), along(xxyz, yyyz, yyzx, yyzz, zzxy),
            along(xxxz, yyzx, xxyz, zzxy, zzxx)};
}

// Force on a permanent moment [μ0/4π R²], and the field that exerts its torque.
struct MagnetForce {
    Vector force, field;
};
CUDA_CALLABLE inline void add(Traceless& to, Number k, Traceless t) {
    to.xx += k * t.xx, to.yy += k * t.yy, to.xy += k * t.xy, to.yz += k * t.yz, to.zx += k * t.zx;
}

// Force by the ball's response B_l of degrees 2 to 4: the gradient of w m·∇Ψ, Ψ = Σ_l B_l:u^l/d^(l+1).
template <class Get> CUDA_CALLABLE inline MagnetForce multipole_force(const Get& b, const MomentView& s, Vector m) {
    const Vector u = s.u;
    const Number a = dot(u, m), k2 = s.inverse * s.inverse * s.inverse * s.inverse, zero = a * Real(0);
    const Traceless contracted[3] = {{b(0), b(1), b(2), b(3), b(4)}, contracted_3(b, 5, u), contracted_4(b, 12, u)};
    Traceless twice = {zero, zero, zero, zero, zero};
    Vector first = {zero, zero, zero}, second = first;
    Number on_m = zero, on_u = zero, k = k2;
    for (int n = 0; n < 3; ++n, k = k * s.inverse) {
        const Real l = Real(n + 2), odd = 2 * l + 1;
        const Vector v = contracted[n] * u;
        const Number f = k * odd * dot(v, u);
        add(twice, k * (l * (l - 1)), contracted[n]);
        first += k * l * v;
        second += k * (l * odd) * v;
        on_m += f;
        on_u += f * (odd + 2);
    }
    const Vector gradient = first - on_m * u; // ∇Ψ
    const Vector across = twice * m - (a * second + on_m * m);
    const Vector change = across + (on_u * a - dot(m, second)) * u;
    return {s.weight * s.inverse * change + s.slope * dot(m, gradient) * u, s.weight * gradient};
}

// Force by the response of all higher degrees to this moment alone, in closed form. The energy is
// −½ p w² (Q m² + D (u·m)²), Q and D functions of x = 1/d².
CUDA_CALLABLE inline MagnetForce closed_form_force(Number p, const MomentView& s, Vector m) {
    const Number x = s.live ? s.inverse * s.inverse : p * Real(0), open = 1 / (1 - x), x3 = x * x * x;
    const Number k = s.weight * p * x3 * x3 * open * open * open, a = dot(s.u, m), steep = 3 * x * open;
    const Number q = 15 - (24 - 10 * x) * x, both = 36 - (59 - 25 * x) * x, d = both - q;
    const Number q_slope = (7 + steep) * q - (24 - 20 * x) * x, d_slope = (7 + steep) * d - (35 - 30 * x) * x;
    const Number square = dot(m, m), along = a * a;
    const Number radial = s.slope * x * (q * square + d * along)
                          - s.weight * x * s.inverse * (q_slope * square + d_slope * along)
                          - s.weight * s.inverse * x * d * along;
    const Number across = s.weight * s.inverse * x * d * a;
    return {k * (radial * s.u + across * m), k * s.weight * x * (q * m + d * a * s.u)};
}

// Force of all degrees on the only moment of a body, and of degrees 2 to 4 on a cell.
template <class Get>
CUDA_CALLABLE inline MagnetForce magnet_force(const Get& b, const MomentView& s, Vector m, Number single) {
    const MagnetForce low = multipole_force(b, s, m);
    const Mask is_single = s.live & (single > Real(0));
    if (!any(is_single)) return low;
    const Number zero = single * Real(0);
    const MagnetForce high = closed_form_force(is_single ? b(21) : zero, s, m);
    return {low.force + high.force, low.field + high.field};
}

// Position [m], moment [A·m²] and radius [m] of moments. ``single`` is 1 for the only moment of a body.
struct Magnet {
    Vector at, m;
    Number size, single;
};
CUDA_CALLABLE inline Number broadcast(Real n) { return Number(n); }
CUDA_CALLABLE inline Magnet magnets(const NearArrays& a, int i) {
    const size_t stride = a.moment_stride;
    const Real* row = a.packed + i;
    return {{numbers(row), numbers(row + stride), numbers(row + 2 * stride)},
            a.own_moment(i),
            numbers(row + 3 * stride),
            numbers(a.single + i)};
}
// Moment j, the same in all lanes.
CUDA_CALLABLE inline Magnet magnet(const NearArrays& a, int j) {
    const size_t stride = a.moment_stride;
    const Real* row = a.packed + j;
    auto at = [=](int n) -> Number { return broadcast(row[n * stride]); };
    return {{at(0), at(1), at(2)}, {at(4), at(5), at(6)}, at(3), broadcast(a.single[j])};
}

// Pass 0: finds a ball that encloses the positions of CHUNK moments that take part, and their largest radius.
CUDA_CALLABLE inline void find_bounds(const NearArrays& a, int i) {
    if (i % CHUNK != 0 || share() > 0) return;
    const size_t stride = a.moment_stride;
    Real low[3] = {0, 0, 0}, high[3] = {0, 0, 0}, largest = -1;
    for (int j = i; j < i + CHUNK; ++j) {
        if (a.single[j] < 0) continue;
        const Real* row = a.packed + j;
        for (int c = 0; c < 3; ++c) {
            const Real x = row[c * stride];
            low[c] = largest < 0 || x < low[c] ? x : low[c];
            high[c] = largest < 0 || x > high[c] ? x : high[c];
        }
        largest = row[3 * stride] > largest ? row[3 * stride] : largest;
    }
    Real* const bounds = a.bounds + BOUND_ROWS * (i / CHUNK);
    Real square = 0;
    for (int c = 0; c < 3; ++c) {
        bounds[c] = Real(0.5) * (low[c] + high[c]);
        square += (high[c] - low[c]) * (high[c] - low[c]);
    }
    bounds[3] = Real(0.5) * wp::sqrt(square);
    bounds[4] = largest;
}

// Calls visit(j, is_partner) for partners j of moments i at x with radii ``size``. Partners of balls are permanent
// moments; partners of ``permanent`` moments are balls. The mask ``is_partner`` has the lanes of i for which j is a
// partner.
template <class Visit>
CUDA_CALLABLE inline void for_each_partner(const NearArrays& a, int i, Vector x, Number size, bool permanent,
                                           Visit visit) {
    int begin[WIDTH], end[WIDTH], first = a.balls, last = 0;
    for (int l = 0; l < WIDTH; ++l) {
        const bool selected = (a.group[i + l] < 0) == permanent;
        begin[l] = selected ? a.partner_begin[i + l] : 0;
        end[l] = selected ? a.partner_end[i + l] : 0;
        if (begin[l] == end[l]) continue;
        first = begin[l] < first ? begin[l] : first;
        last = end[l] > last ? end[l] : last;
    }
    const Number low = number_of(indices(begin)), high = number_of(indices(end));
    for (int start = first / CHUNK * CHUNK; start < last; start += CHUNK) {
        const Real* const bounds = a.bounds + BOUND_ROWS * (start / CHUNK);
        const Vector r = Vector{broadcast(bounds[0]), broadcast(bounds[1]), broadcast(bounds[2])} - x;
        const Number reach = MAGNET_REACH_HIGH * (permanent ? broadcast(bounds[4]) : size) + bounds[3];
        if (!any((high > low) & (dot(r, r) < reach * reach))) continue;
        const int stop = start + CHUNK < last ? start + CHUNK : last;
        for (int j = (start > first ? start : first) + share(); j < stop; j += SHARES)
            visit(j, (low <= Real(j)) & (high > Real(j)));
    }
}

// Moment divided by R³, in steps that stay in float32's range.
CUDA_CALLABLE inline Vector scale_moment(Vector m, Number inverse_radius) {
    return inverse_radius * (inverse_radius * (inverse_radius * m));
}

// Pass 1: finds the response of balls.
CUDA_CALLABLE inline void find_response(const NearArrays& a, int i) {
    const Magnet own = magnets(a, i);
    const Number zero = own.size * Real(0), size = own.size > zero ? own.size : zero + 1;
    const Number inverse_radius = 1 / size;
    Number sums[FULL];
    for (int c = 0; c < FULL; ++c) sums[c] = zero;
    for_each_partner(a, i, own.at, size, false, [&](int j, Mask is_partner) {
        if (a.group[j] >= 0 || a.single[j] < 0) return; // no magnet
        const Magnet o = magnet(a, j);
        const MomentView s = view_moment(o.at - own.at, inverse_radius, o.size, o.single, is_partner);
        if (any(s.live)) add_derivatives(sums, s, scale_moment(o.m, inverse_radius));
    });
    for (int c = 0; c < FULL; ++c) sums[c] = group_sum(sums[c]);
    if (share() > 0) return;
    const Real* const sources = a.expansion ? rows_at(a.expansion, EXPANSION_ROWS, i) : nullptr;
    write_response(rows_at(a.response, RESPONSE_ROWS, i), sources, sums, differential_slope(a, i));
}

// Force of the field of sources on the response of balls [μ0/4π R³].
CUDA_CALLABLE inline Vector source_force(const NearArrays& a, int i) {
    const Real* const response = rows_at(a.response, RESPONSE_ROWS, i);
    const Real* const slopes = rows_at(a.expansion, EXPANSION_ROWS, i) + TENSOR_ROWS * CHUNK;
    const Number zero = Number(Real(0));
    Vector total = {zero, zero, zero};
    for (int row = 0; row < TENSOR_ROWS; ++row)
        total += numbers(response + row * CHUNK) * own_vector(slopes + 3 * row * CHUNK);
    return total;
}

// Pass 2: adds the forces on balls, opposite to their forces on permanent moments.
CUDA_CALLABLE inline void add_ball_forces(const NearArrays& a, int i) {
    const Magnet own = magnets(a, i);
    const Number zero = own.size * Real(0), size = own.size > zero ? own.size : zero + 1;
    const Number inverse_radius = 1 / size;
    const Real* rows = rows_at(a.response, RESPONSE_ROWS, i);
    Vector total = {zero, zero, zero};
    for_each_partner(a, i, own.at, size, false, [&](int j, Mask is_partner) {
        if (a.group[j] >= 0 || a.single[j] < 0) return; // no magnet
        const Magnet o = magnet(a, j);
        const MomentView s = view_moment(o.at - own.at, inverse_radius, o.size, o.single, is_partner);
        if (!any(s.live)) return;
        auto response = [=](int row) -> Number { return numbers(rows + row * CHUNK); };
        total -= magnet_force(response, s, scale_moment(o.m, inverse_radius), o.single).force;
    });
    total = group_sums(size * size * total);
    if (share() > 0) return;
    if (a.expansion) total = total + size * size * size * source_force(a, i);
    add_to(a.forces, i, total, a.movable);
}

// Pass 3: adds the forces and torques on permanent moments.
CUDA_CALLABLE inline void add_magnet_forces(const NearArrays& a, int i) {
    const Magnet own = magnets(a, i);
    const Number zero = own.size * Real(0);
    Vector force = {zero, zero, zero}, torque = force;
    for_each_partner(a, i, own.at, zero, true, [&](int j, Mask is_partner) {
        if (a.group[j] < 0) return;
        const Magnet ball = magnet(a, j);
        const Number size = ball.size, inverse_radius = 1 / size;
        const MomentView s = view_moment(own.at - ball.at, inverse_radius, own.size, own.single, is_partner);
        if (!any(s.live)) return;
        const Real* rows = rows_at(a.response, RESPONSE_ROWS, j);
        auto response = [=](int row) -> Number { return broadcast(rows[row * CHUNK]); };
        const MagnetForce part = magnet_force(response, s, scale_moment(own.m, inverse_radius), own.single);
        force += size * size * part.force;
        torque += cross(own.m, part.field);
    });
    force = group_sums(force);
    torque = group_sums(torque);
    if (share() > 0) return;
    add_to(a.forces, i, force, a.magnet_movable);
    add_to(a.torques, i, torque, a.magnet_movable);
}

// The four passes above, once per evaluation of forces.
struct NonuniformField {
    const NearArrays a;
    CUDA_CALLABLE void operator()(int pass, int i) const {
        if (pass == 0) find_bounds(a, i);
        if (pass == 1) find_response(a, i);
        if (pass == 2) add_ball_forces(a, i);
        if (pass == 3) add_magnet_forces(a, i);
    }
};
}
