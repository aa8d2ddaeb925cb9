"""Bodies of few cells respond as wholes: the magnetization that a body takes in the field of all others is solved for.

Within a body of highly permeable cells long waves of magnetization are slow modes of the θ flow: a slender one would
take tens of evaluations of the whole field, and its warm starts several. But what its cells do to each other is a
constant matrix T in its frame (``kernels.cells``). So after each evaluation the field H at a body's cells is replaced
by the one that it would have, had its cells already responded to what is not their own, H − T m, by one step of
Newton's method on

    s = (k/Ms) (H − T m + T m(s)),    m(s) = V Ms c(‖s‖) ŝ.

The θ flow then goes on as with lone balls, whose response is exact, too: its residual is that of the response, and so
is its error estimate. With E = √(k V D), D the derivative of c(‖s‖) ŝ by s, the step is r + (k/Ms) T E z, where r is
the residual and z solves the symmetric positive system

    (1 − E T E) z = E r Ms/k

by a few conjugate gradients. How strongly bodies couple to each other then is not bounded as for balls, so the step
length ω is halved whenever a step has to be taken back; a small enough one descends in energy.

A warm start extrapolates the field of everything outside of a body, its neighbours where they are now, and solves for
the response in the present rotation.

Tables hold, for each shape, tensors T_ij [1/m³] between all of its cells and after them those of the pair law, which
the sums over pairs have in their place: for each chunk of ``CHUNK`` cells and each cell j rows xx, yy, zz, xy, xz, yz
of ``CHUNK`` numbers.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warpmag.kernels.induction.solve_state import DEPTH, state_type
from warpmag.kernels.pairs.neighbors import CAPACITY
from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.shared.native import CHUNK, native_options
from warpmag.kernels.shared.team import team, threads_for

MOST_CELLS = 64
"""Cells of a body that responds as a whole, at most: work grows as the square, and a block of a GPU has few threads."""
_GROUP = 4
"""Threads of a GPU that share a cell."""
_BODIES_PER_THREAD = 8
"""Bodies that make another thread of a CPU worth waking."""


@dataclass(frozen=True)
class WholeBody:
    """A body that responds as a whole.

    Attributes:
        first: Its first moment.
        world: Its world.
        number: Number of its rotation.
        row: Its first row among what demagnetizes cells where bodies overlap.
        tensors: Tensors between its n cells, whole ones and those of the pair law [1/m³], shape [2, n, n, 6].
    """

    first: int
    world: int
    number: int
    row: int
    tensors: np.ndarray

    @property
    def cell_count(self) -> int:
        """Number of cells."""
        return self.tensors.shape[1]


@cache
def responses_type(dtype):
    """Type of the bodies; ``BodyResponses`` says what its arrays are."""
    quaternion = wp.types.quaternion(dtype)

    @wp.struct
    class Bodies:
        body: wp.array[wp.vec4i]
        row: wp.array[int]
        table: wp.array[int]
        law: wp.array[int]
        tensor: wp.array[dtype]
        hardness: wp.array[dtype]
        rotation: wp.array[quaternion]
        past: wp.array2d[quaternion]

    return Bodies


@cache
def _kernel(dtype, group: int):
    state_struct, bodies_struct = state_type(dtype), responses_type(dtype)
    constants = {"GROUP": group, "CAPACITY": CAPACITY, "DEPTH": DEPTH, "INVERSE_4PI": INVERSE_4PI}
    constants |= {"MOST_CELLS": MOST_CELLS, "RESPONDING": 1}

    @wp.func_native("warpmag::respond_all(thread, begin == 1, threads, team.data, bodies, state);")
    def respond_all(
        thread: int, begin: int, threads: int, team: wp.array2d[wp.uint64], bodies: bodies_struct, state: state_struct
    ): ...

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options=native_options("induction/body_response.h", dtype=dtype, **constants),
    )
    def respond(begin: int, threads: int, team: wp.array2d[wp.uint64], bodies: bodies_struct, state: state_struct):
        respond_all(wp.tid(), begin, threads, team, bodies, state)

    return respond


def _table(tensors: np.ndarray) -> np.ndarray:
    """Tensors of a shape, shape [n, n, 6], in chunks of cells side by side, flat."""
    count = len(tensors)
    padded = np.zeros((-(-count // CHUNK) * CHUNK, count, 6))
    padded[:count] = tensors
    return padded.reshape(-1, CHUNK, count, 6).transpose(0, 2, 3, 1).reshape(-1)


class BodyResponses:
    """Responses of bodies, again and again in the same arrays.

    The arrays of b bodies:

        body: First moment, number of cells, world, and number of the rotation, shape [b].
        row: First row of ``hardness``, shape [b].
        table: Where the tensors of its shape begin, shape [b].
        law: How much further on those of the pair law begin, shape [b].
        tensor: The tables.
        hardness, rotation: Of all bodies that have cells (``cells.couplings``).
        past: Rotations at the last two solves, the last first, shape [2, b].

    Attributes:
        begin: Launch: take the response to the field that is to be expected for the start.
        respond: Launch: replace the field of all others at cells by that of their response.
        cell_count: Cells of all bodies.
    """

    def __init__(self, state, bodies: list[WholeBody], cells):
        """Lay out the tables, and mark the cells in the state of the solve.

        Args:
            state: State of the solve (``solve_state``).
            bodies: The bodies; those with one and the same ``tensors`` share a table.
            cells: The couplings of the bodies' cells (``CellCouplings``).
        """
        dtype, device = state.packed.dtype, state.h.device
        self._bodies = b = responses_type(dtype)()
        tables, begin, size = [], {}, 0
        for one in bodies:
            if id(one.tensors) not in begin:
                begin[id(one.tensors)] = size
                tables += [_table(tensors) for tensors in one.tensors]
                size += 2 * len(tables[-1])

        def put(values, kind):
            return wp.array(np.asarray(values, np.float64 if kind is dtype else np.int32), dtype=kind, device=device)

        b.body = put([(one.first, one.cell_count, one.world, one.number) for one in bodies], wp.vec4i)
        b.row = put([one.row for one in bodies], wp.int32)
        b.table = put([begin[id(one.tensors)] for one in bodies], wp.int32)
        b.law = put([len(_table(one.tensors[0])) for one in bodies], wp.int32)
        b.tensor, b.hardness, b.rotation = put(np.concatenate(tables), dtype), cells.hardness, cells.rotations
        b.past = wp.zeros((2, len(bodies)), dtype=wp.types.quaternion(dtype), device=device)
        self.cell_count = sum(one.cell_count for one in bodies)
        cell = np.concatenate([one.first + np.arange(one.cell_count) for one in bodies])
        state.responds.assign(np.isin(np.arange(len(state.responds)), cell).astype(np.int32))
        self.begin, self.respond = (self._record(state, first, bodies) for first in (1, 0))

    def _record(self, state, first: int, bodies: list[WholeBody]):
        device, dtype, count = state.h.device, state.packed.dtype, len(bodies)
        if device.is_cpu:
            kernel, block, dim, threads = _kernel(dtype, 1), 256, 1, threads_for(count, _BODIES_PER_THREAD)
        else:
            block = -(-_GROUP * max(one.cell_count for one in bodies) // 32) * 32
            kernel, dim, threads = _kernel(dtype, _GROUP), block * count, 0
        inputs = [first, threads, team() if device.is_cpu else None, self._bodies, state]
        return wp.launch(kernel, dim=dim, inputs=inputs, block_dim=block, device=device, record_cmd=True)

    def carried(self) -> dict:
        """Return the arrays that one solve hands on to the next one, by name."""
        return {"past": self._bodies.past}
