"""Products with operators of bodies of cells: fields of their own moments, and steps of the induction as a whole.

**Fields.** In worlds with a single inducible body its moments m have the field T m, with the tensors T between its
cells (``warpmag.shapes.body_response``). The products replace sums over pairs. For a plate of 722 cells they take a
sixth of the time of the sums on a CPU.

**Steps.** The residual of a body's moments, r = k H/Ms − s, becomes r + w (Q − 1) r with the inverse Q of the body's
own operator. The θ dynamics then take their usual step. Q r is the error of a lone body, and ⟨r, Q r⟩ the square of its
energy norm, a criterion of convergence (``theta_step.h``).

Q belongs to χ = ∞ without saturation, and to bodies that do not intersect. Q multiplies a mode of eigenvalue λ by 1/λ.
Saturation and overlap change this eigenvalue to λ' = 1 − d (1 − λ) + e. Here d is the mean of (k/3) ‖M‖/(Ms ‖s‖) over
the body. e is the mean of k max(0, o_i + f_i − CONTACT) with o_i and f_i of ``theta_flow.py``. CONTACT is the largest
o_i + f_i of cells of similar size whose bodies only touch. The weight w = max(0, (1/λ' − 1)/(1/λ − 1)), with the
smallest λ of the body, is the largest that is safe for all modes. After a rejected step, w is 0 in the next few solves.

Sweeps leave out the pairs within such a body. Iron letters in contact take half as many evaluations as with sweeps
alone. A plate on a magnet takes a quarter as many. The elements of Q − 1 are stored as bfloat16, the upper 16 bits of
float32: this precision suffices, and reading the tables takes most of the time. If mirrors map the cells of a body to
each other, there is a table for each parity (``warpmag.shapes.body_response``). The values of the images of a cell are
added with the signs of the parity, and the products are distributed with the same signs.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.induction.solve_state import state_type
from warpmag.kernels.induction.theta_flow import CONTACT, FLOW_STEP
from warpmag.kernels.shared.native import CHUNK, PASS_ARGUMENTS, native_kernel
from warpmag.kernels.shared.pieces import cut
from warpmag.kernels.shared.reductions import group_threads
from warpmag.kernels.shared.team import launch_passes, threads_for

FOLD, WRITE_WEIGHTS, MULTIPLY, UNFOLD, FOLD_MOMENTS, MULTIPLY_FIELD, UNFOLD_FIELD = range(7)
"""The passes of steps, then of fields, in order; as in ``body_products.h``."""
_MEMBERS = 4
"""Bodies with the same tables that threads of a GPU compute together: the sums of 8 do not fit into its registers."""
_ENTRY = 9 * CHUNK
"""Words of a table for a pair of sources and CHUNK targets; as in ``body_products.h``."""
_PRODUCTS_PER_THREAD = 200_000
"""Products of a tensor and a residual per thread of a CPU, at least: some 50 µs of work."""


@cache
def _products_type(dtype):
    """Struct of tables, bodies, and buffers."""
    quaternion = wp.types.quaternion(dtype)

    @wp.struct
    class BodyProductArrays:
        table: wp.array[int]  # Q − 1 of all kinds of bodies and parities, two elements a word (:func:`_packed_table`)
        tensors: wp.array[dtype]  # T in place of Q − 1 (:func:`_tensor_table`)
        everywhere: int  # 1 if fields are evaluated in all worlds that do not rest, 0 in those that iterate
        image: wp.array[
            int
        ]  # cells of each orbit by sets of mirrors, of all kinds of bodies, [MIRRORS · padded orbits]
        body: wp.array[wp.vec4i]  # by groups: first moment, cells or 0, index of the rotation, world
        group: wp.array[wp.vec4i]  # of bodies: first image, bits of mirrors, orbits, first place in ``input``
        part: wp.array[wp.vec4i]  # of each parity: group, orbits, first entry of the table, first place
        body_chunk: wp.array[wp.vec2i]  # body and first of up to CHUNK orbits
        part_chunk: wp.array[wp.vec2i]  # part and first of up to CHUNK orbits
        largest: wp.array[dtype]  # largest eigenvalue of Q − 1 of each body
        rotation: wp.array[quaternion]  # from the frames of bodies to the world (x, y, z, w)
        input: wp.array[
            dtype
        ]  # residuals or moments by parity, in the frames of the bodies, shape [places, 3, members]
        product: wp.array[dtype]  # their products with the tables, same shape
        weight: wp.array[dtype]  # w of each body
        state: state_type(dtype)

    return BodyProductArrays


def _packed_table(response: np.ndarray) -> np.ndarray:
    """Return Q − 1 in words, [chunks of targets · pairs of sources · 9 · CHUNK], from its shape [n, 3, n, 3].

    The lower half of a word belongs to the first source of a pair, the upper half to the second.
    """
    count = len(response)
    chunks, pairs = -(-count // CHUNK), -(-count // 2)
    halves = np.zeros((chunks * CHUNK, 3, 2 * pairs, 3), np.uint16)
    halves[:count, :, :count] = response
    # chunk, lane, row, pair, half, column -> chunk, pair, row, column, lane, half
    halves = halves.reshape(chunks, CHUNK, 3, pairs, 2, 3).transpose(0, 3, 2, 5, 1, 4)
    return np.ascontiguousarray(halves).view(np.int32).reshape(-1)


def _tensor_table(tensors: np.ndarray) -> np.ndarray:
    """Return T of a parity, [chunks of targets · sources · 9 · CHUNK], from its shape [n, 3, n, 3]."""
    count = len(tensors)
    padded = np.pad(tensors, ((0, -count % CHUNK), *[(0, 0)] * 3)).reshape(-1, CHUNK, 3, count, 3)
    return np.ascontiguousarray(padded.transpose(0, 3, 2, 4, 1)).reshape(-1)


def _padded_images(images: np.ndarray) -> np.ndarray:
    """Return the images of orbits, shape [8, padded orbits]; −1 − cell where a cell occurs in an earlier row."""
    padded = np.pad(images, ((0, 0), (0, -images.shape[1] % CHUNK)))
    for row in range(1, len(padded)):
        occurs = (padded[:row] == padded[row]).any(axis=0)
        padded[row] = np.where(occurs, -1 - padded[row], padded[row])
    return padded.astype(np.int32)


@cache
def _kernel(dtype, members: int, group: int):
    call = "multiply_bodies(thread, first, last, threads, team.data, steps)"
    arguments = {**PASS_ARGUMENTS, "steps": _products_type(dtype)}
    constants = dict(MEMBERS=members, GROUP=group, FLOW_STEP=FLOW_STEP, CONTACT=CONTACT)
    return native_kernel(call, "induction/body_products.h", arguments, dtype=dtype, **constants)


class _BodyProducts:
    """Products with operators of bodies, repeatedly in the same arrays.

    Args:
        bodies: For each body its first moment, the index of its rotation, and its operator in its frame
            (``warpmag.shapes.body_response``). Bodies with the same operator share it.
        worlds: World of each body.
        rotations: Rotations from the frames of bodies to the world (x, y, z, w).
        state: State of the solve (``solve_state``), bound to its moments.
    """

    def __init__(self, bodies: Sequence[tuple[int, int, Any]], worlds, rotations, state):
        """Lay out the tables on the device of the state."""
        self._dtype, self._device = state.packed.dtype, state.h.device
        kinds: dict[int, list[int]] = {}
        for number, (_, _, operator) in enumerate(bodies):
            kinds.setdefault(id(operator), []).append(number)
        is_shared = self._device.is_cuda and len(bodies) >= _MEMBERS * len(kinds)
        self._members = _MEMBERS if is_shared else 1
        self._steps = steps = _products_type(self._dtype)()
        steps.rotation, steps.state = rotations, state
        tables = self._lay_out(bodies, worlds, list(kinds.values()))
        self._put_tables([bodies[numbers[0]][2] for numbers in kinds.values()], np.concatenate(tables))
        self._threads = threads_for(sum(operator.tables.size // 9 for _, _, operator in bodies), _PRODUCTS_PER_THREAD)
        # many bodies have orbits for all threads
        self._group = 1 if is_shared else group_threads(self._device)

    def _record(self, first: int, last: int) -> list:
        """Return the launches of passes ``first`` to ``last``, one for each on a GPU."""
        steps, device = self._steps, self._device
        parts, orbits = CHUNK * len(steps.part_chunk), CHUNK * len(steps.body_chunk)
        items = {WRITE_WEIGHTS: len(steps.body), MULTIPLY: parts, MULTIPLY_FIELD: parts}
        launches = []
        for begin, end in [(k, k) for k in range(first, last + 1)] if device.is_cuda else [(first, last)]:
            group = group_threads(device, long_lists=True) if begin == WRITE_WEIGHTS else self._group
            sizes = dict(device=device, threads=self._threads, gpu_threads=group * items.get(begin, orbits))
            kernel = _kernel(self._dtype, self._members, group)
            launches.append(launch_passes(kernel, begin, end + 1, steps, record_cmd=True, **sizes))
        return launches

    def _pack(self, table: np.ndarray) -> np.ndarray:
        """Return the table of a parity as kernels read it."""
        raise NotImplementedError

    def _put_tables(self, operators: list, tables: np.ndarray):
        """Set the tables of all operators."""
        raise NotImplementedError

    def _put(self, values, kind) -> wp.array:
        return wp.array(np.asarray(values), dtype=kind, device=self._device)

    def _lay_out(self, bodies, worlds, kinds) -> list[np.ndarray]:
        """Fill the arrays and return all tables; ``kinds`` are the indices of the bodies of each operator."""
        steps, rows, groups, parts, tables, images, place = self._steps, [], [], [], [], [], 0
        members, first_image, entry = self._members, 0, 0
        for numbers in kinds:
            operator = bodies[numbers[0]][2]
            orbits, packed = operator.images.shape[1], [self._pack(table) for table in operator.tables]
            for begin in range(0, len(numbers), members):
                some = numbers[begin : begin + members]
                parts += [
                    (len(groups), orbits, entry + k * len(packed[0]) // _ENTRY, place + k * (orbits + orbits % 2))
                    for k in range(len(packed))
                ]
                groups.append((first_image, operator.mirrors, orbits, place))
                place += len(packed) * (orbits + orbits % 2)
                rows += [(bodies[n][0], operator.cells, bodies[n][1], worlds[n]) for n in some]
                rows += [(0, 0, 0, 0)] * (members - len(some))
            tables += packed
            entry += sum(len(table) for table in packed) // _ENTRY
            images.append(_padded_images(operator.images))
            first_image += images[-1].size

        def chunks(counts):
            number, offset, _ = cut(np.zeros(len(counts), int), np.array(counts), CHUNK)
            return self._put(np.stack([number, offset], axis=1).astype(np.int32), wp.vec2i)

        steps.image = self._put(np.concatenate([image.ravel() for image in images]), wp.int32)
        steps.body, steps.group, steps.part = (
            self._put(np.array(table, np.int32), wp.vec4i) for table in (rows, groups, parts)
        )
        rows_of_kinds = [-(-len(numbers) // members) * members for numbers in kinds]
        self._kind = np.repeat(np.arange(len(kinds)), rows_of_kinds)  # of each row of ``body``
        steps.body_chunk = chunks([groups[k // members][2] for k in range(len(rows))])
        steps.part_chunk = chunks([part[1] for part in parts])
        steps.input, steps.product = (
            wp.zeros(3 * members * place, dtype=self._dtype, device=self._device) for _ in range(2)
        )
        return tables


class BodySteps(_BodyProducts):
    """Steps of bodies as a whole; operators are ``BodyResponse``."""

    def __init__(self, bodies: Sequence[tuple[int, int, Any]], worlds, rotations, state):
        """Lay out the tables, and the changes of the field in the state."""
        state.h_change = wp.zeros_like(state.h)
        super().__init__(bodies, worlds, rotations, state)
        self._launches = self._record(FOLD, UNFOLD)

    def _pack(self, table: np.ndarray) -> np.ndarray:
        return _packed_table(table)

    def _put_tables(self, operators: list, tables: np.ndarray):
        steps = self._steps
        steps.table, steps.weight = (
            self._put(tables, wp.int32),
            wp.zeros(len(steps.body), dtype=self._dtype, device=self._device),
        )
        largest = [operator.largest for operator in operators]
        steps.largest = self._put(np.array(largest)[self._kind], self._dtype)

    def launch(self):
        """Launch the change of the field at the moments of the bodies."""
        for launch in self._launches:
            launch.launch()


class BodyFields(_BodyProducts):
    """Fields of the moments of bodies, each the only inducible one of its world; operators are ``OwnField``."""

    def __init__(self, bodies: Sequence[tuple[int, int, Any]], worlds, rotations, state):
        """Lay out the tables."""
        super().__init__(bodies, worlds, rotations, state)
        self._launches = []
        for everywhere in (0, 1):
            self._steps.everywhere = everywhere
            self._launches.append(self._record(FOLD_MOMENTS, UNFOLD_FIELD))

    def _pack(self, table: np.ndarray) -> np.ndarray:
        return _tensor_table(table)

    def _put_tables(self, operators: list, tables: np.ndarray):
        self._steps.tensors = self._put(tables, self._dtype)

    def launch(self, *, everywhere: bool):
        """Launch the total field, of the moments and applied, in all worlds that do not rest, or where they iterate."""
        for launch in self._launches[everywhere]:
            launch.launch()
