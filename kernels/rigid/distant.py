"""Bodies of iron with few moments while every other magnet is far from them: the choice by worlds, and the cells.

Two systems have the moments of all bodies: one with the cells of these bodies, one with few moments in their place. In
each world one system is solved and the other rests. The few moments act where all bodies are far from other moments,
and no moment comes near saturation, which cells reach one by one. A body changes to its few moments only beyond
``_RETURN`` times the distance at which it returns to its cells, so that it does not change back and forth.
"""

import warp as wp

from warpmag.kernels.rigid.bodies import BodyMoments
from warpmag.kernels.rigid.newton_views import body_pose

wp.set_module_options({"enable_backward": False})

_RETURN = 1.1
"""Ratio of the distances at which a body changes to few moments, and back to cells."""
_LINEAR = 0.45, 0.55
"""Largest magnetization of the cells at which a body changes to few moments, and of these at which it keeps them, in
saturations."""
_THREADS = 32  # threads of a GPU that measure the distances from a body


@wp.struct
class DistantBodies:
    """Bodies with few moments, b of them with n cells and k moments in all, in the frames of the bodies."""

    body: wp.array[wp.int32]  # body of the model, -1 for the world, shape [b]
    world: wp.array[wp.int32]  # world, shape [b]
    own: wp.array[wp.vec2i]  # range of its few moments in their system, shape [b]
    sources: wp.array[wp.vec2i]  # range of all moments of its world in that system, shape [b]
    lower: wp.array[wp.vec3]  # corners of a box around the cells [m], shape [b]
    upper: wp.array[wp.vec3]
    reach: wp.array[float]  # distance of other moments from the box at which it returns to cells [m], shape [b]
    table: wp.array[wp.vec3i]  # first entries of its shape in ``coefficients`` and ``patterns``, and n, shape [b]
    coefficients: wp.array[float]  # from few moments to strengths of patterns, shapes [patterns, 3 k], flat
    patterns: wp.array[float]  # magnetizations of cells at unit strengths, shapes [3, patterns, n], flat
    pattern_count: int
    strengths: wp.array2d[float]  # strengths of the patterns, shape [b, patterns]
    same: wp.array[wp.int32]  # for each of the few moments, one of the same magnet in the system of cells
    rotation: wp.array[wp.int32]  # index of its rotation in the system of few moments, shape [b]
    source: wp.array[wp.int32]  # the same moment of the other system, or -1, for moments of the system of cells
    cell: wp.array[wp.vec2i]  # the body and its cell, or -1, for these moments
    moment_world: wp.array[wp.int32]  # world of each of these moments


@wp.struct
class WorldChoice:
    """Choice between both systems in w worlds."""

    many_rest: wp.array[wp.int32]  # 1 where the system of cells rests, shape [w]
    few_rest: wp.array[wp.int32]  # 1 where the other one rests, shape [w]
    many_rested: wp.array[wp.int32]  # 1 where the system of cells rested before this choice, shape [w]
    many_begin: wp.array[wp.int32]  # 1 where the system of cells starts to act, shape [w]
    few_begin: wp.array[wp.int32]  # 1 where the other one does, shape [w]
    is_near: wp.array[wp.int32]  # 1 where a body has a magnet near it, or there is no such body, shape [w]
    always_near: wp.array[wp.int32]  # 1 where there is no such body, shape [w]
    saturated: wp.array[wp.int32]  # 1 where a moment came near saturation in the last solve, shape [w]
    any_many_begin: wp.array[wp.int32]  # 1 if the system of cells starts to act in any world, shape [1]
    any_few_begin: wp.array[wp.int32]  # 1 if the other one does, shape [1]
    any_many: wp.array[wp.int32]  # 1 if the system of cells acts in any world, shape [1]
    any_few: wp.array[wp.int32]  # 1 if the other one does, shape [1]


@wp.struct
class SystemArrays:
    """Arrays of a system of n moments in w worlds (``moments.system.MomentSystem``)."""

    positions: wp.array[wp.vec3]  # [m], shape [n]
    radii: wp.array[float]  # [m], shape [n]
    saturation: wp.array[float]  # [A/m], shape [n]
    volumes: wp.array[float]  # [m³], shape [n]
    replaced: wp.array[wp.int32]  # world of moments of bodies with few moments, -1 of others, shape [n]
    moments: wp.array[wp.vec3]  # [A·m²], shape [n]
    external_field: wp.array[wp.vec3]  # [A/m], shape [n]
    rotations: wp.array[wp.quat]  # from the frame of each body of cells to the world's
    error: wp.array[wp.float64]  # shape [w]
    residual: wp.array[wp.float64]
    evaluations: wp.array[wp.int32]
    converged: wp.array[wp.int32]


@wp.kernel
def _begin_choice(choice: WorldChoice, bodies: DistantBodies, many: SystemArrays, few: SystemArrays):
    i = wp.tid()
    if i < choice.is_near.shape[0]:
        choice.is_near[i] = wp.max(choice.always_near[i], choice.saturated[i])
        choice.saturated[i] = 0
    if i < few.external_field.shape[0]:
        few.external_field[i] = many.external_field[bodies.same[i]]
    if i == 0:
        choice.any_many[0] = 0
        choice.any_few[0] = 0
        choice.any_many_begin[0] = 0
        choice.any_few_begin[0] = 0


@wp.kernel
def _measure_distances(
    body_q_in: wp.array[wp.transform],
    bodies: DistantBodies,
    few: SystemArrays,
    threads: int,
    choice: WorldChoice,
):
    b = wp.tid() // threads
    inverse = wp.transform_inverse(body_pose(body_q_in, bodies.body[b]))
    world = bodies.world[b]
    reach = bodies.reach[b]
    if choice.few_rest[world] != 0:
        reach = wp.static(_RETURN) * reach
    near = int(0)
    for i in range(bodies.sources[b][0] + wp.tid() % threads, bodies.sources[b][1], threads):
        if i < bodies.own[b][0] or i >= bodies.own[b][1]:
            x = wp.transform_point(inverse, few.positions[i])
            outside = x - wp.min(wp.max(x, bodies.lower[b]), bodies.upper[b])
            if not wp.length(outside) - few.radii[i] > reach:
                near = 1
    if near == 1:
        wp.atomic_max(choice.is_near, world, 1)


@wp.func
def _act_by_cells(choice: WorldChoice, w: int):
    """Let the system of cells act in a world."""
    rested = choice.many_rested[w]
    choice.many_rest[w] = 0
    choice.few_rest[w] = 1
    choice.many_begin[w] = rested
    wp.atomic_max(choice.any_many_begin, 0, rested)
    wp.atomic_max(choice.any_many, 0, 1)


@wp.kernel
def _choose(allowed: int, choice: WorldChoice):
    w = wp.tid()
    choice.many_rested[w] = choice.many_rest[w]
    choice.many_begin[w] = 0
    choice.few_begin[w] = 0
    if choice.is_near[w] != 0 or allowed == 0:
        _act_by_cells(choice, w)
    else:
        choice.few_begin[w] = choice.few_rest[w]
        wp.atomic_max(choice.any_few_begin, 0, choice.few_rest[w])
        wp.atomic_max(choice.any_few, 0, 1)
        choice.many_rest[w] = 1
        choice.few_rest[w] = 0


@wp.kernel
def _find_saturated(
    moments: SystemArrays, resting: wp.array[wp.int32], limit: float, saturated_out: wp.array[wp.int32]
):
    i = wp.tid()
    world = moments.replaced[i]
    if world < 0:
        return
    if resting[world] == 0 and wp.length(moments.moments[i]) > limit * moments.volumes[i] * moments.saturation[i]:
        wp.atomic_max(saturated_out, world, 1)


@wp.kernel
def _finish_few(choice: WorldChoice, few: SystemArrays, many: SystemArrays):
    w = wp.tid()
    if choice.few_rest[w] != 0:
        return
    many.error[w] = few.error[w]
    many.residual[w] = few.residual[w]
    many.evaluations[w] = few.evaluations[w]
    many.converged[w] = few.converged[w]
    if choice.saturated[w] != 0:
        _act_by_cells(choice, w)


@wp.kernel
def _find_strengths(bodies: DistantBodies, choice: WorldChoice, few: SystemArrays):
    b, pattern = wp.tid()
    if choice.few_rest[bodies.world[b]] != 0:
        return
    rotation = few.rotations[bodies.rotation[b]]
    first = bodies.own[b][0]
    count = bodies.own[b][1] - first
    entry = bodies.table[b][0] + 3 * count * pattern
    total = float(0.0)
    for j in range(count):
        m = wp.quat_rotate_inv(rotation, few.moments[first + j])
        for c in range(3):
            total += bodies.coefficients[entry + 3 * j + c] * m[c]
    bodies.strengths[b, pattern] = total


@wp.kernel
def _spread_moments(
    body_q_in: wp.array[wp.transform],
    magnets: BodyMoments,
    bodies: DistantBodies,
    choice: WorldChoice,
    few: SystemArrays,
    many: SystemArrays,
):
    i = wp.tid()
    if choice.few_rest[bodies.moment_world[i]] != 0:
        return
    many.positions[i] = wp.transform_point(body_pose(body_q_in, magnets.body[i]), magnets.local_positions[i])
    if bodies.source[i] >= 0:
        many.moments[i] = few.moments[bodies.source[i]]
        return
    b = bodies.cell[i][0]
    if b < 0:
        return
    cells = bodies.table[b][2]
    entry = bodies.table[b][1] + bodies.cell[i][1]
    m = wp.vec3()
    for c in range(3):
        for pattern in range(bodies.pattern_count):
            m[c] += bodies.patterns[entry] * bodies.strengths[b, pattern]
            entry += cells
    many.moments[i] = many.volumes[i] * wp.quat_rotate(few.rotations[bodies.rotation[b]], m)


class DistantLaunches:
    """Launches of the choice between two systems of moments, and of the results of one for the other.

    Args:
        bodies: The bodies with few moments.
        choice: The choice of each world, which the launches write.
        magnets: The moments of the system of cells on their bodies.
        many, few: The system of cells, and that of few moments.
    """

    def __init__(
        self,
        bodies: DistantBodies,
        choice: WorldChoice,
        magnets: BodyMoments,
        many: SystemArrays,
        few: SystemArrays,
    ):
        """Record the launches that need no poses."""
        self._bodies, self._choice, self._magnets, self._many, self._few = bodies, choice, magnets, many, few
        self._device, worlds = few.moments.device, len(choice.is_near)

        def record(kernel, dim, *inputs):
            return wp.launch(kernel, dim, inputs=inputs, device=self._device, record_cmd=True)

        self._begin = record(_begin_choice, max(worlds, len(few.moments)), choice, bodies, many, few)
        self._choose = [record(_choose, worlds, allowed, choice) for allowed in (0, 1)]
        self._finish_few = [
            record(_find_saturated, len(few.moments), few, choice.few_rest, _LINEAR[1], choice.saturated),
            record(_finish_few, worlds, choice, few, many),
        ]
        self._finish_many = record(
            _find_saturated, len(many.moments), many, choice.many_rest, _LINEAR[0], choice.saturated
        )
        self._find_strengths = record(_find_strengths, bodies.strengths.shape, bodies, choice, few)

    def choose(self, body_q, *, allowed: bool) -> None:
        """Choose the system of each world from the distances of moments to the bodies at the poses ``body_q``.

        The system with few moments gets the external field of the other one. With ``allowed`` False the system of
        cells acts in all worlds.
        """
        self._begin.launch()
        threads = _THREADS if self._device.is_cuda else 1
        inputs = [body_q, self._bodies, self._few, threads, self._choice]
        wp.launch(_measure_distances, threads * len(self._bodies.body), inputs=inputs, device=self._device)
        self._choose[allowed].launch()

    def finish_few(self) -> None:
        """Copy the results of the solve of few moments, and let cells act where a moment is near saturation."""
        for launch in self._finish_few:
            launch.launch()

    def finish_many(self) -> None:
        """Mark the worlds where a cell is near saturation after a solve of the system of cells."""
        self._finish_many.launch()

    def spread_moments(self, body_q) -> None:
        """Write positions and moments of the system of cells where it rests, at the poses ``body_q``.

        The moments of cells follow from the few moments.
        """
        self._find_strengths.launch()
        inputs = [body_q, self._magnets, self._bodies, self._choice, self._few, self._many]
        wp.launch(_spread_moments, len(self._many.moments), inputs=inputs, device=self._device)
