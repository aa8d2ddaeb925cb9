"""Appends time samples to a crate file (``.usdc``) that any USD reader can open meanwhile.

USD itself writes a layer at once, from memory. Here frames are appended to the file in its own format: a sample is a
reference of eight bytes to its value, an attribute has a row of references, and all rows share one list of times::

    values of the layer | heads | frames: the values of all attributes | times | rows | structure of the layer

Space for all planned frames is reserved, as a hole in the file where the file system supports that. A frame is written
first. Then one write of eight bytes increases the count of frames, so readers see complete frames only. For more frames
than planned, new space, times, rows and structure are appended to the file.

An attribute whose value never changes has no samples: its head refers to an empty list of times until the value
changes.

Format: https://github.com/PixarAnimationStudios/OpenUSD, ``pxr/usd/usd/crateFile.cpp``. The head of time samples is an
offset to the reference of the times, that reference, and an offset to the row. The row is the number of samples and a
reference for each sample. Offsets count from their own places, and a reference includes the type.
"""

import contextlib
import os
import struct
import zlib
from dataclasses import asdict, dataclass, replace
from typing import BinaryIO

import numpy as np

from warpmag.errors import InputError
from warpmag.usd.write.crate import CONTENTS, DOUBLE_VECTOR, HEAD, MAGIC, SECTION, SECTION_NAME, LayerFile, reference

_AHEAD = 512
"""References written to a row in advance: one page of the file. Each frame writes them to some of the rows."""
_FIRST_AHEAD = 64
"""The same where all rows are written at once; smaller, to save time in the first frame."""
_BLOCK = 1 << 17
"""References in memory at once."""
_FIRST_CAPACITY = 64
_DIGEST = "digest"
_FOREIGN = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError, MemoryError, struct.error)
"""Errors of places that are not those of the file."""


@dataclass
class _Places:
    """Places in the file [bytes]: the state from which a file can be continued."""

    heads: int  # place of the heads
    end_code: int  # place of the layer's ``endTimeCode``
    types: np.ndarray  # references of each attribute without the place of a value, shape [attributes]
    first_frames: np.ndarray  # first frame of each contiguous block of frames
    starts: np.ndarray  # place of each block
    sampled: np.ndarray  # True for each attribute with samples, shape [attributes]
    capacity: int = 0  # frames that fit in all blocks
    times: int = 0  # place of the number of frames, followed by their time codes; an empty list precedes, rows follow
    size: int = 0  # least size of the file, up to the end of the structure
    filled: int = 0  # number of frames whose references are written
    count: int = 0  # number of frames
    checksum: int = 0  # CRC-32 of the values of all frames


class SampleFile:
    """A crate file to which frames are appended."""

    def __init__(self, file: BinaryIO, sizes: np.ndarray, places: _Places):
        """Wrap an unbuffered file, open for reading and writing; use :meth:`begin` or :meth:`resume`."""
        self._file, self._places = file, places
        self._offsets = (np.cumsum(sizes) - sizes).astype(np.uint64)
        self._frame_size = int(np.sum(sizes))
        self._ahead = 0  # rows that have references of frames beyond ``filled``
        self.resumed = False  # True until a resumed file has dropped the frames after its checkpoint
        self._row_count = -1  # number of samples in the rows; -1 where an earlier run may have closed the file

    @classmethod
    def begin(cls, path: str | os.PathLike, layer: LayerFile, sizes: np.ndarray, frames: int | None) -> "SampleFile":
        """Create a file, which must not exist, with a layer and space for the expected number of frames.

        ``sizes`` holds the size of each attribute's value [bytes], in the order of a frame, shape [attributes].
        """
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "x+b", buffering=0))
            empty = np.zeros(0, dtype=np.int64)
            sampled = np.zeros(len(sizes), dtype=bool)
            self = cls(file, sizes, _Places(layer.heads, layer.end_code, layer.types, empty, empty, sampled))
            self._write(0, layer.values)
            start = len(layer.values)
            structure = _Structure(layer.structure, start, start + layer.contents)
            self._extend(start, max(frames or _FIRST_CAPACITY, 1), structure)
            stack.pop_all()
        return self

    @classmethod
    def resume(cls, path: str | os.PathLike, sizes: np.ndarray, places: dict[str, np.ndarray]) -> "SampleFile":
        """Open a file at an earlier :meth:`places`; :meth:`drop_later_frames` has to come before the next frame.

        Nothing is written. A file that has changed, or the places in another file, raise :class:`InputError`.
        """
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "r+b", buffering=0))
            try:
                fields = {name: value if value.ndim else int(value) for name, value in places.items()}
                digest = fields.pop(_DIGEST)
                self = cls(file, sizes, _Places(**fields))
                intact = self._is_intact() and np.array_equal(digest, self._digest())
            except _FOREIGN:
                intact = False
            if not intact:
                raise InputError(f"{path}: cannot be resumed, it has changed since the run wrote it")
            self.resumed = True
            stack.pop_all()
        return self

    def drop_later_frames(self) -> None:
        """Bring a resumed file back to its places."""
        self.resumed, attributes = False, len(self._offsets)
        self._set_count(float(self.codes()[-1]))
        self._write_heads(0, attributes)
        self._fill_rows(0, self._places.filled, 0, attributes)

    @property
    def sampled(self) -> np.ndarray:
        """True for each attribute with samples, shape [attributes]."""
        return self._places.sampled

    @property
    def count(self) -> int:
        """Number of frames."""
        return self._places.count

    def places(self) -> dict[str, np.ndarray]:
        """Return the state from which :meth:`resume` continues."""
        values = asdict(self._places) | {_DIGEST: self._digest()}
        return {name: np.asarray(value) for name, value in values.items()}

    def _digest(self) -> int:
        """Return a checksum of all that frames do not change, and of the time codes: a checkpoint knows its file by it.

        Left out are rows, heads and counts, which :meth:`resume` writes anew, and the values of frames.
        """
        places, descriptor = self._places, self._file.fileno()
        layer = bytearray(os.pread(descriptor, int(places.starts[0]), 0))
        for place, size in ((CONTENTS, 8), (places.end_code, 8), (places.heads, HEAD * len(self._offsets))):
            layer[place : place + size] = bytes(size)
        end = self._rows().stop
        structure = os.pread(descriptor, places.size - end, end)
        parts = layer, structure, self.codes(), places.types, places.first_frames, places.starts
        return zlib.crc32(b"".join(map(bytes, parts)))

    def append(self, code: float, values: bytes, changed: np.ndarray) -> None:
        """Append a frame: the values of all attributes at a later time code. A frame that fails is not in the file.

        ``changed`` are attributes without samples whose value now differs from the first frame, shape [n].
        """
        if self.count == self._places.capacity:
            self._extend(os.fstat(self._file.fileno()).st_size, 2 * self.count, _Structure.read(self._file))
        places = self._places
        self._fill_ahead()
        self._write(int(self._frame_places(places.count, places.count + 1)[0]), values)
        self._write(places.times + 8 * (1 + places.count), struct.pack("<d", code))
        places.sampled[changed] = True
        places.count += 1
        checksum, places.checksum = places.checksum, zlib.crc32(values, places.checksum)
        try:
            if len(changed):
                self._write_heads(int(changed.min()), int(changed.max()) + 1)
            self._set_count(code)
        except OSError:
            places.count -= 1
            places.checksum = checksum
            places.sampled[changed] = False
            raise

    def frame(self, number: int) -> bytes:
        """Return the values of a frame."""
        return os.pread(self._file.fileno(), self._frame_size, int(self._frame_places(number, number + 1)[0]))

    def codes(self) -> np.ndarray:
        """Return the time codes of all frames."""
        return np.frombuffer(os.pread(self._file.fileno(), 8 * self.count, self._places.times + 8))

    def close(self) -> None:
        """Close the file with the counts of samples in all rows, as readers other than USD's expect.

        A resumed file with later frames stays as it is.
        """
        if self.resumed:
            self._file.close()
            return
        try:
            counts = np.where(self.sampled, self.count, 0).tolist()
            for row, count in zip(self._rows(), counts, strict=True):
                if count != self._row_count:
                    self._write(row, struct.pack("<Q", count))
        finally:
            self._file.close()

    # ---------------------------------------------------------------------------------------------------------------

    def _extend(self, start: int, capacity: int, structure: "_Structure") -> None:
        """Append space for ``capacity`` frames in total, with new times, rows and structure, from ``start`` on."""
        old, row_count = self._places, self._row_count
        codes = self.codes() if old.count else np.zeros(0)
        empty = start + (capacity - old.capacity) * self._frame_size
        self._places = replace(
            old,
            first_frames=np.append(old.first_frames, old.capacity),
            starts=np.append(old.starts, start),
            capacity=capacity,
            times=empty + 8,
            filled=min(old.count + _FIRST_AHEAD, capacity),
        )
        self._row_count, self._ahead = capacity, 0
        try:
            self._write(empty, struct.pack("<QQ", 0, old.count) + codes.tobytes())
            self._fill_rows(0, self._places.filled, 0, len(self._offsets))
            end = self._rows().stop
            self._write(end, moved := structure.moved_to(end))
            self._places.size = end + len(moved)
            self._write_heads(0, len(self._offsets))
            self._write(CONTENTS, struct.pack("<q", structure.contents))
        except OSError:
            self._places, self._row_count = old, row_count  # the file still refers to them
            raise

    def _is_intact(self) -> bool:
        """Return True if the file has its full size and contains the frames of the checkpoint."""
        places, descriptor = self._places, self._file.fileno()
        kinds = [array.dtype.kind for array in (places.types, places.first_frames, places.starts, places.sampled)]
        if kinds != ["u", "i", "i", "b"] or not len(places.types) == len(places.sampled) == len(self._offsets):
            return False
        if os.fstat(descriptor).st_size < places.size or places.filled > places.capacity:
            return False
        (frames,) = struct.unpack("<Q", os.pread(descriptor, 8, places.times))
        if not (os.pread(descriptor, len(MAGIC), 0) == MAGIC and 0 < places.count <= frames <= places.capacity):
            return False
        checksum = 0
        for number in range(places.count):
            checksum = zlib.crc32(self.frame(number), checksum)
        return checksum == places.checksum

    def _rows(self) -> range:
        """Return the places of the rows."""
        size, first = 8 * (1 + self._places.capacity), self._places.times + 8 * (1 + self._places.capacity)
        return range(first, first + size * len(self._offsets), size)

    def _frame_places(self, first: int, last: int) -> np.ndarray:
        """Return the places of frames."""
        frames = np.arange(first, last)
        block = np.searchsorted(self._places.first_frames, frames, side="right") - 1
        inside = frames - self._places.first_frames[block]
        return (self._places.starts[block] + inside * self._frame_size).astype(np.uint64)

    def _fill_ahead(self) -> None:
        """Write references of frames beyond ``filled``, to as many rows as needed to finish all rows in time."""
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
        """Write references of frames, which may not exist yet, to rows. The number of samples precedes frame 0.

        The frames are ``first`` to ``last - 1``, the rows ``begin`` to ``end - 1``.
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
            if size == rows.step:  # contiguous
                self._write(rows.start, data)
                continue
            for number, row in enumerate(rows):
                self._write(row + inside, data[number * size : (number + 1) * size])

    def _write_heads(self, first: int, last: int) -> None:
        """Write the heads of attributes: references to the times (without samples to the empty list) and the rows."""
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
        while view:  # a nearly full disk accepts only a part
            written = os.pwrite(self._file.fileno(), view, place)
            place, view = place + written, view[written:]


class _Structure:
    """The structure of a layer: sections, and the table of ``contents`` with their places."""

    def __init__(self, data: bytes, start: int, contents: int):
        """Wrap the bytes of the structure, which begin at ``start``."""
        self.start, self.contents, self._data = start, contents, bytearray(data)
        entries = range(contents - start + 8 + SECTION_NAME, len(data), SECTION)
        self._sections = [(entry, struct.unpack_from("<q", data, entry)[0] - start) for entry in entries]

    @classmethod
    def read(cls, file: BinaryIO) -> "_Structure":
        """Read the structure of a file."""
        (contents,) = struct.unpack("<q", os.pread(file.fileno(), 8, CONTENTS))
        (count,) = struct.unpack("<Q", os.pread(file.fileno(), 8, contents))
        end = contents + 8 + SECTION * count
        table = os.pread(file.fileno(), end - contents, contents)
        start = min(struct.unpack_from("<q", table, entry)[0] for entry in range(8 + SECTION_NAME, len(table), SECTION))
        return cls(os.pread(file.fileno(), end - start, start), start, contents)

    def moved_to(self, place: int) -> bytes:
        """Move the structure to another place; return its bytes there."""
        for entry, section in self._sections:
            struct.pack_into("<q", self._data, entry, place + section)
        self.start, self.contents = place, self.contents - self.start + place
        return bytes(self._data)
