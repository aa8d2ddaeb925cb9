"""Collective response of bodies of few cells: the equilibrium of all cells of a body in the field of everything else.

Within a body of highly permeable cells, long waves of magnetization are slow modes of the θ flow. A slender body would
take tens of evaluations of the whole field, and its warm starts several. The coupling of its cells, however, is a
constant matrix T in the body's frame (``kernels.cells``). So after each evaluation the cells respond to the outside
field H − T m, and the field after their response replaces H. One step of Newton's method solves

    s = (k/Ms) (H − T m + T m(s)),    m(s) = V Ms c(‖s‖) ŝ.

The θ flow then continues as for isolated balls, where the response is exact, too. Its residual and error estimate are
those of the response. With E = √(k V D), D the derivative of c(‖s‖) ŝ by s, Newton's step is r + (k/Ms) T E z, where r
is the residual. A few conjugate gradients solve the symmetric positive definite system

    (1 − E T E) z = E r Ms/k.

The coupling between such bodies has no bound like that of balls. The step length ω is therefore halved whenever a step
is rejected; the energy decreases for small enough steps.

A warm start extrapolates the field of everything outside a body, with neighbors at their present positions. The
response is solved for in the present rotation.

Tables hold, for each shape, tensors T_ij [1/m³] between all of its cells. The full tensors come first, then the tensors
of the pair law, which the sums over pairs contain. For each chunk of ``CHUNK`` cells and each cell j there are rows of
``CHUNK`` numbers: xx, yy, zz, xy, xz, yz of symmetric tensors, or xx, xy, xz, yx, ..., if those of any body are not.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.induction.solve_state import DEPTH, state_type
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.shared.native import CHUNK, native_kernel
from warpmag.kernels.shared.team import team, threads_for

MOST_CELLS = 64
"""Most cells of a body with a collective response: work grows as the square, and a GPU's block has few threads."""
_GROUP = 4  # threads of a GPU that share a cell
_BODIES_PER_THREAD = 8  # fewest bodies per thread of a CPU
_ROWS_OF_SYMMETRIC = [0, 3, 4, 3, 1, 5, 4, 5, 2]  # all nine components among the six of a symmetric tensor


@dataclass(frozen=True)
class RespondingBody:
    """A body with a collective response."""

    first: int  # its first moment
    world: int  # its world
    number: int  # index of its rotation
    tensors: np.ndarray  # between its n cells, full ones and those of the pair law [1/m³], shape [2, n, n, 6 or 9]

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.tensors.shape[1]


@cache
def responses_type(dtype):
    """Return the struct of b bodies with a collective response."""
    quaternion = wp.types.quaternion(dtype)

    @wp.struct
    class Bodies:
        body: wp.array[wp.vec4i]  # first moment, number of cells, world, and index of the rotation, shape [b]
        table: wp.array[int]  # begin of the shape's tensors in ``tensor``, shape [b]
        pair_law: wp.array[int]  # offset from there to the tensors of the pair law, shape [b]
        tensor: wp.array[dtype]  # the tables
        rotation: wp.array[quaternion]  # of all bodies with cells (``cells.couplings``)
        past: wp.array2d[quaternion]  # rotations at the last two solves, the last first, shape [2, b]

    return Bodies


@cache
def _kernel(dtype, group: int, components: int):
    call = "respond_all(thread, begin == 1, threads, team.data, bodies, state)"
    arguments = {"begin": int, "threads": int, "team": wp.array2d[wp.uint64]}
    arguments |= {"bodies": responses_type(dtype), "state": state_type(dtype)}
    constants = {"GROUP": group, "CAPACITY": CAPACITY, "DEPTH": DEPTH, "INVERSE_4PI": INVERSE_4PI}
    constants |= {"MOST_CELLS": MOST_CELLS, "RESPONDING": 1, "COMPONENTS": components}
    return native_kernel(call, "induction/body_response.h", arguments, dtype=dtype, **constants)


def _table(tensors: np.ndarray, components: int) -> np.ndarray:
    """Return tensors of a shape, shape [n, n, 6 or 9], in chunks of cells side by side, flat."""
    count = len(tensors)
    padded = np.zeros((-(-count // CHUNK) * CHUNK, count, components))
    padded[:count] = tensors if tensors.shape[2] == components else tensors[:, :, _ROWS_OF_SYMMETRIC]
    return padded.reshape(-1, CHUNK, count, components).transpose(0, 2, 3, 1).reshape(-1)


class BodyResponses:
    """Collective responses of b bodies, in arrays that all launches share.

    Attributes:
        begin: Launch that starts from the response to the extrapolated field.
        respond: Launch that replaces the field at cells by the field after their response.
        cell_count: Cells of all bodies.
    """

    def __init__(self, state, bodies: list[RespondingBody], rotations):
        """Copy the tables to the device, and mark the cells in the state of the solve.

        Bodies with the same ``tensors`` object share a table. ``rotations`` are those of ``CellCouplings``.
        """
        dtype, device = state.packed.dtype, state.h.device
        self._bodies = b = responses_type(dtype)()
        tables, begin, size = [], {}, 0
        self._components = components = max(body.tensors.shape[3] for body in bodies)
        for body in bodies:
            if id(body.tensors) not in begin:
                begin[id(body.tensors)] = size
                tables += [_table(tensors, components) for tensors in body.tensors]
                size += 2 * len(tables[-1])

        def put(values, kind):
            return wp.array(np.asarray(values, np.float64 if kind is dtype else np.int32), dtype=kind, device=device)

        b.body = put([(body.first, body.cell_count, body.world, body.number) for body in bodies], wp.vec4i)
        b.table = put([begin[id(body.tensors)] for body in bodies], wp.int32)
        b.pair_law = put([len(_table(body.tensors[0], components)) for body in bodies], wp.int32)
        b.tensor, b.rotation = put(np.concatenate(tables), dtype), rotations
        b.past = wp.zeros((2, len(bodies)), dtype=wp.types.quaternion(dtype), device=device)
        self.cell_count = sum(body.cell_count for body in bodies)
        responding = np.concatenate([body.first + np.arange(body.cell_count) for body in bodies])
        state.responds.assign(np.isin(np.arange(len(state.responds)), responding).astype(np.int32))
        self.begin, self.respond = (self._record(state, begin, bodies) for begin in (1, 0))

    def _record(self, state, begin: int, bodies: list[RespondingBody]):
        device, dtype, count = state.h.device, state.packed.dtype, len(bodies)
        if device.is_cpu:
            kernel, block, dim, threads = (
                _kernel(dtype, 1, self._components),
                256,
                1,
                threads_for(count, _BODIES_PER_THREAD),
            )
        else:
            block = -(-_GROUP * max(body.cell_count for body in bodies) // 32) * 32
            kernel, dim, threads = _kernel(dtype, _GROUP, self._components), block * count, 0
        inputs = [begin, threads, team() if device.is_cpu else None, self._bodies, state]
        return wp.launch(kernel, dim=dim, inputs=inputs, block_dim=block, device=device, record_cmd=True)

    def persistent_arrays(self) -> dict:
        """Return the arrays that persist from one solve to the next, by name."""
        return {"past": self._bodies.past}
