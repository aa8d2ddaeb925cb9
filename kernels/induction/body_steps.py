"""Steps of bodies as a whole, added to the field before each step of the accelerated θ flow.

The residual of a body's moments, r = k H/Ms − s, becomes r + w (Q − 1) r with the inverse Q of the body's own operator
(``warpmag.shapes.body_response``). The flow then takes its usual step. Q r is the error of a lone body, and ⟨r, Q r⟩
the square of its energy norm, by which solves end (``theta_step.h``).

Q belongs to χ = ∞ without saturation, and to bodies that do not intersect. Let d be the mean of (k/3) ‖M‖/(Ms ‖s‖) over
the body, and e that of 2 k o_i (``theta_flow.py``) beyond contact. Where Q divides a mode by λ, λ' = 1 − d (1 − λ) + e
would be right. So w = (1/λ' − 1)/(1/λ − 1) with the least λ of the body, and at least 0, exceeds the factor of no mode.
After a step that the flow rejects, w is 0 for some solves.

Sweeps leave out the pairs within such a body. Letters in contact take half as many evaluations as with sweeps alone, a
plate on a magnet a quarter. The elements of Q − 1 are halves of words, the upper halves of float32: steps need no more
digits, and reading the table takes most of the time.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.induction.solve_state import state_type
from warpmag.kernels.induction.theta_flow import FLOW_STEP
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.pieces import cut
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

WRITE_RESIDUALS, WRITE_WEIGHTS, CHANGE_FIELD = range(3)  # the passes, in order; as in ``body_steps.h``
_CONTACT = 0.2
"""Twice the volume over its own that a cell's ball shares with balls of bodies in contact, up to which e is 0."""
_MEMBERS = 8
"""Bodies with the same table that threads of a GPU compute together."""
_FEW_THREADS = 2
"""Threads of a GPU that share a cell of such bodies: a warp reads neighboring words of the table."""
_PRODUCTS_PER_THREAD = 200_000
"""Products of a tensor and a residual per thread of a CPU, at least: some 50 µs of work."""


@cache
def _steps_type(dtype):
    """Struct of tables, bodies, and buffers."""
    quaternion = wp.types.quaternion(dtype)

    @wp.struct
    class BodyStepArrays:
        table: wp.array[int]  # Q − 1 of all kinds of bodies, two elements a word (:func:`_packed_table`)
        body: wp.array[wp.vec4i]  # by groups: first moment, cells or 0, index of the rotation, world
        group: wp.array[wp.vec4i]  # members, number of cells, first entry of the table, first cell in ``residual``
        body_chunk: wp.array[wp.vec2i]  # body and first of up to CHUNK cells
        group_chunk: wp.array[wp.vec2i]  # group and first of up to CHUNK cells
        gain: wp.array[dtype]  # largest eigenvalue of Q − 1 of each body
        rotation: wp.array[quaternion]  # from the frames of bodies to the world (x, y, z, w)
        residual: wp.array[dtype]  # residuals in the frames of the bodies, shape [cells of groups, 3, members]
        weight: wp.array[dtype]  # w of each body
        state: state_type(dtype)

    return BodyStepArrays


def _packed_table(response: np.ndarray) -> np.ndarray:
    """Return Q − 1 in words, shape [chunks of targets, pairs of sources, 9, CHUNK], from its shape [n, 3, n, 3].

    The lower half of a word belongs to the first source of a pair, the upper half to the second.
    """
    count = len(response)
    chunks, pairs = -(-count // CHUNK), -(-count // 2)
    halves = np.zeros((chunks * CHUNK, 3, 2 * pairs, 3), np.uint16)
    halves[:count, :, :count] = response
    # chunk, lane, row, pair, half, column -> chunk, pair, row, column, lane, half
    halves = halves.reshape(chunks, CHUNK, 3, pairs, 2, 3).transpose(0, 3, 2, 5, 1, 4)
    return np.ascontiguousarray(halves).view(np.int32).reshape(chunks, pairs, 9, CHUNK)


@cache
def _kernel(dtype, members: int, group: int):
    call = "add_body_steps(thread, first, last, threads, team.data, steps)"
    arguments = {**PASS_ARGUMENTS, "steps": _steps_type(dtype)}
    constants = dict(MEMBERS=members, GROUP=group, FLOW_STEP=FLOW_STEP, CONTACT=_CONTACT)
    return native_kernel(call, "induction/body_steps.h", arguments, dtype=dtype, **constants)


class BodySteps:
    """Steps of bodies as a whole, repeatedly in the same arrays.

    Args:
        bodies: For each body its first moment, the index of its rotation, Q − 1 in its frame as the upper halves of
            float32, shape [n, 3, n, 3], and the largest eigenvalue of Q − 1. Bodies with the same array share it.
        worlds: World of each body.
        rotations: Rotations from the frames of bodies to the world (x, y, z, w).
        state: State of the solve (``solve_state``), bound to its moments.
    """

    def __init__(self, bodies: Sequence[tuple[int, int, np.ndarray, float]], worlds, rotations, state):
        """Lay out the tables on the device of the state."""
        device, dtype = state.h.device, state.packed.dtype
        kinds: dict[int, list[int]] = {}
        for number, (_, _, response, _) in enumerate(bodies):
            kinds.setdefault(id(response), []).append(number)
        is_shared = device.is_cuda and len(bodies) >= _MEMBERS * len(kinds)
        members = _MEMBERS if is_shared else 1
        self._steps = steps = _steps_type(dtype)()
        state.h_change = wp.zeros_like(state.h)
        steps.rotation, steps.state = rotations, state
        self._lay_out(bodies, worlds, kinds.values(), members, device)
        group = _FEW_THREADS if is_shared else group_threads(device)
        products = sum(len(response) ** 2 for _, _, response, _ in bodies)
        threads, kernel = threads_for(products, _PRODUCTS_PER_THREAD), _kernel(dtype, members, group)
        items = CHUNK * len(steps.body_chunk), len(steps.body), CHUNK * len(steps.group_chunk)
        ranges = [(k, k) for k in range(CHANGE_FIELD + 1)] if device.is_cuda else [(WRITE_RESIDUALS, CHANGE_FIELD)]
        self._launches = []
        for first, last in ranges:
            sizes = dict(device=device, threads=threads, gpu_threads=group * items[first])
            self._launches.append(launch_passes(kernel, first, last + 1, steps, record_cmd=True, **sizes))

    def _lay_out(self, bodies, worlds, kinds, members: int, device):
        """Fill the arrays; ``kinds`` are the indices of the bodies of each table."""
        steps, rows, gains, groups, tables, entries, first_cell = self._steps, [], [], [], [], 0, 0
        for numbers in kinds:
            response = bodies[numbers[0]][2]
            count, table = len(response), _packed_table(response)
            for begin in range(0, len(numbers), members):
                part = numbers[begin : begin + members]
                groups.append((len(part), count, entries, first_cell))
                first_cell += 2 * table.shape[1]
                rows += [(bodies[n][0], count, bodies[n][1], worlds[n]) for n in part]
                gains += [bodies[n][3] for n in part]
                rows += [(0, 0, 0, 0)] * (members - len(part))
                gains += [1.0] * (members - len(part))
            tables.append(table.reshape(-1))
            entries += table.shape[0] * table.shape[1]
        counts = np.array(rows)[:, 1], np.array(groups)[:, 1]

        def put(values, kind):
            return wp.array(np.asarray(values), dtype=kind, device=device)

        def chunks(count):
            number, offset, _ = cut(np.zeros(len(count), int), count, CHUNK)
            return put(np.stack([number, offset], axis=1).astype(np.int32), wp.vec2i)

        dtype = steps.rotation.dtype._wp_scalar_type_
        steps.table, steps.gain = put(np.concatenate(tables), wp.int32), put(gains, dtype)
        steps.body, steps.group = (put(np.array(table, np.int32), wp.vec4i) for table in (rows, groups))
        steps.body_chunk, steps.group_chunk = (chunks(count) for count in counts)
        steps.residual = wp.zeros(3 * members * first_cell, dtype=dtype, device=device)
        steps.weight = wp.zeros(len(rows), dtype=dtype, device=device)

    def launch(self):
        """Launch the change of the field at the moments of the bodies."""
        for launch in self._launches:
            launch.launch()
