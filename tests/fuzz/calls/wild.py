"""Wild values of arguments: numbers, texts, arrays and objects that few functions expect."""

import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from .functions import LIBRARIES
from .worlds import new_world


def wild(chance: random.Random, world: dict) -> Any:
    """Return a value that few functions expect."""
    number = chance.choice((0, -1, 1, 2, 3, 7, 2**31, 10**40, -(2**63), 0.5, 1e-30, 1e30, 1e300, math.nan, math.inf))
    kind = chance.randrange(12)
    if kind < 2:
        return chance.choice((number, np.float32(min(number, 1e38)), np.int64(3), True, 1j, wp.float64(0.5)))
    if kind == 2:
        return chance.choice(("", "x", "*", "site", "cuda:9", "a" * 5000, "[", b"x", Path("/nowhere"), "\0", "tanh"))
    if kind == 3:
        texts, view = np.array(["1.0", "2", "x"]), memoryview(b"\1\2\3")
        odd = (
            texts,
            texts[0],
            texts.astype("S"),
            texts.astype(object),
            {1.0, 2.0, 3.0},
            {0: 1.0, 1: 2.0, 2: 3.0},
            view,
        )
        several = (None, object(), [], {}, (), set(), lambda *_: None, str, [[1.0], [2.0, 3.0]], [None])
        return chance.choice((*several, *odd, range(3), bytearray(3), np.ones(3, bool), np.ones(3, "m8[s]")))
    if kind < 6:
        shape = chance.choice(((), (0,), (1,), (3,), (2, 3), (5, 3), (0, 3), (3, 1), (2, 7), (1, 2, 3), (1000, 3)))
        array = np.full(shape, chance.choice((0.0, 1.0, 1e-9, float(max(min(number, 1e300), -1e300)))))
        if "torch" in LIBRARIES and chance.random() < 0.2:
            return LIBRARIES["torch"].torch.tensor(array, requires_grad=chance.random() < 0.3)
        return chance.choice((array, array.astype(np.float32), array.astype("U5"), array[::-1] if shape else array))
    if kind < 9:
        dtype = chance.choice((float, wp.float64, int, wp.vec3, wp.vec3d, wp.quat, wp.transform, wp.spatial_vector))
        size = chance.choice((0, 1, 2, 3, 7, 1000, (2, 2), (3, 1)))
        array = wp.zeros(size, dtype=dtype, device="cpu")
        return array[::2] if array.ndim == 1 and array.size > 1 and chance.random() < 0.3 else array
    other = world if kind == 9 else _others(chance)
    return other[chance.choice(sorted(other))]


def _others(chance: random.Random, cache: dict = {}) -> dict:  # noqa: B006 - worlds of other sizes, made once
    balls = chance.choice((1, 3, 7))
    if balls not in cache:
        cache[balls] = new_world(balls)
    return cache[balls]
