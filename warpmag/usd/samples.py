"""Time samples that are added to a crate file (``.usdc``) while any USD reader can open it.

USD itself writes a layer in one go, from memory. Here it writes the layer once, with one sample for each attribute, and
the samples that follow are put into the file by hand, in its own format: a sample is eight bytes that say where its
value lies, an attribute has a row of those, and all rows share one list of times::

    values of the layer | frames: the values of all attributes | times | rows | structure of the layer

The place for all frames to come is left free, which costs nothing where the file system knows holes. A frame is written
first and then counted, in eight bytes, so that at no moment a reader meets a frame that is not whole. Where frames are
more than planned, the file is continued behind its end in the same way, with rows and structure anew.

An attribute whose value never changes has no samples: its row says so until the value is another one.

The format: https://github.com/PixarAnimationStudios/OpenUSD, ``pxr/usd/usd/crateFile.cpp``. A record of time samples is
a jump to the reference of the times, that reference, a jump to the number of samples, that number and a reference for
each sample; jumps count from where they stand, and the type is part of a reference.
"""

import contextlib
import os
import re
import struct
from dataclasses import asdict, dataclass
from typing import BinaryIO

import numpy as np

_MARK = 0x5EB7A3C9
"""Upper half of a double that stands in the layer where something is to be found again."""
END_MARK = struct.unpack("<d", struct.pack("<II", 0xFFFFFFFF, _MARK))[0]
"""What the layer must have for ``endTimeCode``."""
_TYPE = np.uint64(0xFF << 48)
"""The bits of a reference that are its type."""
_RECORD = 3
"""Words of a row before its references: that to the times, the jump, the number of samples."""
_AHEAD = 512
"""Frames whose references are written at once: a page of the file for each row."""
_BLOCK = 1 << 17
"""References that are held in memory at once."""
_FIRST_CAPACITY = 64
_CONTENTS = 16
"""Where a crate file says where its table of contents lies [bytes]."""
_SECTION, _SECTION_NAME = 32, 16
"""Size of an entry of that table, and of the name before the place [bytes]."""


def time_mark(attribute: int) -> float:
    """Return the time of the one sample that the layer must have for an attribute, by its number."""
    return struct.unpack("<d", struct.pack("<II", attribute, _MARK))[0]


@dataclass
class _Places:
    """Where things lie in the file [bytes]; what it takes to go on with it.

    Attributes:
        jumps: The jump at each attribute's record in the layer, shape [attributes].
        types: Type bits of the times and of each attribute's values, shape [1 + attributes].
        end_code: ``endTimeCode`` of the layer.
        first_frames: The first frame of each stretch of frames.
        stretches: Where each stretch begins.
        capacity: Frames that all stretches hold.
        times: Number of frames, then the time code of each; before it an empty list, after it the rows.
        filled: Frames whose references are written.
        count: Frames.
        sampled: Whether an attribute has samples, shape [attributes].
    """

    jumps: np.ndarray
    types: np.ndarray
    end_code: int
    first_frames: np.ndarray
    stretches: np.ndarray
    sampled: np.ndarray
    capacity: int = 0
    times: int = 0
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
        self._told = -1  # number of samples that all rows say they have; -1 where a run before may have closed the file

    @classmethod
    def begin(cls, path: str | os.PathLike, sizes: np.ndarray, frames: int | None) -> "SampleFile":
        """Prepare a layer that USD has just written.

        Args:
            path: The file, with a sample at :func:`time_mark` for each attribute and :data:`END_MARK`.
            sizes: Size of a value of each attribute [bytes], shape [attributes].
            frames: Frames that are expected; more may come.
        """
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "r+b", buffering=0))
            self = cls(file, sizes, _find_marks(file.read(), len(sizes)))
            structure = _Structure(file)
            self._extend(structure.start, max(frames or _FIRST_CAPACITY, 1), structure)
            stack.pop_all()
        return self

    @classmethod
    def resume(cls, path: str | os.PathLike, sizes: np.ndarray, places: dict[str, np.ndarray]) -> "SampleFile":
        """Go on with a file where it was at :meth:`places`; frames since then are dropped."""
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "r+b", buffering=0))
            known = {name: value if value.ndim else int(value) for name, value in places.items()}
            self = cls(file, sizes, _Places(**known))
            self._set_count(float(self.codes()[-1]))
            self._point_to_rows()
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

    def append(self, code: float, values: np.ndarray, changed: list[int]) -> None:
        """Add a frame.

        Args:
            code: Its time code, later than the last one.
            values: The values of all attributes, one after the other, bytes.
            changed: Attributes without samples so far whose value is another one than in the first frame.

        Raises:
            OSError: The file cannot be written; the frame is not in it.
        """
        places = self._places
        if places.count == places.capacity:
            self._extend(os.fstat(self._file.fileno()).st_size, 2 * places.capacity, _Structure(self._file))
        if places.count == places.filled:
            self._fill_rows(places.filled, min(places.filled + _AHEAD, places.capacity))
        self._write(int(self._frame_places(places.count, places.count + 1)[0]), values.tobytes())
        self._write(places.times + 8 * (1 + places.count), struct.pack("<d", code))
        for attribute in changed:
            self._write(self._row(attribute), self._types_and(places.times, 0))
            places.sampled[attribute] = True
        places.count += 1
        try:
            self._set_count(code)
        except OSError:
            places.count -= 1
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
            if self.count != self._told:
                for attribute in range(len(self._offsets)):
                    self._write(self._row(attribute) + 16, struct.pack("<Q", self.count))
        finally:
            self._file.close()

    # ---------------------------------------------------------------------------------------------------------------

    def _extend(self, start: int, capacity: int, structure: "_Structure") -> None:
        """Make room for ``capacity`` frames in all, with new times, rows and structure, from ``start`` on."""
        old = self._places
        codes = self.codes() if old.count else np.zeros(0)
        old.first_frames, old.stretches = np.append(old.first_frames, old.capacity), np.append(old.stretches, start)
        empty = start + (capacity - old.capacity) * self._frame_size
        old.times, old.capacity = empty + 8, capacity
        self._write(empty, struct.pack("<QQ", 0, old.count) + codes.tobytes())
        for attribute, sampled in enumerate(old.sampled):
            times = self._types_and(old.times if sampled else empty, 0)
            self._write(self._row(attribute), times + struct.pack("<qQ", 8, capacity))
        self._told = capacity
        self._fill_rows(0, min(-(-old.count // _AHEAD) * _AHEAD, capacity))
        end = self._row(len(self._offsets))
        self._write(end, structure.moved_to(end))
        self._point_to_rows()
        self._write(_CONTENTS, struct.pack("<q", structure.contents))

    def _row(self, attribute: int) -> int:
        """Return where the row of an attribute begins; after the last one, where rows end."""
        capacity = self._places.capacity
        return self._places.times + 8 * (1 + capacity) + 8 * (_RECORD + capacity) * int(attribute)

    def _types_and(self, place: int, kind: int) -> bytes:
        return struct.pack("<Q", int(self._places.types[kind]) | place)

    def _frame_places(self, first: int, last: int) -> np.ndarray:
        """Return where frames begin."""
        frames = np.arange(first, last)
        stretch = np.searchsorted(self._places.first_frames, frames, side="right") - 1
        inside = frames - self._places.first_frames[stretch]
        return (self._places.stretches[stretch] + inside * self._frame_size).astype(np.uint64)

    def _fill_rows(self, first: int, last: int) -> None:
        """Write the references of frames that may not be there yet."""
        places = self._frame_places(first, last)
        block = max(1, _BLOCK // max(1, last - first))
        for begin in range(0, len(self._offsets), block):
            part = slice(begin, begin + block)
            references = self._places.types[1:][part, None] | (self._offsets[part, None] + places)
            for attribute, row in enumerate(references, begin):
                self._write(self._row(attribute) + 8 * (_RECORD + first), row.tobytes())
        self._places.filled = last

    def _point_to_rows(self) -> None:
        for attribute, jump in enumerate(self._places.jumps.tolist()):
            self._write(jump, struct.pack("<q", self._row(attribute) - jump))

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

    def __init__(self, file: BinaryIO):
        """Read it."""
        (self.contents,) = struct.unpack("<q", os.pread(file.fileno(), 8, _CONTENTS))
        (count,) = struct.unpack("<Q", os.pread(file.fileno(), 8, self.contents))
        entries = self.contents + 8 + _SECTION * np.arange(count) + _SECTION_NAME
        starts = [struct.unpack("<q", os.pread(file.fileno(), 8, int(entry)))[0] for entry in entries]
        self.start = min(starts)
        self._sections = [
            (int(entry) - self.start, start - self.start) for entry, start in zip(entries, starts, strict=True)
        ]
        self._data = bytearray(os.pread(file.fileno(), self.contents + 8 + _SECTION * count - self.start, self.start))

    def moved_to(self, place: int) -> bytes:
        """Return it as it has to be at another place, which is its place then."""
        for entry, section in self._sections:
            struct.pack_into("<q", self._data, entry, place + section)
        self.start, self.contents = place, self.contents - self.start + place
        return bytes(self._data)


def _find_marks(layer: bytes, attributes: int) -> _Places:
    """Find the records of the time samples in a layer."""
    jumps, types = np.full(attributes, -1), np.zeros(1 + attributes, dtype=np.uint64)
    end_code = -1
    for found in re.finditer(re.escape(struct.pack("<I", _MARK)), layer):
        at = found.start() - 4
        (number,) = struct.unpack_from("<I", layer, at)
        if number == 0xFFFFFFFF:
            end_code = at
        elif number < attributes and struct.unpack_from("<qQ", layer, at - 16) == (24, 1):
            times, jump = struct.unpack_from("<Qq", layer, at + 8)
            (value,) = struct.unpack_from("<Q", layer, at + 16 + jump + 8)
            jumps[number], types[0], types[1 + number] = at - 16, times, value
    if end_code < 0 or (jumps < 0).any():
        raise RuntimeError("USD writes time samples in another way than this code knows")
    none = np.zeros(0, dtype=np.int64)
    return _Places(jumps, types & _TYPE, end_code, none, none, np.zeros(attributes, dtype=bool))
