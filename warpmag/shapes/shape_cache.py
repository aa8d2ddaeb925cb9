"""Files that keep sampled shapes from one process to the next, as Warp's cache keeps compiled kernels.

A shape with its tensors takes seconds to compute and milliseconds to read. The name of a file is a digest of everything
that determines its content: the shape, and the text of the modules that sample shapes. So an entry is never out of
date. A file holds a digest of its own content, too. Damaged files are computed again, and a folder that cannot be
written costs only time. Both appear in the log ``warpmag``, at the level ``INFO``.
"""

import hashlib
import logging
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np

FOLDER = "warpmag_shapes"
"""Name of the folder beside the compiled kernels."""
MOST_BYTES = 1 << 30
"""Largest total size of the files [bytes]: the least recently read ones are deleted first."""
_DIGEST_BYTES = hashlib.sha256().digest_size
_Value = TypeVar("_Value")
_log = logging.getLogger("warpmag")


class ShapeCache:
    """Cache of values by what determines them, in a folder. Unpickling trusts the folder, as Warp trusts its kernels.

    Example:
        >>> shapes = ShapeCache(Path(tempfile.mkdtemp()))
        >>> shapes.get("squares of 3", (3,), lambda: np.arange(3) ** 2)
        array([0, 1, 4])
    """

    def __init__(self, folder: Path):
        """Use ``folder``, which need not exist."""
        self._folder = folder

    def get(self, name: str, key: tuple, compute: Callable[[], _Value]) -> _Value:
        """Return the value that belongs to ``key``: read from its file, or computed and written.

        Args:
            name: Name of the value in the log.
            key: Numbers, texts, bytes and NumPy arrays that determine the value, with the version of the code.
            compute: Function that returns the value. Its errors are raised, and nothing is written.
        """
        path = self._folder / f"{_digest((_version(), *key))}.pickle"
        content = self._read(path)
        if content is not None:
            _log.info("%s: read from %s", name, path)
            return pickle.loads(content)
        began = time.perf_counter()
        value = compute()
        _log.info("%s: computed in %.2f s", name, time.perf_counter() - began)
        self._write(path, pickle.dumps(value, pickle.HIGHEST_PROTOCOL))
        return value

    def _read(self, path: Path) -> bytes | None:
        """Return the content of a file, or None if the file does not exist or is damaged."""
        try:
            data = path.read_bytes()
            os.utime(path)
        except FileNotFoundError:
            return None
        except OSError as error:
            _log.info("%s: cannot be read (%s)", path, error)
            return None
        if hashlib.sha256(data[_DIGEST_BYTES:]).digest() == data[:_DIGEST_BYTES]:
            return data[_DIGEST_BYTES:]
        _log.info("%s: damaged, computed again", path)
        return None

    def _write(self, path: Path, content: bytes) -> None:
        """Write a file at once, so that other processes read it as a whole or not at all."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            descriptor, temporary = tempfile.mkstemp(dir=self._folder)
            try:
                with os.fdopen(descriptor, "wb") as file:
                    file.write(hashlib.sha256(content).digest() + content)
                os.replace(temporary, path)
            except OSError:
                os.unlink(temporary)
                raise
            self._delete_old()
        except OSError as error:
            _log.info("%s: cannot be written (%s)", path, error)

    def _delete_old(self) -> None:
        """Delete the least recently read files beyond :data:`MOST_BYTES`."""
        with os.scandir(self._folder) as entries:
            files = [(entry.stat(), entry.path) for entry in entries]
        total = sum(status.st_size for status, _ in files)
        for status, path in sorted(files, key=lambda file: file[0].st_mtime):
            if total <= MOST_BYTES:
                return
            os.unlink(path)
            total -= status.st_size


def _digest(parts: tuple) -> str:
    """Return a digest of numbers, texts, bytes and arrays."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.tobytes() if isinstance(part, np.ndarray) else part if isinstance(part, bytes) else repr(part)
        data = data.encode() if isinstance(data, str) else data
        digest.update(f"{type(part).__name__} {len(data)} ".encode() + data)
    return digest.hexdigest()


@cache
def _version() -> str:
    """Return a digest of the modules that sample shapes, and the versions of Python and NumPy."""
    folder = Path(__file__).parent
    others = ("engine/magnets/sampling.py", "declarations/rotations.py")
    modules = [*sorted(folder.glob("*.py")), *(folder.parent / name for name in others)]
    return _digest((sys.version, np.__version__, *(module.read_bytes() for module in modules)))
