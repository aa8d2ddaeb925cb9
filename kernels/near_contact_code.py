"""Text of the near-contact model's passes over the pairs, the same for a CPU and a GPU.

A pass walks the slots of the balls' lists. On a CPU a vector has a ball in each lane; on a GPU ``WAYS`` threads share
the slots of one. All arrays have the balls along their last axis, padded to ``LANES``; a slot that a ball does not use
is zero.
"""

from warpmag.near_contact import RANGE

LANES = 16
"""Multiple that the number of balls is padded to: lanes of the widest vectors."""
WAYS = 8
"""Threads of a GPU that share a ball's slots."""
NEAR = 32
"""Slots for near balls; balls that do not overlap have at most about 24."""
CONTACTS = 16
"""Slots for those that nearly touch."""

PAIR_ROWS = 11
"""Rows of a near pair: direction to the other ball; U_sr, g1 d, g1, g2 d², g3 d³; 1/d; the quadrupoles' window, w'."""
CONTACT_ROWS = 20
"""Rows of a contact: direction to the other ball; A to P, then D', J' and L' that the other ball sees."""
SLOPE_ROWS = 15
"""Rows of a contact's derivatives: of A to P by the distance; 1/d."""
STATE_ROWS = 14
"""Rows of what sweeps move: q, N and xx, yy, xy, yz, zx of n_Θ, the contact sources; the same of Θ̃."""
DRIVE_ROWS = 14
"""Rows of the drives: φ, e_m and e_Θ; what Θ̃ moves towards."""
OUTER_ROWS = 13
"""Rows of what does not change from pass to pass: parts of φ, of e_m and of the tensor that Θ feels; (M_sr a)_m."""

OWN_SOURCE, OWN_DIPOLE = 1.0 - 1.2 * 2.0 / RANGE, 1.0 - (2.0 / RANGE) ** 3
"""M of a ball of unit radius on itself."""
_LEAST, _MOST = 0.4, 4.0
"""Between these lie the eigenvalues of what sweeps solve for, in piles of any permeability, touching or overlapping."""
_PACE = 4.0 / (_MOST**0.5 + _LEAST**0.5) ** 2
_MOMENTUM = ((_MOST**0.5 - _LEAST**0.5) / (_MOST**0.5 + _LEAST**0.5)) ** 2

_PRELUDE = """
#if defined(__CUDA_ARCH__)
    typedef REAL NUMBER;
    typedef int INDEX;
    struct Vector { NUMBER x, y, z; };
    auto gather = [](const REAL* row, INDEX j) -> NUMBER { return row[j]; };
    const int way = threadIdx.x % WAYS;
    auto total_of = [](NUMBER part) -> NUMBER {
        const unsigned mates = ((1u << WAYS) - 1u) << (threadIdx.x % 32 / WAYS * WAYS);
        for (int other = 1; other < WAYS; other *= 2) part += __shfl_xor_sync(mates, part, other);
        return part;
    };
    auto most = [](INDEX count) -> int { return count; };
    auto numbers = [](const REAL* row) -> NUMBER { return *row; };
    auto indices = [](const int* row) -> INDEX { return *row; };
    auto put = [](REAL* row, NUMBER n) { *row = n; };
    auto own_moment = [=](int i) -> Vector {
        return {moment[i], moment[i + moment_stride], moment[i + 2 * moment_stride]};
    };
#else
    constexpr int WIDTH = 64 / (int)sizeof(REAL), way = 0;
    typedef REAL NUMBER __attribute__((ext_vector_type(WIDTH)));
    typedef int INDEX __attribute__((ext_vector_type(WIDTH)));
    struct Vector { NUMBER x, y, z; };
    auto gather = [](const REAL* row, INDEX j) -> NUMBER {
        NUMBER lanes = 0;
#if defined(__AVX512F__)
        GATHER
#else
        for (int l = 0; l < WIDTH; ++l) lanes[l] = row[j[l]];
#endif
        return lanes;
    };
    auto total_of = [](NUMBER part) -> NUMBER { return part; };
    auto most = [](INDEX count) -> int {
        int largest = 0;
        for (int l = 0; l < WIDTH; ++l) largest = count[l] > largest ? count[l] : largest;
        return largest;
    };
    auto numbers = [](const REAL* row) -> NUMBER { NUMBER n; __builtin_memcpy(&n, row, sizeof(n)); return n; };
    auto indices = [](const int* row) -> INDEX { INDEX n; __builtin_memcpy(&n, row, sizeof(n)); return n; };
    auto put = [](REAL* row, NUMBER n) { __builtin_memcpy(row, &n, sizeof(n)); };
    // moments are not padded
    auto own_moment = [=](int i) -> Vector {
        INDEX j;
        for (int l = 0; l < WIDTH; ++l) j[l] = i + l < moment_count ? i + l : moment_count - 1;
        return {gather(moment, j), gather(moment + moment_stride, j), gather(moment + 2 * moment_stride, j)};
    };
#endif
    struct Tensor { NUMBER xx, yy, xy, yz, zx; };  // symmetric, traceless
    auto dot = [](Vector a, Vector b) -> NUMBER { return a.x * b.x + a.y * b.y + a.z * b.z; };
    auto times = [](Tensor t, Vector a) -> Vector {
        return {t.xx * a.x + t.xy * a.y + t.zx * a.z, t.xy * a.x + t.yy * a.y + t.yz * a.z,
                t.zx * a.x + t.yz * a.y - (t.xx + t.yy) * a.z};
    };
    auto vector_at = [=](const REAL* rows, int stride, INDEX j) -> Vector {
        return {gather(rows, j), gather(rows + stride, j), gather(rows + 2 * stride, j)};
    };
    auto tensor_at = [=](const REAL* rows, int stride, INDEX j) -> Tensor {
        return {gather(rows, j), gather(rows + stride, j), gather(rows + 2 * stride, j), gather(rows + 3 * stride, j),
                gather(rows + 4 * stride, j)};
    };
    auto own_vector = [=](const REAL* rows, int stride) -> Vector {
        return {numbers(rows), numbers(rows + stride), numbers(rows + 2 * stride)};
    };
    auto own_tensor = [=](const REAL* rows, int stride) -> Tensor {
        return {numbers(rows), numbers(rows + stride), numbers(rows + 2 * stride), numbers(rows + 3 * stride),
                numbers(rows + 4 * stride)};
    };
"""

_DRIVE = """
    // e = M ã, what quadrupoles move towards, and 4π H_near = (M_sr a − e)_m. What balls make that do not touch, and
    // what moments make, is summed by the first pass only, for the others to start from.
    auto drive_of = [=](int i, bool first) {
        const int contact_slots = most(indices(contact_count + i)), slots = most(indices(count + i));
        const NUMBER zero = numbers(radius + i) * REAL(0);
        NUMBER phi = zero;
        Vector e = {zero, zero, zero}, lone = e;
        NUMBER gxx = zero, gyy = zero, gzz = zero, gxy = zero, gyz = zero, gzx = zero;
        auto meet = [&](int s, bool with_moments) {
            const REAL* pair = pairs + ((size_t)s * PAIR_ROWS) * stride + i;
            auto row = [=](int r) -> NUMBER { return numbers(pair + (size_t)r * stride); };
            const INDEX j = indices(near + (size_t)s * stride + i);
            const Vector u = own_vector(pair, stride), m = vector_at(moment, moment_stride, j);
            const Vector n = vector_at(contact + stride, stride, j), t = {m.x - n.x, m.y - n.y, m.z - n.z};
            const Tensor theta = tensor_at(left, stride, j);
            const NUMBER q = -gather(contact, j), along = dot(u, t), source = row(4), g1 = row(5), g2 = row(6);
            const NUMBER inverse = row(8), square = inverse * inverse, w = row(9);
            const NUMBER k3 = REAL(1.0 / 3.0) * w * g2, k4 = w * square * square, k5 = k4 * inverse;
            const Vector v = times(theta, u);
            const NUMBER f = dot(v, u);
            phi += row(3) * q + source * along + k3 * f;
            const NUMBER pull = 5 * k4 * f - source * q - g2 * along;
            e.x += pull * u.x - g1 * t.x - 2 * k4 * v.x;
            e.y += pull * u.y - g1 * t.y - 2 * k4 * v.y;
            e.z += pull * u.z - g1 * t.z - 2 * k4 * v.z;
            if (with_moments) {
                const NUMBER lone_pull = -g2 * dot(u, m);
                lone.x += lone_pull * u.x - g1 * m.x;
                lone.y += lone_pull * u.y - g1 * m.y;
                lone.z += lone_pull * u.z - g1 * m.z;
            }
            const NUMBER c = k3 * q - 5 * k4 * along + REAL(35.0 / 3.0) * k5 * f;
            const NUMBER k = 2 * k4, b = REAL(-20.0 / 3.0) * k5, own = REAL(2.0 / 3.0) * k5;
            const Vector y = {k * t.x + b * v.x + c * u.x, k * t.y + b * v.y + c * u.y, k * t.z + b * v.z + c * u.z};
            gxx += u.x * y.x + own * theta.xx;
            gyy += u.y * y.y + own * theta.yy;
            gzz += u.z * y.z - own * (theta.xx + theta.yy);
            gxy += REAL(0.5) * (u.x * y.y + u.y * y.x) + own * theta.xy;
            gyz += REAL(0.5) * (u.y * y.z + u.z * y.y) + own * theta.yz;
            gzx += REAL(0.5) * (u.z * y.x + u.x * y.z) + own * theta.zx;
        };
        NUMBER* const sums[OUTER_ROWS] = {
            &phi, &e.x, &e.y, &e.z, &gxx, &gyy, &gzz, &gxy, &gyz, &gzx, &lone.x, &lone.y, &lone.z};
        if (first) {
            for (int s = contact_slots + way; s < slots; s += WAYS) meet(s, true);
            for (int c = 0; c < 10; ++c) {
                *sums[c] = total_of(*sums[c]);
                if (way == 0) put(outer + (size_t)c * stride + i, *sums[c]);
                else *sums[c] = zero;
            }
            for (int s = way; s < contact_slots; s += WAYS) meet(s, true);
        } else {
            for (int c = 0; c < 10 && way == 0; ++c) *sums[c] = numbers(outer + (size_t)c * stride + i);
            for (int s = way; s < contact_slots; s += WAYS) meet(s, false);
        }
        for (int c = 0; c < 13; ++c) *sums[c] = total_of(*sums[c]);
        if (way > 0) return;
        for (int c = 10; c < 13; ++c) {
            if (first) put(outer + (size_t)c * stride + i, *sums[c]);
            else *sums[c] = numbers(outer + (size_t)c * stride + i);
        }
        const NUMBER inverse = 1 / numbers(radius + i), cube = inverse * inverse * inverse;
        const NUMBER source = OWN_SOURCE * inverse, dipole = OWN_DIPOLE * cube;
        const Vector m = own_moment(i), n = own_vector(contact + stride + i, stride);
        phi -= source * numbers(contact + i);
        e = {e.x + dipole * (m.x - n.x), e.y + dipole * (m.y - n.y), e.z + dipole * (m.z - n.z)};
        lone = {lone.x + dipole * m.x, lone.y + dipole * m.y, lone.z + dipole * m.z};
        const REAL* taken = contact + 4 * (size_t)stride + i;
        const NUMBER p = numbers(polarizability + i), fifth = cube * inverse * inverse, trace = gxx + gyy + gzz;
        const NUMBER felt[5] = {REAL(1.5) * gxx - REAL(0.5) * trace, REAL(1.5) * gyy - REAL(0.5) * trace,
                                REAL(1.5) * gxy, REAL(1.5) * gyz, REAL(1.5) * gzx};
        put(drive + i, phi);
        put(drive + stride + i, e.x);
        put(drive + 2 * stride + i, e.y);
        put(drive + 3 * stride + i, e.z);
        for (int c = 0; c < 5; ++c) {
            const NUMBER own = numbers(taken + (size_t)c * stride);
            put(drive + (4 + c) * (size_t)stride + i, (1 - p) * (felt[c] - fifth * own));
            put(drive + (9 + c) * (size_t)stride + i, (p - 1) * own - p * felt[c] / fifth);
        }
        put(field + i, lone.x - e.x);
        put(field + stride + i, lone.y - e.y);
        put(field + 2 * stride + i, lone.z - e.z);
    };
"""

# What a ball sees of a contact, its own drive and that of the other ball.
_SEEN = """
    struct Seen { NUMBER phi, alpha, gamma; Vector field, pull; };  // R e_m, and R² e_Θ times the direction
    auto seen = [=](NUMBER phi, Vector e, Tensor t, NUMBER size, Vector u, int sign) -> Seen {
        const Vector v = times(t, u), field = {size * e.x, size * e.y, size * e.z};
        const NUMBER square = size * size;
        const Vector pull = {square * v.x, square * v.y, square * v.z};
        return {phi, sign * dot(field, u), dot(pull, u), field, pull};
    };
    auto seen_own = [=](int i, NUMBER size, Vector u) -> Seen {
        return seen(numbers(drive + i), own_vector(drive + stride + i, stride),
                    own_tensor(drive + 4 * (size_t)stride + i, stride), size, u, 1);
    };
    auto seen_other = [=](INDEX j, Vector u) -> Seen {
        return seen(gather(drive, j), vector_at(drive + stride, stride, j),
                    tensor_at(drive + 4 * (size_t)stride, stride, j), gather(radius, j), u, -1);
    };
"""

_TAKE = """
    // n towards ΔC e, and Θ̃ towards its place, by a heavy ball's step
    auto take = [=](int i) {
        const int slots = most(indices(contact_count + i));
        const NUMBER size = numbers(radius + i), zero = size * REAL(0);
        NUMBER goal[STATE_ROWS] = {zero, zero, zero, zero, zero, zero, zero, zero, zero};
        for (int s = way; s < slots; s += WAYS) {
            const REAL* rows = contacts + ((size_t)s * CONTACT_ROWS) * stride + i;
            const INDEX j = indices(touching + (size_t)s * stride + i);
            const Vector u = own_vector(rows, stride);
            const NUMBER w = numbers(weight + i) * gather(weight, j);
            NUMBER f[CONTACT_ROWS - 3];
            for (int c = 0; c < CONTACT_ROWS - 3; ++c) f[c] = w * numbers(rows + (size_t)(3 + c) * stride);
            const Seen a = seen_own(i, size, u), b = seen_other(j, u);
            goal[0] += f[0] * a.phi + f[1] * b.phi + f[2] * a.alpha + f[3] * b.alpha + f[8] * a.gamma + f[9] * b.gamma;
            const NUMBER along = f[2] * a.phi + f[14] * b.phi + (f[4] - f[6]) * a.alpha + (f[5] + f[7]) * b.alpha
                + f[10] * a.gamma + f[11] * b.gamma;
            goal[1] += size * (along * u.x + f[6] * a.field.x + f[7] * b.field.x);
            goal[2] += size * (along * u.y + f[6] * a.field.y + f[7] * b.field.y);
            goal[3] += size * (along * u.z + f[6] * a.field.z + f[7] * b.field.z);
            const NUMBER pull = f[8] * a.phi + f[15] * b.phi + f[10] * a.alpha + f[16] * b.alpha + f[12] * a.gamma
                + f[13] * b.gamma;
            const NUMBER turned = REAL(1.5) * size * size * pull, third = REAL(0.5) * size * size * pull;
            goal[4] += turned * u.x * u.x - third;
            goal[5] += turned * u.y * u.y - third;
            goal[6] += turned * u.x * u.y;
            goal[7] += turned * u.y * u.z;
            goal[8] += turned * u.z * u.x;
        }
        for (int c = 0; c < 9; ++c) goal[c] = total_of(goal[c]);
        if (way > 0) return;
        for (int c = 0; c < 5; ++c) goal[9 + c] = numbers(drive + (9 + c) * (size_t)stride + i);
        for (int c = 0; c < STATE_ROWS; ++c) {
            const size_t place = (size_t)c * stride + i;
            const NUMBER now = numbers(contact + place);
            const NUMBER pace = PACE * (c < 4 ? numbers(ease + (c > 0) * stride + i) : zero + 1);
            const NUMBER moved = now + pace * (goal[c] - now) + MOMENTUM * (now - numbers(last_contact + place));
            put(last_contact + place, now);
            put(contact + place, moved - moved == zero ? moved : zero);
        }
    };
"""

_HALVES = """
    // what a ball sees of its contacts' forces: derivatives of ½ e ΔC e by the other ball's place
    auto halve = [=](int i, bool) {
        const int slots = most(indices(contact_count + i));
        const NUMBER size = numbers(radius + i);
        for (int s = way; s < slots; s += WAYS) {
            const REAL* rows = contacts + ((size_t)s * CONTACT_ROWS) * stride + i;
            const REAL* changes = slopes + ((size_t)s * SLOPE_ROWS) * stride + i;
            const INDEX j = indices(touching + (size_t)s * stride + i);
            const Vector u = own_vector(rows, stride);
            const NUMBER w = numbers(weight + i) * gather(weight, j);
            auto f = [=](int c) -> NUMBER { return numbers(rows + (size_t)(3 + c) * stride); };
            auto g = [=](int c) -> NUMBER { return numbers(changes + (size_t)c * stride); };
            const Seen a = seen_own(i, size, u), b = seen_other(j, u);
            const NUMBER square = dot(a.field, a.field) - a.alpha * a.alpha;
            const NUMBER mixed = dot(a.field, b.field) + a.alpha * b.alpha;
            // what both share counts half for each
            const NUMBER doubled = a.phi * (g(0) * a.phi + g(1) * b.phi) + a.alpha * (g(4) * a.alpha + g(5) * b.alpha)
                + g(6) * square + g(7) * mixed + a.gamma * (g(12) * a.gamma + g(13) * b.gamma);
            const NUMBER radial = REAL(0.5) * doubled
                + a.phi * (g(2) * a.alpha + g(3) * b.alpha + g(8) * a.gamma + g(9) * b.gamma)
                + a.alpha * (g(10) * a.gamma + g(11) * b.gamma);
            const NUMBER by_alpha = f(2) * a.phi + f(14) * b.phi + (f(4) - f(6)) * a.alpha + (f(5) + f(7)) * b.alpha
                + f(10) * a.gamma + f(11) * b.gamma;
            const NUMBER by_gamma = 2 * (f(8) * a.phi + f(15) * b.phi + f(10) * a.alpha + f(16) * b.alpha
                + f(12) * a.gamma + f(13) * b.gamma);
            const NUMBER inverse = g(14);
            const NUMBER rest = w * radial - w * inverse * (by_alpha * a.alpha + by_gamma * a.gamma);
            const NUMBER x = w * inverse * by_alpha, y = w * inverse * by_gamma;
            REAL* out = halves + ((size_t)s * 3) * stride + i;
            put(out, rest * u.x + x * a.field.x + y * a.pull.x);
            put(out + stride, rest * u.y + x * a.field.y + y * a.pull.y);
            put(out + 2 * (size_t)stride, rest * u.z + x * a.field.z + y * a.pull.z);
        }
    };
"""

_PULL = """
    // forces, in units of μ0/4π: of the short-range parts, of quadrupoles and of contacts
    auto pull = [=](int i) {
        const NUMBER zero = numbers(radius + i) * REAL(0);
        Vector total = {zero, zero, zero};
        const Vector m = own_moment(i), n = own_vector(contact + stride + i, stride);
        const Vector t = {m.x - n.x, m.y - n.y, m.z - n.z};
        const NUMBER q = -numbers(contact + i);
        const Tensor theta = own_tensor(left + i, stride);
        const int near_slots = most(indices(count + i));
        for (int s = way; s < near_slots; s += WAYS) {
            const REAL* pair = pairs + ((size_t)s * PAIR_ROWS) * stride + i;
            auto row = [=](int r) -> NUMBER { return numbers(pair + (size_t)r * stride); };
            const INDEX j = indices(near + (size_t)s * stride + i);
            const Vector u = own_vector(pair, stride), m_j = vector_at(moment, moment_stride, j);
            const Vector n_j = vector_at(contact + stride, stride, j);
            const Vector t_j = {m_j.x - n_j.x, m_j.y - n_j.y, m_j.z - n_j.z};
            const Tensor theta_j = tensor_at(left, stride, j);
            const NUMBER q_j = -gather(contact, j), source = row(4), g1 = row(5), g2 = row(6), third = row(7);
            const NUMBER inverse = row(8), second = g2 * inverse;

            // dipoles: of what is left of them, less the actual ones
            const NUMBER a = dot(u, t), a_j = dot(u, t_j), lone = dot(u, m), lone_j = dot(u, m_j);
            const NUMBER among = (second * t.x) * t_j.x + (second * t.y) * t_j.y + (second * t.z) * t_j.z
                - (second * m.x) * m_j.x - (second * m.y) * m_j.y - (second * m.z) * m_j.z;
            NUMBER radial = source * q * q_j + q * g2 * a_j - q_j * g2 * a - among - (third * a) * a_j
                + (third * lone) * lone_j;
            const NUMBER on = g1 * q - second * a, on_j = -(g1 * q_j + second * a_j);
            total.x += on * t_j.x + on_j * t.x + second * (lone * m_j.x + lone_j * m.x);
            total.y += on * t_j.y + on_j * t.y + second * (lone * m_j.y + lone_j * m.y);
            total.z += on * t_j.z + on_j * t.z + second * (lone * m_j.z + lone_j * m.z);

            // quadrupoles: derivatives of their energy by the distance and by the direction
            const NUMBER w = row(9), slope = row(10), square = inverse * inverse, fourth = square * square;
            const Vector v = times(theta, u), v_j = times(theta_j, u);
            const NUMBER f = dot(v, u), f_j = dot(v_j, u);
            const NUMBER on_sources = q * f_j + q_j * f, k3 = REAL(1.0 / 3.0) * g2;
            const NUMBER on_dipoles = 5 * (a * f_j - a_j * f) - 2 * (dot(t, v_j) - dot(t_j, v));
            const NUMBER fifth = fourth * inverse;  // first, or else products of moments overflow
            const Tensor part = {fifth * theta_j.xx, fifth * theta_j.yy, fifth * theta_j.xy, fifth * theta_j.yz,
                                 fifth * theta_j.zx};
            const Vector v_part = {fifth * v_j.x, fifth * v_j.y, fifth * v_j.z};
            const NUMBER product = part.xx * theta.xx + part.yy * theta.yy
                + (part.xx + part.yy) * (theta.xx + theta.yy)
                + 2 * (part.xy * theta.xy + part.yz * theta.yz + part.zx * theta.zx);
            const NUMBER energy_4 = fourth * on_dipoles;
            const NUMBER energy_5 = (2 * product - 20 * dot(v, v_part) + 35 * (fifth * f_j) * f) * REAL(1.0 / 3.0);
            const Vector z = times(theta, t_j), z_j = times(theta_j, t), x = times(theta, v_part), x_j = times(part, v);
            auto turned = [=](NUMBER t, NUMBER t_j, NUMBER v, NUMBER v_j, NUMBER z, NUMBER x) -> NUMBER {
                return 2 * k3 * (q * v_j + q_j * v)
                    + fourth * (5 * (f_j * t - f * t_j) + 10 * (a * v_j - a_j * v) - 2 * z)
                    + REAL(70.0 / 3.0) * ((fifth * f_j) * v + (fifth * v_j) * f) - REAL(20.0 / 3.0) * x;
            };
            const Vector turn = {turned(t.x, t_j.x, v.x, v_j.x, z_j.x - z.x, x.x + x_j.x),
                                 turned(t.y, t_j.y, v.y, v_j.y, z_j.y - z.y, x.y + x_j.y),
                                 turned(t.z, t_j.z, v.z, v_j.z, z_j.z - z.z, x.z + x_j.z)};
            radial += slope * (k3 * on_sources + energy_4 + energy_5)
                + w * REAL(1.0 / 3.0) * (third + 2 * second) * on_sources
                - w * inverse * (4 * energy_4 + 5 * energy_5 + dot(turn, u));
            total.x += radial * u.x + w * inverse * turn.x;
            total.y += radial * u.y + w * inverse * turn.y;
            total.z += radial * u.z + w * inverse * turn.z;
        }
        const int contact_slots = most(indices(contact_count + i));
        for (int s = way; s < contact_slots; s += WAYS) {
            const REAL* own = halves + ((size_t)s * 3) * stride + i;
            const Vector other = vector_at(halves, stride, indices(mirror + (size_t)s * stride + i));
            total = {total.x + other.x - numbers(own), total.y + other.y - numbers(own + stride),
                     total.z + other.z - numbers(own + 2 * (size_t)stride)};
        }
        total = {total_of(total.x), total_of(total.y), total_of(total.z)};
        if (way > 0) return;
        put(force + i, total.x);
        put(force + stride + i, total.y);
        put(force + 2 * (size_t)stride + i, total.z);
    };
"""


# On a GPU a launch is one pass, and ``WAYS`` threads share a ball's slots. A CPU makes all passes in one launch: its
# threads, of the process's own library since a launch may sit inside a graph, take chunks of balls as they come, and go
# on to the next pass when all chunks of the last are done. A thread that cannot be had is not missed.
_RUN = """
#if defined(__CUDA_ARCH__)
    if (only % 2 == 0) FIRST(thread / WAYS, only == 0);
    else SECOND(thread / WAYS);
#else
    constexpr int CHUNK = 4 * WIDTH, MOST_PASSES = 8, MOST_THREADS = 64;
    auto chunk_of = [&](int pass, int chunk) {
        const int end = chunk * CHUNK + CHUNK < stride ? chunk * CHUNK + CHUNK : stride;
        for (int i = chunk * CHUNK; i < end; i += WIDTH) {
            if (pass % 2 == 0) FIRST(i, pass == 0);
            else SECOND(i);
        }
    };
    struct Team { const decltype(chunk_of)* work; int passes, chunks, next[MOST_PASSES], done[MOST_PASSES]; };
    Team team = {&chunk_of, passes, (stride + CHUNK - 1) / CHUNK, {}, {}};
#if !defined(_WIN32)
#if defined(__APPLE__)
    #define SYMBOL(name) "_" name
#else
    #define SYMBOL(name) name
#endif
    typedef void* (*Start)(void*);
    extern int start_thread(unsigned long*, const void*, Start, void*) __asm__(SYMBOL("pthread_create"));
    extern int join_thread(unsigned long, void**) __asm__(SYMBOL("pthread_join"));
    extern int yield_thread() __asm__(SYMBOL("sched_yield"));
    #undef SYMBOL
#else
    auto yield_thread = [] {};
#endif
    auto join_in = [](void* argument) -> void* {
        Team& team = *(Team*)argument;
        for (int pass = 0; pass < team.passes; ++pass) {
            for (int c; (c = __atomic_fetch_add(&team.next[pass], 1, __ATOMIC_RELAXED)) < team.chunks;) {
                (*team.work)(pass, c);
                __atomic_fetch_add(&team.done[pass], 1, __ATOMIC_RELEASE);
            }
            while (__atomic_load_n(&team.done[pass], __ATOMIC_ACQUIRE) < team.chunks) yield_thread();
        }
        return nullptr;
    };
#if defined(_WIN32)
    join_in(&team);
#else
    unsigned long ids[MOST_THREADS];
    bool started[MOST_THREADS];
    const int others = (threads < MOST_THREADS ? threads : MOST_THREADS) - 1;
    for (int t = 0; t < others; ++t) started[t] = start_thread(&ids[t], nullptr, join_in, &team) == 0;
    join_in(&team);
    for (int t = 0; t < others; ++t)
        if (started[t]) join_thread(ids[t], nullptr);
#endif
#endif
"""


def _text(real: str, first: str, second: str, names: tuple[str, ...], body: str) -> str:
    """Text of a native function: its arrays by name, the definition of two passes, and how they are run."""
    pointers = "".join(
        f"    auto* const {name} = {name}_in.data;\n"
        if name in _INTEGERS
        else f"    REAL* const {name} = (REAL*){name}_in.data;\n"
        for name in names
    )
    run = _RUN.replace("FIRST", first).replace("SECOND", second)
    return f"""
    typedef {real} REAL;
    #if defined(__CUDA_ARCH__)
    constexpr int WAYS = {WAYS};
    #else
    constexpr int WAYS = 1;
    #endif
    constexpr int PAIR_ROWS = {PAIR_ROWS}, CONTACT_ROWS = {CONTACT_ROWS}, SLOPE_ROWS = {SLOPE_ROWS};
    constexpr int STATE_ROWS = {STATE_ROWS}, OUTER_ROWS = {OUTER_ROWS};
    constexpr REAL OWN_SOURCE = {OWN_SOURCE!r}, OWN_DIPOLE = {OWN_DIPOLE!r}, PACE = {_PACE!r}, MOMENTUM = {_MOMENTUM!r};
    const int stride = weight_in.shape[0], moment_count = packed_in.shape[1];
    const int moment_stride = packed_in.strides[0] / sizeof(REAL);
    const REAL* const moment = (const REAL*)packed_in.data + 4 * (size_t)moment_stride;
{pointers}    const REAL* const left = contact + 9 * (size_t)stride;  // Θ̃
{_PRELUDE.replace("GATHER", _GATHER[real])}{body}{run}"""


# in which clang does not recognise a gather by itself
_GATHER = {
    "float": "lanes = __builtin_ia32_gathersiv16sf(lanes, row, j, (unsigned short)-1, sizeof(REAL));",
    "double": "lanes = __builtin_ia32_gathersiv8df(lanes, row, j, (unsigned char)-1, sizeof(REAL));",
}
_INTEGERS = ("near", "count", "touching", "contact_count", "mirror")
SWEEP_ARRAYS = (
    *("near", "pairs", "count", "touching", "contacts", "contact_count", "radius", "polarizability", "weight", "ease"),
    *("contact", "last_contact", "drive", "field", "outer"),
)
FORCE_ARRAYS = (
    *("near", "pairs", "count", "touching", "contacts", "contact_count", "slopes", "mirror", "radius", "weight"),
    *("contact", "drive", "halves", "force"),
)


def sweep_text(real: str) -> str:
    """Text of sweeps over contact sources and quadrupoles."""
    return _text(real, "drive_of", "take", SWEEP_ARRAYS, _DRIVE + _SEEN + _TAKE)


def force_text(real: str) -> str:
    """Text of the forces."""
    return _text(real, "halve", "pull", FORCE_ARRAYS, _SEEN + _HALVES + _PULL)
