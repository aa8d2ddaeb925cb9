"""Text for passes over moments on a CPU, in the words of ``vector_passes``: their arrays, curves, and pair laws.

Arrays of the public buffers have a vector for each moment, or a number. What a pass needs of the last moments of a
world, where a vector has more lanes than moments are left, is found lane by lane.
"""

from warpmag.kernels.material.curves import CLAMPED, LANGEVIN
from warpmag.kernels.pairs.neighbors import CAPACITY

_TANH_ABOVE = (1.0, 0.13380975, 0.0034955274, 2.0608056e-05, 1.3353217e-08)
_TANH_BELOW = (1.0, 0.46714291, 0.025876754, 0.00032855341, 7.7759703e-07)
"""Polynomials in s² whose quotient is tanh(s)/s for s up to 9, where tanh is 1 in float32: fitted to 2e-8; in float32
they leave 3e-7 at most, 4e-8 in the mean."""


def _polynomial(coefficients, variable: str) -> str:
    """Text of a polynomial, by Horner's scheme."""
    text = f"REAL({coefficients[-1]!r})"
    for coefficient in reversed(coefficients[:-1]):
        text = f"({text} * {variable} + REAL({coefficient!r}))"
    return text


def _shuffled(first: str, second: str, lanes) -> str:
    return f"__builtin_shufflevector({first}, {second}, {', '.join(map(str, lanes))})"


def _parted(width: int) -> str:
    """Text that parts vectors (a, b, c) of x, y and z by turns into one of each."""
    text = []
    for component, name in enumerate("xyz"):
        place = [3 * lane + component for lane in range(width)]
        low = _shuffled("a", "b", [at if at < 2 * width else 0 for at in place])
        text.append(
            f"const NUMBER low_{name} = {low}, {name} = "
            + _shuffled(f"low_{name}", "c", [lane if at < 2 * width else at - width for lane, at in enumerate(place)])
            + ";"
        )
    return " ".join(text)


def _joined(width: int) -> str:
    """Text that joins vectors v.x, v.y, v.z into three (a, b, c) of x, y and z by turns."""
    text = []
    for number, name in enumerate("abc"):
        place = [divmod(number * width + lane, 3) for lane in range(width)]
        low = _shuffled("v.x", "v.y", [[at, width + at, 0][component] for at, component in place])
        lanes = [width + at if component == 2 else lane for lane, (at, component) in enumerate(place)]
        text.append(f"const NUMBER low_{name} = {low}, {name} = {_shuffled(f'low_{name}', 'v.z', lanes)};")
    return " ".join(text)


_ARRAYS = """
    typedef decltype(NUMBER() < NUMBER()) MASK;
    auto mask_of = [](auto condition) -> MASK { return __builtin_convertvector(condition, MASK); };
    // the numbers at ``row`` of the ``held`` first lanes, and another one in the rest
    auto some = [](const REAL* row, int held, REAL other) -> NUMBER {
        NUMBER n = other;
        if (held >= WIDTH) __builtin_memcpy(&n, row, sizeof(n));
        else for (int l = 0; l < held; ++l) n[l] = row[l];
        return n;
    };
    auto put_some = [](REAL* row, int held, NUMBER n) {
        if (held >= WIDTH) __builtin_memcpy(row, &n, sizeof(n));
        else for (int l = 0; l < held; ++l) row[l] = n[l];
    };
    auto vectors = [](const REAL* rows, int held) -> Vector {
        NUMBER a = 0, b = 0, c = 0;
        if (held >= WIDTH) {
            __builtin_memcpy(&a, rows, sizeof(a));
            __builtin_memcpy(&b, rows + WIDTH, sizeof(b));
            __builtin_memcpy(&c, rows + 2 * WIDTH, sizeof(c));
            PARTED
            return {x, y, z};
        }
        for (int l = 0; l < held; ++l) a[l] = rows[3 * l], b[l] = rows[3 * l + 1], c[l] = rows[3 * l + 2];
        return {a, b, c};
    };
    auto put_vectors = [](REAL* rows, int held, Vector v) {
        if (held >= WIDTH) {
            JOINED_VECTORS
            __builtin_memcpy(rows, &a, sizeof(a));
            __builtin_memcpy(rows + WIDTH, &b, sizeof(b));
            __builtin_memcpy(rows + 2 * WIDTH, &c, sizeof(c));
            return;
        }
        for (int l = 0; l < held; ++l) rows[3 * l] = v.x[l], rows[3 * l + 1] = v.y[l], rows[3 * l + 2] = v.z[l];
    };
    auto sum = [](Vector a, Vector b) -> Vector { return {a.x + b.x, a.y + b.y, a.z + b.z}; };
    auto less = [](Vector a, Vector b) -> Vector { return {a.x - b.x, a.y - b.y, a.z - b.z}; };
    auto scaled = [](NUMBER k, Vector a) -> Vector { return {k * a.x, k * a.y, k * a.z}; };
    auto cross = [](Vector a, Vector b) -> Vector {
        return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    };
    auto length = [=](Vector a) -> NUMBER { return root(dot(a, a)); };
"""

_CURVES = f"""
    // see curves.curve_ratio
    auto tanh_ratio = [](NUMBER s) -> NUMBER {{
        if constexpr (sizeof(REAL) == 8) {{
            NUMBER ratio;
            for (int l = 0; l < WIDTH; ++l) ratio[l] = s[l] < REAL(1e-18) ? REAL(1) : __builtin_tanh(s[l]) / s[l];
            return ratio;
        }}
        const NUMBER z = s * s, above = {_polynomial(_TANH_ABOVE, "z")}, below = {_polynomial(_TANH_BELOW, "z")};
        const MASK saturated = s > REAL(9);
        return (saturated ? NUMBER(1) : above) / (saturated ? s : below);
    }};
    auto curve_ratio = [=](NUMBER s, int law) -> NUMBER {{
        if (law == {CLAMPED}) return s > REAL(1) ? 1 / s : NUMBER(1);
        if (law != {LANGEVIN}) return tanh_ratio(s);
        const NUMBER x = 3 * s, z = x * x, safe = x > REAL(0.3) ? x : NUMBER(REAL(0.3));
        const NUMBER series = 1 - z * (REAL(1.0 / 15) - z * (REAL(2.0 / 315) - z * (REAL(1.0 / 1575)
                                - z * REAL(3 / 46777.5))));
        return x > REAL(0.3) ? 3 * (1 / tanh_ratio(safe) - 1) / (safe * safe) : series;
    }};
"""

# 2/√c. On AVX-512 by Newton's steps from an estimate y good to 2⁻¹⁴: root and quotient take the machine twice the time.
_INVERSE_ROOT = {
    "float": """
    auto inverse_root = [](NUMBER c) -> NUMBER {
    #if defined(__AVX512F__)
        const NUMBER y = __builtin_ia32_rsqrt14ps512_mask(c, c, (unsigned short)-1);
        return y * (REAL(3) - c * (y * y));
    #else
        return REAL(2) / __builtin_elementwise_sqrt(c);
    #endif
    };
""",
    "double": """
    auto inverse_root = [](NUMBER c) -> NUMBER {
    #if defined(__AVX512F__)
        NUMBER y = __builtin_ia32_rsqrt14pd512_mask(c, c, (unsigned char)-1);
        y *= REAL(1.5) - REAL(0.5) * c * (y * y);
        return y * (REAL(3) - c * (y * y));
    #else
        return REAL(2) / __builtin_elementwise_sqrt(c);
    #endif
    };
""",
}

_PAIRS = f"""
    INVERSE_ROOT
    struct Factors {{ NUMBER g1, g2, g3; }};
    // see pair_law.averaged_factors
    auto averaged = [=](NUMBER d, NUMBER a, NUMBER b) -> Factors {{
        const NUMBER p = a * b, s = a + b, i1 = 1 / d, i2 = i1 * i1, i3 = i2 * i1, c = 1 / (160 * p * p * p);
        const NUMBER e = s - d, e2 = e * e, e3 = e2 * e, e4 = e2 * e2, q0 = 5 * (a * a + b * b) - 20 * p;
        const NUMBER q = q0 * i1 - 4 * s - d, q1 = -q0 * i2 - 1, q2 = 2 * q0 * i3, q3 = -6 * q0 * i3 * i1;
        const NUMBER w1 = c * (e4 * q1 - 4 * e3 * q) * i1, w2 = c * (12 * e2 * q - 8 * e3 * q1 + e4 * q2) * i2;
        const NUMBER w3 = c * (36 * e2 * q1 - 24 * e * q - 12 * e3 * q2 + e4 * q3) * i3;
        const Factors far = {{w1 - i3, w2 - (w1 - 3 * i3) * i2, w3 - 3 * (w2 - w1 * i2) * i2 - 15 * i3 * i2 * i2}};
        const NUMBER apart2 = (a - b) * (a - b), k = 5 * apart2 * apart2 * (apart2 + 6 * p);
        const NUMBER u1 = 45 * s * s * apart2, u2 = -40 * s * (apart2 + p), u3 = 15 * (apart2 + 2 * p);
        const Factors near = {{c * (2 * u2 + 3 * u3 * d - 5 * d * d * d + (u1 - k * i2) * i1),
                              c * (3 * u3 * i1 - 15 * d + (3 * k * i2 - u1) * i3),
                              c * ((3 * u1 - 15 * k * i2) * i3 * i2 - 3 * u3 * i3 - 15 * i1)}};
        const NUMBER large = larger(a, b);
        const MASK inside = (d * d <= apart2) | (d == 0), apart = d > REAL(0.5) * s;
        return {{inside ? -1 / (large * large * large) : apart ? far.g1 : near.g1,
                inside ? 0 : apart ? far.g2 : near.g2, inside ? 0 : apart ? far.g3 : near.g3}};
    }};
    // see pair_law.overlap_factors; a + b = 1
    auto lacking = [=](NUMBER d, NUMBER a, NUMBER b) -> Factors {{
        const NUMBER e = 1 - d, i = 1 / larger(d, NUMBER(REAL(1e-6)));
        const Factors same = {{e * (e * (2 * e - 6) - 3), e * (9 * i + 6), -e * i * (9 * i * (i + 1) + 15)}};
        const MASK equal = a == b;
        if (!any(!equal)) return same;
        const Factors other = averaged(d, a, b);
        return {{equal ? same.g1 : other.g1 + 1, equal ? same.g2 : other.g2 - 3, equal ? same.g3 : other.g3 + 15}};
    }};
    auto add_where = [](MASK wanted, Vector& to, Vector a) {{
        to.x += wanted ? a.x : 0;
        to.y += wanted ? a.y : 0;
        to.z += wanted ? a.z : 0;
    }};
    // adds 4π times what the fields of moments m at separations r have beyond those of clamped dipoles
    auto add_lacking = [=](Vector& h, Vector r, NUMBER a, NUMBER b, Vector m, MASK overlapping) {{
        const NUMBER unit = 1 / (overlapping ? a + b : NUMBER(1));
        const Vector apart = scaled(unit, r), moment = scaled(unit * unit * unit, m);
        const Factors g = lacking(root(dot(apart, apart)), unit * a, unit * b);
        add_where(overlapping, h, sum(scaled(g.g1, moment), scaled(g.g2 * dot(apart, moment), apart)));
    }};
    // and the same of (e·∇)H
    auto add_lacking_force = [=](Vector& f, Vector r, NUMBER a, NUMBER b, Vector m, Vector e, MASK overlapping) {{
        const NUMBER unit = 1 / (overlapping ? a + b : NUMBER(1));
        const Vector apart = scaled(unit, r), moment = scaled(unit * unit * unit, m);
        const Factors g = lacking(root(dot(apart, apart)), unit * a, unit * b);
        const NUMBER along = dot(apart, e), of = dot(apart, moment);
        const Vector across = sum(scaled(along, moment), scaled(of, e));
        const NUMBER radial = g.g2 * dot(moment, e) + g.g3 * of * along;
        add_where(overlapping, f, scaled(unit, sum(scaled(g.g2, across), scaled(radial, apart))));
    }};
    // adds 4π times their whole field, see neighbors.near_pair
    auto add_field = [=](Vector& h, Vector r, NUMBER a, NUMBER b, Vector m, MASK wanted) {{
        const NUMBER d2 = dot(r, r), s = a + b, s2 = s * s, c = larger(d2, s2);
        const NUMBER i = (wanted & (c > 0)) ? REAL(0.5) * inverse_root(c) : 0, i2 = i * i, i3 = i2 * i;
        const NUMBER along = 3 * i3 * i2 * dot(r, m);
        h.x += along * r.x - i3 * m.x;
        h.y += along * r.y - i3 * m.y;
        h.z += along * r.z - i3 * m.z;
        const MASK overlapping = wanted & (d2 < s2);
        if (any(overlapping)) add_lacking(h, r, a, b, m, overlapping);
    }};
    // see neighbors.pair_overlap
    auto shared_volume = [=](NUMBER d2, NUMBER a, NUMBER b, MASK wanted) -> NUMBER {{
        const NUMBER p = a * b, s = a + b, large = larger(a, b), small = smaller(a, b), apart = large - small;
        const NUMBER d = root(d2), ratio = small / large, e = s - d;
        const NUMBER lens = e * e * (d2 + 2 * d * s - 3 * apart * apart) / (16 * d * p * root(p));
        return (wanted & (d2 < s * s) & (p > 0)) ? (d <= apart ? ratio * root(ratio) : lens) : 0;
    }};
    // calls meet(j, listed) for slot after slot of the lists of ``CAPACITY`` of moments i, as far as they name some of
    // begin to end; where a list is full, for all of these
    auto walk = [=](const int* lists, const int* counts, INDEX i, int held, INDEX begin, INDEX end, auto meet) {{
        INDEX first = 0, count = 0, full = 0;
        int most = 0;
        for (int l = 0; l < held; ++l) {{
            if (end[l] <= begin[l]) continue;
            first[l] = begin[l];
            full[l] = counts[i[l]] > {CAPACITY};
            count[l] = full[l] ? end[l] - begin[l] : counts[i[l]];
            most = count[l] > most ? count[l] : most;
        }}
        for (int s = 0; s < most; ++s) {{
            INDEX j = first;
            for (int l = 0; l < held; ++l)
                if (s < count[l]) j[l] = full[l] ? begin[l] + s : lists[(size_t){CAPACITY} * i[l] + s];
            meet(j, mask_of((count > s) & (j >= begin) & (j < end)));
        }}
    }};
"""


def moment_text(real: str) -> str:
    """Text that defines all of these, for floats or doubles."""
    width = 16 if real == "float" else 8
    text = _ARRAYS.replace("PARTED", _parted(width)).replace("JOINED_VECTORS", _joined(width))
    return text + _CURVES + _PAIRS.replace("INVERSE_ROOT", _INVERSE_ROOT[real])
