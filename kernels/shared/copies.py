"""Arrays that repeat: copies of a part, one after the other, whose indices grow from copy to copy."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


def repeat_rows(part, copies: int, step=0) -> np.ndarray:
    """Return copies of the rows of ``part``, one after the other.

    Args:
        part: Values, shape [rows, ...].
        copies: Number of copies.
        step: Difference between a value and that in the copy before, a number or shape [columns].

    Example:
        >>> repeat_rows([[0, 7], [1, 7]], 2, [2, 0]).tolist()
        [[0, 7], [1, 7], [2, 7], [3, 7]]
    """
    part = np.asarray(part)
    whole = np.repeat(part[None], copies, axis=0)
    if np.any(step):
        whole += np.multiply.outer(np.arange(copies), step).reshape(copies, *[1] * (part.ndim - 1), -1)
    return whole.reshape(-1, *part.shape[1:])


def repeat_records(records: Sequence, copies: int, **steps: int) -> list:
    """Return copies of dataclass instances, whose fields ``steps`` grow from copy to copy."""
    if copies == 1:
        return list(records)
    return [
        replace(record, **{name: getattr(record, name) + step * copy for name, step in steps.items()})
        for copy in range(copies)
        for record in records
    ]


@wp.kernel
def _copy_words(part_in: wp.array[int], step_in: wp.array[int], whole_out: wp.array2d[int]):
    copy, k = wp.tid()
    word = part_in[k]
    step = step_in[k % step_in.shape[0]]
    if word >= 0:
        word += copy * step
    whole_out[copy, k] = word


def put_copies(part, kind, device, copies: int = 1, step=0) -> wp.array:
    """Return an array on a device with copies of the rows of ``part``, which are written there.

    Args:
        part: Values, shape [rows] or of vectors [rows, length].
        kind: Warp type of a row.
        device: Warp device.
        copies: Number of copies.
        step: Difference between an integer of 32 bits and that in the copy before, a number or shape [length]. Negative
            integers, which stand for no index, are the same in all copies.
    """
    part = np.ascontiguousarray(part)
    if copies > 1 and wp.types.type_size_in_bytes(kind) % 4:
        part, copies = repeat_rows(part, copies), 1
    array = wp.array(part, dtype=kind, device=device)
    if copies == 1:
        return array
    whole, words = wp.empty(copies * len(array), dtype=kind, device=device), array.capacity // 4
    if not whole.capacity:
        return whole
    views = [
        wp.array(ptr=memory.ptr, dtype=int, shape=shape, device=device)
        for memory, shape in ((array, words), (whole, (copies, words)))
    ]
    steps = wp.array(np.atleast_1d(step), dtype=int, device=device)
    wp.launch(
        _copy_words, (copies, words), inputs=[views[0], steps], outputs=[views[1]], device=device, record_tape=False
    )
    return whole
