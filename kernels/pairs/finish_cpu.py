"""What follows the pair loops on a CPU: sums of ``field`` and ``wrench`` finished a vector of rows at a time.

Rows may be anybody's: what belongs to a moment is looked up.
"""

from functools import cache

import warp as wp

from warpmag.kernels.pairs.moment_code import moment_text
from warpmag.kernels.pairs.pair_terms import WIDTHS, Quantity
from warpmag.kernels.shared.vector_text import passes_text
from warpmag.kernels.shared.team import MOMENTS_PER_THREAD, team, threads_for, wide_registers

_ROWS = """
    const int rows = arrays.target.shape[0], parts = arrays.partial.shape[0];
    const size_t target_pitch = arrays.targets.strides[0] / sizeof(REAL);
    const size_t source_pitch = arrays.sources.strides[0] / sizeof(REAL);
    struct Rows { int first, held; INDEX i, begin, end; };
    auto rows_from = [=](int first) -> Rows {
        const int left = rows - first, held = left < WIDTH ? left : WIDTH;
        Rows at = {first, held, target[first], begin[first], begin[first]};
        for (int l = 0; l < held; ++l)
            at.i[l] = target[first + l], at.begin[l] = begin[first + l], at.end[l] = end[first + l];
        return at;
    };
    auto own = [=](const Rows& at, int c) { return collect(targets + c * target_pitch, at.i); };
    auto own_place = [=](const Rows& at) -> Vector { return {own(at, 0), own(at, 1), own(at, 2)}; };
    // sums ``offset`` to ``offset`` + 2 of all parts
    auto added = [=](const Rows& at, int offset) -> Vector {
        Vector total = {0, 0, 0};
        for (int part = 0; part < parts; ++part) {
            const REAL* const row = partial + SUMS * ((size_t)part * arrays.partial.shape[1] + at.first) + offset;
            if constexpr (SUMS == 3) {
                total = sum(total, vectors(row, at.held));
            } else {
                for (int l = 0; l < at.held; ++l)
                    total.x[l] += row[SUMS * l], total.y[l] += row[SUMS * l + 1], total.z[l] += row[SUMS * l + 2];
            }
        }
        return total;
    };
    // calls meet(j, separation, radius, overlapping) for the sources that overlap targets
    auto meet_overlapping = [=](const Rows& at, Vector x, NUMBER radius, auto meet) {
        walk(overlap, overlap_count, at.i, at.held, at.begin, at.end, [&](INDEX j, MASK listed) {
            auto place = [=](int c) { return collect(sources + c * source_pitch, j); };
            const Vector r = {x.x - place(0), x.y - place(1), x.z - place(2)};
            const NUMBER other = place(3), contact = radius + other;
            meet(j, r, other, listed & (dot(r, r) < contact * contact));
        });
    };
    auto moment_of = [=](INDEX j) -> Vector {
        return {collect(sources + 4 * source_pitch, j), collect(sources + 5 * source_pitch, j),
                collect(sources + 6 * source_pitch, j)};
    };
    auto put_each = [](REAL* out, const Rows& at, Vector v) {
        for (int l = 0; l < at.held; ++l) {
            REAL* const own = out + 3 * (size_t)at.i[l];
            own[0] = v.x[l], own[1] = v.y[l], own[2] = v.z[l];
        }
    };
    auto each = [=](const REAL* of, const Rows& at) -> Vector {
        return {collect(of, 3 * at.i), collect(of + 1, 3 * at.i), collect(of + 2, 3 * at.i)};
    };
"""

_FINISH_FIELD = """
    if (i >= rows) return;
    const Rows at = rows_from(i);
    const Vector x = own_place(at);
    const NUMBER radius = own(at, 3);
    Vector h = added(at, 0);
    meet_overlapping(at, x, radius, [&](INDEX j, Vector r, NUMBER other, MASK overlapping) {
        if (arrays.same_set) overlapping &= mask_of(j != at.i);
        add_lacking(h, r, radius, other, moment_of(j), overlapping);
    });
    put_each(out, at, sum(each(base, at), scaled(INVERSE_4PI, h)));
"""

_FINISH_WRENCH = """
    if (i >= rows) return;
    const Rows at = rows_from(i);
    const Vector x = own_place(at);
    const NUMBER radius = own(at, 3), label = own(at, 7);
    const size_t pitch = arrays.effective.strides[0] / sizeof(REAL);
    const Vector e = {collect(effective, at.i), collect(effective + pitch, at.i), collect(effective + 2 * pitch, at.i)};
    Vector f = added(at, 0), h = {0, 0, 0};
    if (SUMS == 6) h = added(at, 3);
    meet_overlapping(at, x, radius, [&](INDEX j, Vector r, NUMBER other, MASK overlapping) {
        const MASK strange = overlapping & (label != collect(sources + 7 * source_pitch, j));
        const Vector m = moment_of(j);
        add_lacking_force(f, r, radius, other, m, e, strange);
        if (SUMS == 6) add_lacking(h, r, radius, other, m, strange);
    });
    put_each(out, at, scaled(MU0 * INVERSE_4PI, f));
    Vector torque = {0, 0, 0};
    if (SUMS == 6) {
        INDEX turned = 0;
        for (int l = 0; l < at.held; ++l) turned[l] = twisted[at.i[l]];
        add_where(mask_of(turned == 1), torque, scaled(MU0, cross(e, sum(scaled(INVERSE_4PI, h), each(base, at)))));
    }
    put_each(torques, at, torque);
"""


@cache
def _arrays_type(dtype):
    """Type of what the passes are given."""
    vec3 = wp.types.vector(3, dtype)

    @wp.struct
    class FinishArrays:
        target: wp.array[int]
        begin: wp.array[int]
        end: wp.array[int]
        partial: wp.array3d[dtype]
        targets: wp.array2d[dtype]
        sources: wp.array2d[dtype]
        overlap: wp.array2d[int]
        overlap_count: wp.array[int]
        base: wp.array[vec3]
        effective: wp.array2d[dtype]
        twisted: wp.array[int]
        out: wp.array[vec3]
        torques: wp.array[vec3]
        same_set: int

    return FinishArrays


@cache
def _kernel(dtype, quantity: Quantity, numbers: tuple):
    arrays_type = _arrays_type(dtype)
    real = "float" if dtype is wp.float32 else "double"
    text = passes_text(
        real,
        1,
        {"SUMS": WIDTHS[quantity]},
        dict(numbers),
        ("target", "begin", "end", "overlap", "overlap_count", "twisted"),
        ("partial", "targets", "sources", "base", "effective", "out", "torques"),
        moment_text(real) + _ROWS,
        _FINISH_FIELD if quantity == Quantity.FIELD else _FINISH_WRENCH,
        balls="(arrays.target.shape[0] + LANES - 1) / LANES * LANES",
    )

    @wp.func_native(text)
    def make_passes(
        thread: int, first: int, last: int, threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_registers())
    def finish_sums(threads: int, team: wp.array2d[wp.uint64], arrays: arrays_type):
        make_passes(0, 0, 1, threads, team, arrays)

    return finish_sums


def launch_finish(
    rows, partial, targets, sources, same_set, base, out, *, effective=None, twisted=None, torques=None, **numbers
):
    """Finish the sums of the pair loop over ``rows``.

    Args:
        rows: Work list.
        partial: Its sums.
        targets: Packed targets with their overlapping sources (``warpmag.packed.PackedMoments``).
        sources: Packed sources.
        same_set: Whether targets and sources are the same moments.
        base: Field to start from [A/m], shape [t].
        out: Out, field [A/m] or forces [N], shape [t].
        effective: Effective moments of forces [A·m²], shape [3, t].
        twisted: Whether a moment feels its torque, shape [t].
        torques: Out, torques [N·m], shape [t].
        numbers: Constants of nature by their names in the text.
    """
    arrays = _arrays_type(targets.dtype)()
    arrays.target, arrays.begin, arrays.end, arrays.partial = rows.target, rows.begin, rows.end, partial
    arrays.targets, arrays.sources, arrays.same_set = targets.packed, sources.packed, int(same_set)
    arrays.overlap, arrays.overlap_count = targets.overlaps, targets.overlap_counts
    arrays.base, arrays.out = base, out
    if effective is not None:
        arrays.effective, arrays.twisted, arrays.torques = effective, twisted, torques
    wp.launch(
        _kernel(targets.dtype, rows.quantity, tuple(numbers.items())),
        dim=1,
        inputs=[threads_for(rows.count, MOMENTS_PER_THREAD), team(), arrays],
        device="cpu",
    )
