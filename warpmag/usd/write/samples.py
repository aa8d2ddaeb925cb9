"""Time samples that are added to a crate file (``.usdc``) while any USD reader can open it.

USD itself writes a layer in one go, from memory. Here the samples are put into the file by hand, in its own format: a
sample is eight bytes that say where its value lies, an attribute has a row of those, and all rows share one list of
times::

    values of the layer | heads | frames: the values of all attributes | times | rows | structure of the layer

The place for all frames to come is left free, which costs nothing where the file system knows holes. A frame is written
first and then counted, in eight bytes, so that at no moment a reader meets a frame that is not whole. Where frames are
more than planned, the file is continued behind its end in the same way, with rows and structure anew.

An attribute whose value never changes has no samples: its head names an empty list of times until the value is another
one.

The format: https://github.com/PixarAnimationStudios/OpenUSD, ``pxr/usd/usd/crateFile.cpp``. Time samples are a jump to
the reference of the times, that reference and a jump to the number of samples, here the head, then that number and a
reference for each sample, here the row; jumps count from where they stand, and the type is part of a reference.
"""

import contextlib
import os
import struct
from dataclasses import asdict, dataclass, replace
from typing import BinaryIO

import numpy as np

from warpmag.errors import InputError
from warpmag.usd.write.crate import (
    CONTENTS,
    DOUBLE_VECTOR,
    HEAD,
    MAGIC,
    SECTION,
    SECTION_NAME,
    LayerFile,
    reference,
)

_AHEAD = 512
"""Frames whose references are written to a row at once, a page of the file, some rows with each frame before."""
_FIRST_AHEAD = 64
"""The same where all rows are written at once, so that it takes no longer than it has to."""
_BLOCK = 1 << 17
"""References that are held in memory at once."""
_FIRST_CAPACITY = 64


@dataclass
class _Places:
    """Where things lie in the file [bytes]; what it takes to go on with it.

    Attributes:
        heads: Where the heads begin.
        end_code: ``endTimeCode`` of the layer.
        types: References without a place to values of each attribute, shape [attributes].
        first_frames: The first frame of each stretch of frames.
        stretches: Where each stretch begins.
        capacity: Frames that all stretches hold.
        times: Number of frames, then the time code of each; before it an empty list, after it the rows.
        size: Least size of the file, up to the end of the structure.
        filled: Frames whose references are written.
        count: Frames.
        sampled: Whether an attribute has samples, shape [attributes].
    """

    heads: int
    end_code: int
    types: np.ndarray
    first_frames: np.ndarray
    stretches: np.ndarray
    sampled: np.ndarray
    capacity: int = 0
    times: int = 0
    size: int = 0
    filled: int = 0
    count: int = 0


class SampleFile:
    """A crate file to which frames are added.

    Attributes:
        count: Frames so far.
    """

    def __init__(self, file: BinaryIO, sizes: np.ndarray, places: _Places):
        """Go on with a file; use :meth:`begin` or :meth:`resume`.

        Args:
            file: The file, open for reading and writing, unbuffered.
            sizes: Size of a value of each attribute [bytes], in the order of a frame, shape [attributes].
            places: Where things lie.
        """
        self._file, self._places = file, places
        self._offsets = (np.cumsum(sizes) - sizes).astype(np.uint64)
        self._frame_size = int(np.sum(sizes))
        self._ahead = 0  # rows that have references of the frames behind those that all rows have
        self._told = -1  # number of samples that all rows say they have; -1 where a run before may have closed the file

    @classmethod
    def begin(cls, path: str | os.PathLike, layer: LayerFile, sizes: np.ndarray, frames: int | None) -> "SampleFile":
        """Write a layer, and make room for samples.

        Args:
            path: The file, which is new.
            layer: The layer.
            sizes: Size of a value of each attribute [bytes], shape [attributes].
            frames: Frames that are expected; more may come.
        """
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "x+b", buffering=0))
            none = np.zeros(0, dtype=np.int64)
            sampled = np.zeros(len(sizes), dtype=bool)
            self = cls(file, sizes, _Places(layer.heads, layer.end_code, layer.types, none, none, sampled))
            self._write(0, layer.values)
            start = len(layer.values)
            structure = _Structure(layer.structure, start, start + layer.contents)
            self._extend(start, max(frames or _FIRST_CAPACITY, 1), structure)
            stack.pop_all()
        return self

    @classmethod
    def resume(cls, path: str | os.PathLike, sizes: np.ndarray, places: dict[str, np.ndarray]) -> "SampleFile":
        """Go on with a file where it was at :meth:`places`; frames since then are dropped.

        Raises:
            InputError: It is not that file, or not all of it.
            OSError: It cannot be opened or written.
        """
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "r+b", buffering=0))
            known = {name: value if value.ndim else int(value) for name, value in places.items()}
            self = cls(file, sizes, _Places(**known))
            if not self._is_there():
                raise InputError(f"{path}: cannot be resumed, it is not as the run left it")
            self._set_count(float(self.codes()[-1]))
            self._write_heads(0, len(sizes))
            stack.pop_all()
        return self

    @property
    def sampled(self) -> np.ndarray:
        """Whether each attribute has samples, shape [attributes]."""
        return self._places.sampled

    @property
    def count(self) -> int:
        """Frames so far."""
        return self._places.count

    def places(self) -> dict[str, np.ndarray]:
        """Return what :meth:`resume` needs to come back to the present state."""
        return {name: np.asarray(value) for name, value in asdict(self._places).items()}

    def append(self, code: float, values: bytes, changed: np.ndarray) -> None:
        """Add a frame.

        Args:
            code: Its time code, later than the last one.
            values: The values of all attributes, one after the other.
            changed: Attributes without samples so far whose value is another one than in the first frame, shape [n].

        Raises:
            OSError: The file cannot be written; the frame is not in it.
        """
        if self.count == self._places.capacity:
            self._extend(os.fstat(self._file.fileno()).st_size, 2 * self.count, _Structure.read(self._file))
        places = self._places
        self._fill_ahead()
        self._write(int(self._frame_places(places.count, places.count + 1)[0]), values)
        self._write(places.times + 8 * (1 + places.count), struct.pack("<d", code))
        places.sampled[changed] = True
        places.count += 1
        try:
            if len(changed):
                self._write_heads(int(changed.min()), int(changed.max()) + 1)
            self._set_count(code)
        except OSError:
            places.count -= 1
            places.sampled[changed] = False
            raise

    def frame(self, number: int) -> bytes:
        """Return the values of a frame."""
        return os.pread(self._file.fileno(), self._frame_size, int(self._frame_places(number, number + 1)[0]))

    def codes(self) -> np.ndarray:
        """Return the time codes of all frames."""
        return np.frombuffer(os.pread(self._file.fileno(), 8 * self.count, self._places.times + 8))

    def close(self) -> None:
        """Close the file, complete: readers of other makes compare the number of samples with that of the times."""
        try:
            counts = np.where(self.sampled, self.count, 0).tolist()
            for row, count in zip(self._rows(), counts, strict=True):
                if count != self._told:
                    self._write(row, struct.pack("<Q", count))
        finally:
            self._file.close()

    # ---------------------------------------------------------------------------------------------------------------

    def _extend(self, start: int, capacity: int, structure: "_Structure") -> None:
        """Make room for ``capacity`` frames in all, with new times, rows and structure, from ``start`` on."""
        old, told = self._places, self._told
        codes = self.codes() if old.count else np.zeros(0)
        empty = start + (capacity - old.capacity) * self._frame_size
        self._places = replace(
            old,
            first_frames=np.append(old.first_frames, old.capacity),
            stretches=np.append(old.stretches, start),
            capacity=capacity,
            times=empty + 8,
            filled=min(old.count + _FIRST_AHEAD, capacity),
        )
        self._told, self._ahead = capacity, 0
        try:
            self._write(empty, struct.pack("<QQ", 0, old.count) + codes.tobytes())
            self._fill_rows(0, self._places.filled, 0, len(self._offsets))
            end = self._rows().stop
            self._write(end, moved := structure.moved_to(end))
            self._places.size = end + len(moved)
            self._write_heads(0, len(self._offsets))
            self._write(CONTENTS, struct.pack("<q", structure.contents))
        except OSError:
            self._places, self._told = old, told  # what the file has still stands there
            raise

    def _is_there(self) -> bool:
        """Whether the file has its end, and has counted the frames."""
        places, descriptor = self._places, self._file.fileno()
        if os.fstat(descriptor).st_size < places.size:
            return False
        (counted,) = struct.unpack("<Q", os.pread(descriptor, 8, places.times))
        return os.pread(descriptor, len(MAGIC), 0) == MAGIC and places.count <= counted <= places.capacity

    def _rows(self) -> range:
        """Return where the rows begin."""
        size, first = 8 * (1 + self._places.capacity), self._places.times + 8 * (1 + self._places.capacity)
        return range(first, first + size * len(self._offsets), size)

    def _frame_places(self, first: int, last: int) -> np.ndarray:
        """Return where frames begin."""
        frames = np.arange(first, last)
        stretch = np.searchsorted(self._places.first_frames, frames, side="right") - 1
        inside = frames - self._places.first_frames[stretch]
        return (self._places.stretches[stretch] + inside * self._frame_size).astype(np.uint64)

    def _fill_ahead(self) -> None:
        """Write references of the frames that come after those that have some: to so many rows that all get them."""
        places, rows = self._places, len(self._offsets)
        left = places.filled - places.count
        if places.filled == places.capacity or left > _AHEAD:
            return
        last = min(places.filled + _AHEAD, places.capacity)
        end = self._ahead + -(-(rows - self._ahead) // (left + 1))
        self._fill_rows(places.filled, last, self._ahead, end)
        self._ahead = end
        if end == rows:
            places.filled, self._ahead = last, 0

    def _fill_rows(self, first: int, last: int, begin: int, end: int) -> None:
        """Write the references of frames that may not be there yet; before the first one the number of samples.

        Args:
            first: The first frame.
            last: Behind the last one.
            begin: The first row.
            end: Behind the last one.
        """
        frames = self._frame_places(first, last)
        block = max(1, _BLOCK // max(1, last - first))
        for start in range(begin, end, block):
            part = slice(start, min(start + block, end))
            words = self._places.types[part, None] | (self._offsets[part, None] + frames)
            if first == 0:
                words = np.insert(words, 0, self._places.capacity, axis=1)
            rows, size = self._rows()[part], words[0].nbytes
            data, inside = words.tobytes(), 8 * (1 + first) if first else 0
            if size == rows.step:  # they touch
                self._write(rows.start, data)
                continue
            for number, row in enumerate(rows):
                self._write(row + inside, data[number * size : (number + 1) * size])

    def _write_heads(self, first: int, last: int) -> None:
        """Let the time samples of attributes have the present times, where these change, and rows."""
        places = self._places
        heads = np.full((last - first, HEAD // 8), 8, dtype=np.int64)
        times = np.where(places.sampled[first:last], places.times, places.times - 8)  # the empty list
        heads[:, 1] = reference(DOUBLE_VECTOR, 0) | times
        begin = places.heads + HEAD * first
        heads[:, 2] = np.array(self._rows()[first:last]) - (begin + HEAD * np.arange(last - first) + 16)
        self._write(begin, heads.tobytes())

    def _set_count(self, last_code: float) -> None:
        self._write(self._places.end_code, struct.pack("<d", last_code))
        self._write(self._places.times, struct.pack("<Q", self.count))

    def _write(self, place: int, data: bytes) -> None:
        view = memoryview(data)
        while view:  # a disk that is nearly full takes a part
            written = os.pwrite(self._file.fileno(), view, place)
            place, view = place + written, view[written:]


class _Structure:
    """The structure of a layer, its last part: sections, and the table of contents that says where they lie.

    Attributes:
        start: Where it begins.
        contents: Where the table of contents lies.
    """

    def __init__(self, data: bytes, start: int, contents: int):
        """Take the bytes from ``start`` on."""
        self.start, self.contents, self._data = start, contents, bytearray(data)
        entries = range(contents - start + 8 + SECTION_NAME, len(data), SECTION)
        self._sections = [(entry, struct.unpack_from("<q", data, entry)[0] - start) for entry in entries]

    @classmethod
    def read(cls, file: BinaryIO) -> "_Structure":
        """Read that of a file."""
        (contents,) = struct.unpack("<q", os.pread(file.fileno(), 8, CONTENTS))
        (count,) = struct.unpack("<Q", os.pread(file.fileno(), 8, contents))
        end = contents + 8 + SECTION * count
        table = os.pread(file.fileno(), end - contents, contents)
        start = min(struct.unpack_from("<q", table, entry)[0] for entry in range(8 + SECTION_NAME, len(table), SECTION))
        return cls(os.pread(file.fileno(), end - start, start), start, contents)

    def moved_to(self, place: int) -> bytes:
        """Return it as it has to be at another place, which is its place then."""
        for entry, section in self._sections:
            struct.pack_into("<q", self._data, entry, place + section)
        self.start, self.contents = place, self.contents - self.start + place
        return bytes(self._data)
