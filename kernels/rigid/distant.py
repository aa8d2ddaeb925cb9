"""Bodies of iron with few moments while other magnets keep a distance: the choice by worlds, and the cells.

Several systems have the moments of all bodies. The last one has the cells of these bodies, each earlier one, a level,
has few moments in their place: the fewest at level 0, for the largest distances. In each world one system is solved and
the others rest. A level acts where all bodies are far enough from other moments, and no moment comes near saturation,
which cells reach one by one. A world changes to a level of fewer moments only beyond ``_RETURN`` times the distance at
which it returns, so that it does not change back and forth.
"""

import warp as wp

from warpmag.kernels.rigid.bodies import BodyMoments
from warpmag.kernels.rigid.newton_views import body_pose
from warpmag.kernels.shared.launches import RecordedLaunches

wp.set_module_options({"enable_backward": False})

_RETURN = 1.1
"""Ratio of the distances at which a body changes to fewer moments, and back."""
_LINEAR = 0.45, 0.55
"""Largest magnetization of the cells at which a body changes to few moments, and of these at which it keeps them, in
saturations."""
_THREADS = 32  # threads of a GPU that measure the distances from a body


@wp.struct
class DistantBodies:
    """Bodies with few moments at a level, b of them with n cells and k moments in all, in the frames of the bodies."""

    body: wp.array[wp.int32]  # body of the model, -1 for the world, shape [b]
    world: wp.array[wp.int32]  # world, shape [b]
    own: wp.array[wp.vec2i]  # range of its few moments in their system, shape [b]
    sources: wp.array[wp.vec2i]  # range of all moments of its world in that system, shape [b]
    lower: wp.array[wp.vec3]  # corners of a box around the cells [m], shape [b]
    upper: wp.array[wp.vec3]
    reach: wp.array2d[float]  # distance of other moments from the box at which each level ends [m], shape [b, levels]
    table: wp.array[wp.vec3i]  # first entries of its shape in ``coefficients`` and ``patterns``, and n, shape [b]
    coefficients: wp.array[float]  # from few moments to strengths of patterns, shapes [patterns, 3 k], flat
    patterns: wp.array[float]  # magnetizations of cells at unit strengths, shapes [3, patterns, n], flat
    pattern_count: wp.array[wp.int32]  # number of patterns, shape [b]
    strengths: wp.array2d[float]  # strengths of the patterns, shape [b, largest number of patterns]
    same: wp.array[wp.int32]  # for each of the few moments, one of the same magnet in the system of cells
    rotation: wp.array[wp.int32]  # index of its rotation in the system of few moments, shape [b]
    source: wp.array[wp.int32]  # the same moment of the other system, or -1, for moments of the system of cells
    cell: wp.array[wp.vec2i]  # the body and its cell, or -1, for these moments
    moment_world: wp.array[wp.int32]  # world of each of these moments


@wp.struct
class WorldChoice:
    """Choice among s systems, those of the levels and that of cells, in w worlds."""

    level: wp.array[wp.int32]  # number of the system that acts, shape [w]
    before: wp.array[wp.int32]  # that before this choice, shape [w]
    nearest: wp.array[wp.int32]  # the least one that distances and saturation allow, shape [w]
    always_near: wp.array[wp.int32]  # 1 where no body has few moments, shape [w]
    saturated: wp.array[wp.int32]  # 1 where a moment came near saturation in the last solve, shape [w]
    acting: wp.array[wp.int32]  # for each system whether it acts in any world, and starts to do so, shape [2 s]


@wp.struct
class SystemArrays:
    """Arrays of a system of n moments in w worlds (``moments.system.MomentSystem``)."""

    number: int  # of the system
    resting: wp.array[wp.int32]  # 0 where it acts, shape [w]
    begins: wp.array[wp.int32]  # 1 where it starts to act, shape [w]
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
def _begin_choice(choice: WorldChoice):
    i = wp.tid()
    if i < choice.level.shape[0]:
        choice.before[i] = choice.level[i]
        choice.nearest[i] = wp.max(choice.always_near[i], choice.saturated[i]) * (choice.acting.shape[0] // 2 - 1)
        choice.saturated[i] = 0
    if i < choice.acting.shape[0]:
        choice.acting[i] = 0


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
    cells = bodies.reach.shape[1]
    level = int(0)
    for i in range(bodies.sources[b][0] + wp.tid() % threads, bodies.sources[b][1], threads):
        if i < bodies.own[b][0] or i >= bodies.own[b][1]:
            x = wp.transform_point(inverse, few.positions[i])
            outside = x - wp.min(wp.max(x, bodies.lower[b]), bodies.upper[b])
            distance = wp.length(outside) - few.radii[i]
            while level < cells:
                reach = bodies.reach[b, level]
                if level < choice.before[world]:
                    reach = wp.static(_RETURN) * reach
                if distance > reach:
                    break
                level += 1
    if level > 0:
        wp.atomic_max(choice.nearest, world, level)


@wp.kernel
def _choose(allowed: int, choice: WorldChoice):
    w = wp.tid()
    choice.level[w] = choice.nearest[w]
    if allowed == 0:
        choice.level[w] = choice.acting.shape[0] // 2 - 1


@wp.kernel
def _let_act(choice: WorldChoice, system: SystemArrays):
    w = wp.tid()
    acts = int(choice.level[w] == system.number)
    begins = acts * int(choice.before[w] != system.number)
    system.resting[w] = 1 - acts
    system.begins[w] = begins
    if acts != 0:
        wp.atomic_max(choice.acting, 2 * system.number, 1)
    if begins != 0:
        wp.atomic_max(choice.acting, 2 * system.number + 1, 1)


@wp.kernel
def _set_external_field(bodies: DistantBodies, cells: SystemArrays, few: SystemArrays):
    i = wp.tid()
    few.external_field[i] = cells.external_field[bodies.same[i]]


@wp.kernel
def _find_saturated(moments: SystemArrays, limit: float, saturated_out: wp.array[wp.int32]):
    i = wp.tid()
    world = moments.replaced[i]
    if world < 0:
        return
    strength = wp.length(moments.moments[i])
    if moments.resting[world] == 0 and strength > limit * moments.volumes[i] * moments.saturation[i]:
        wp.atomic_max(saturated_out, world, 1)


@wp.kernel
def _finish_few(choice: WorldChoice, few: SystemArrays, cells: SystemArrays):
    w = wp.tid()
    if few.resting[w] != 0:
        return
    cells.error[w] = few.error[w]
    cells.residual[w] = few.residual[w]
    cells.evaluations[w] = few.evaluations[w]
    cells.converged[w] = few.converged[w]
    if choice.saturated[w] != 0:
        choice.level[w] = cells.number
        few.resting[w] = 1


@wp.kernel
def _find_strengths(bodies: DistantBodies, few: SystemArrays):
    b, pattern = wp.tid()
    if few.resting[bodies.world[b]] != 0 or pattern >= bodies.pattern_count[b]:
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
    few: SystemArrays,
    cells: SystemArrays,
):
    i = wp.tid()
    if few.resting[bodies.moment_world[i]] != 0:
        return
    cells.positions[i] = wp.transform_point(body_pose(body_q_in, magnets.body[i]), magnets.local_positions[i])
    if bodies.source[i] >= 0:
        cells.moments[i] = few.moments[bodies.source[i]]
        return
    b = bodies.cell[i][0]
    if b < 0:
        return
    count = bodies.table[b][2]
    entry = bodies.table[b][1] + bodies.cell[i][1]
    m = wp.vec3()
    for c in range(3):
        for pattern in range(bodies.pattern_count[b]):
            m[c] += bodies.patterns[entry] * bodies.strengths[b, pattern]
            entry += count
    cells.moments[i] = cells.volumes[i] * wp.quat_rotate(few.rotations[bodies.rotation[b]], m)


class DistantLaunches:
    """Launches of the choice among systems of moments, and of the results of one for the others.

    Args:
        bodies: The bodies with few moments at each level.
        choice: The choice of each world, which the launches write.
        magnets: The moments of the system of cells on their bodies.
        systems: The systems of the levels, and that of cells.
    """

    def __init__(
        self, bodies: list[DistantBodies], choice: WorldChoice, magnets: BodyMoments, systems: list[SystemArrays]
    ):
        """Record the launches that need no poses."""
        self._bodies, self._choice, self._magnets, self._systems = bodies, choice, magnets, systems
        self._device, worlds = choice.level.device, len(choice.level)
        self._launch = RecordedLaunches()
        levels, cells = list(zip(bodies, systems, strict=False)), systems[-1]

        def record(kernel, dim, *inputs):
            return wp.launch(kernel, dim, inputs=inputs, device=self._device, record_cmd=True)

        self._begin = record(_begin_choice, max(worlds, len(choice.acting)), choice)
        self._choose = [record(_choose, worlds, allowed, choice) for allowed in (0, 1)]
        self._let_act = [record(_let_act, worlds, choice, system) for system in systems]
        self._set_field = [
            record(_set_external_field, len(few.moments), of_level, cells, few) for of_level, few in levels
        ]
        self._find_saturated = [
            record(_find_saturated, len(system.moments), system, _LINEAR[system is not cells], choice.saturated)
            for system in systems
        ]
        self._finish_few = [record(_finish_few, worlds, choice, few, cells) for _, few in levels]
        self._find_strengths = [
            record(_find_strengths, of_level.strengths.shape, of_level, few) for of_level, few in levels
        ]

    def choose(self, body_q, *, allowed: bool) -> None:
        """Choose the system of each world from the distances of moments to the bodies at the poses ``body_q``.

        With ``allowed`` False the system of cells acts in all worlds.
        """
        self._begin.launch()
        threads, bodies = _THREADS if self._device.is_cuda else 1, self._bodies[0]
        inputs = [body_q, bodies, self._systems[0], threads, self._choice]
        self._launch(_measure_distances, threads * len(bodies.body), inputs=inputs, device=self._device)
        self._choose[allowed].launch()
        for launch in self._let_act:
            launch.launch()

    def set_external_field(self, level: int) -> None:
        """Copy the external field of the system of cells to that of a level."""
        self._set_field[level].launch()

    def finish_few(self, level: int) -> None:
        """Copy the results of the solve of a level, and choose cells where one of its moments is near saturation."""
        self._find_saturated[level].launch()
        self._finish_few[level].launch()

    def let_cells_act(self) -> None:
        """Let the system of cells act where it is chosen."""
        self._let_act[-1].launch()

    def finish_cells(self) -> None:
        """Mark the worlds where a cell is near saturation after a solve of the system of cells."""
        self._find_saturated[-1].launch()

    def spread_moments(self, body_q) -> None:
        """Write positions and moments of the system of cells where it rests, at the poses ``body_q``.

        The moments of cells follow from the few moments.
        """
        cells = self._systems[-1]
        for bodies, few, find_strengths in zip(self._bodies, self._systems, self._find_strengths, strict=False):
            find_strengths.launch()
            inputs = [body_q, self._magnets, bodies, few, cells]
            self._launch(_spread_moments, len(cells.moments), inputs=inputs, device=self._device)
