"""Steps of small bodies as a whole, added to the field before each step of the accelerated θ flow.

The residual of a body's moments, r = k H/Ms − s, becomes r + w (Q − 1) r with the inverse Q of the body's own operator
(``warpmag.shapes.body_response``). The flow then takes its usual step, and estimates the error of the body as a whole.
Q belongs to χ = ∞ without saturation, and to bodies that do not intersect. Let d be the mean of (k/3) ‖M‖/(Ms ‖s‖) over
the body, and e that of 2 k o_i (``theta_flow.py``) beyond contact. Where Q divides a mode by λ, λ' = 1 − d (1 − λ) + e
would be right. So w = (1/λ' − 1)/(1/λ − 1) with the least λ of the body, and at least 0, exceeds the factor of no mode.
After a step that the flow rejects, w is 0 for some solves.

Sweeps leave out the pairs within such a body. Letters in contact take half as many evaluations as with sweeps alone.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.induction.solve_state import state_type
from warpmag.kernels.induction.theta_flow import FLOW_STEP

_CONTACT = 0.2
"""Twice the volume over its own that a cell's ball shares with balls of bodies in contact, up to which e is 0."""


@cache
def _kernels(dtype):
    """Kernels that write the residuals of cells, and that add the change of the field by the residuals of a body."""
    vec3, mat33, quaternion = wp.types.vector(3, dtype), wp.types.matrix((3, 3), dtype), wp.types.quaternion(dtype)
    vec2, state_struct, ball = wp.types.vector(2, dtype), state_type(dtype), 4.0 / 3.0 * np.pi

    @wp.func
    def rests(state: state_struct, world: int) -> bool:
        return state.worlds[world].active == 0 or state.worlds[world].apart > 0

    @wp.kernel(module="unique", enable_backward=False)
    def write_residuals(
        cell: wp.array[wp.vec4i],
        rotation: wp.array[quaternion],
        state: state_struct,
        residuals: wp.array[vec3],
        ratios: wp.array[vec2],
    ):
        row = cell[wp.tid()]
        j = row[0]
        if rests(state, row[3]):
            return
        s, radius, slope, full = state.s[j], state.packed[3, j], state.slope[j], dtype(1.0)
        residual = slope / state.saturation[j] * state.h[j] - s
        residuals[j] = wp.quat_rotate_inv(rotation[row[1]], residual)
        most = dtype(wp.static(ball)) * radius * radius * radius * state.saturation[j] * wp.length(s)
        share = wp.where(most > dtype(0.0), wp.min(wp.length(state.moments[j]) / most, full), full)
        stiffness = dtype(wp.static(2.0 * FLOW_STEP)) / state.step[j] - full
        excess = wp.max(stiffness - slope * dtype(wp.static(2.0 / 3.0 + _CONTACT)), dtype(0.0))
        ratios[j] = vec2(share * slope / dtype(3.0), excess)

    @wp.kernel(module="unique", enable_backward=False)
    def add_changes(
        cell: wp.array[wp.vec4i],
        body: wp.array[wp.vec2i],
        gain: wp.array[dtype],
        table: wp.array[mat33],
        rotation: wp.array[quaternion],
        state: state_struct,
        residuals: wp.array[vec3],
        ratios: wp.array[vec2],
    ):
        row = cell[wp.tid()]
        if rests(state, row[3]):
            return
        i, cells, response, ratio, full = row[0], body[row[1]], vec3(), vec2(), dtype(1.0)
        for k in range(cells[1]):
            response += table[row[2] + k] * residuals[cells[0] + k]
            ratio += ratios[cells[0] + k]
        largest, count = gain[row[1]], dtype(cells[1])
        least = full + ratio[1] / count - ratio[0] / count * largest / (full + largest)
        weight = wp.max(full / least - full, dtype(0.0)) / largest
        state.h[i] += weight * state.saturation[i] / state.slope[i] * wp.quat_rotate(rotation[row[1]], response)

    return write_residuals, add_changes


class BodySteps:
    """Steps of bodies as a whole, repeatedly in the same arrays.

    Args:
        bodies: For each body its first moment, the index of its rotation, Q − 1 in its frame, shape [n, 3, n, 3], and
            the largest eigenvalue of Q − 1. Bodies with the same array share it.
        worlds: World of each body.
        rotations: Rotations from the frames of bodies to the world (x, y, z, w).
        state: State of the solve (``solve_state``), bound to its moments.
    """

    def __init__(self, bodies: Sequence[tuple[int, int, np.ndarray, float]], worlds, rotations, state):
        """Lay out the tables on the device of the state."""
        device, dtype = state.h.device, state.packed.dtype
        ranges, gains = np.zeros((len(rotations), 2), np.int32), np.zeros(len(rotations))
        tables, begins, size, cells = [], {}, 0, []
        for (first, number, response, gain), world in zip(bodies, worlds, strict=True):
            count = len(response)
            if id(response) not in begins:
                begins[id(response)], size = size, size + count * count
                tables.append(response.transpose(0, 2, 1, 3).reshape(-1, 3, 3))
            own = np.arange(count)
            columns = first + own, np.full(count, number), begins[id(response)] + count * own, np.full(count, world)
            cells.append(np.stack(columns, axis=1))
            ranges[number], gains[number] = (first, count), gain

        def put(values, kind):
            return wp.array(values, dtype=kind, device=device)

        cell = put(np.concatenate(cells).astype(np.int32), wp.vec4i)
        mat33 = wp.types.matrix((3, 3), dtype)
        tables = cell, put(ranges, wp.vec2i), put(gains, dtype), put(np.concatenate(tables), mat33), rotations, state
        buffers = wp.zeros_like(state.h), wp.zeros(len(state.h), dtype=wp.types.vector(2, dtype), device=device)
        arguments = (cell, rotations, state, *buffers), (*tables, *buffers)
        self._launches = [
            wp.launch(kernel, dim=len(cell), inputs=inputs, device=device, record_cmd=True)
            for kernel, inputs in zip(_kernels(dtype), arguments, strict=True)
        ]

    def launch(self):
        """Launch the change of the field at the moments of the bodies."""
        for launch in self._launches:
            launch.launch()
