"""Ranks: processes that ``mpirun`` starts, and that share out the sums over pairs of one simulation.

Each rank has all moments, and on a host with GPUs one of these. It sums its part of the work list of all pairs, and
gets what the others summed; all that is small it does as they do. The work list is that of one process, so that the
results are its bits. A process by itself has no ranks, and imports nothing for them.

A rank stores sums where the others have zeros. Bits are merged, not numbers: to add zeros as integers keeps a number as
it is, whatever the order. ``mpi4py`` does that on CPUs and across hosts, and between GPUs NVIDIA's NCCL, whose library
is called directly: it is captured in a CUDA graph with the kernels before and after.

Whatever may go wrong on one rank alone is exchanged before anybody waits for sums: the arguments of calls, what the
first rank does for all, and what a sweep ends with. All then raise the same line.
"""

import ctypes
import dataclasses
import inspect
import os
import pickle
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from warpmag.declarations.checks import check_count
from warpmag.errors import InputError, SimulationError, extra, one_line

_COUNTS = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE")
"""What launchers tell their processes: how many they are."""
_GRACE = 5.0
"""Time [s] in which ranks that fail alike all do."""
_ID_BYTES, _INT32, _SUM = 128, 2, 0
"""Size of NCCL's unique identifier, and its numbers of a type and an operation (``nccl.h``)."""


_P = ParamSpec("_P")
_R = TypeVar("_R")
_alone = 0
"""In how many :func:`alone` this process is."""


@cache
def launched() -> "Ranks | None":
    """The ranks that this process is one of; None where it is by itself.

    Raises:
        InputError: A launcher has started several processes, but ``mpi4py`` is not installed.
    """
    if all(os.environ.get(name, "1") == "1" for name in _COUNTS):
        return None
    try:
        from mpi4py import MPI  # noqa: PLC0415 - initializes MPI, which only processes of a launcher may
    except ImportError as error:
        raise InputError(f"mpirun: ranks need {extra('ranks')}: {error}") from None
    return Ranks(MPI) if MPI.COMM_WORLD.size > 1 else None


def ranks() -> "Ranks | None":
    """The ranks with which this process shares out what it is told to compute now; None where it does all itself."""
    return None if _alone else launched()


@contextmanager
def alone() -> Iterator[None]:
    """Share out nothing; what is made meanwhile never does."""
    global _alone  # of all threads: one that shared would wait for ranks that do not
    _alone += 1
    try:
        yield
    finally:
        _alone -= 1


@contextmanager
def agreed(all_ranks: "Ranks | None") -> Iterator[None]:
    """Have all ranks raise what one raises meanwhile; they may exchange, but merge nothing."""
    if all_ranks is None:
        yield
        return
    try:
        yield
    except Exception as error:
        if not getattr(error, "of_all_ranks", False):
            all_ranks.exchange(None, error)
        raise
    all_ranks.exchange(None)


def is_first(all_ranks: "Ranks | None") -> bool:
    """Whether this process is the one that writes and prints: the first rank, or one by itself."""
    return all_ranks is None or all_ranks.rank == 0


def by_first(do: Callable[[], Any], all_ranks: "Ranks | None") -> Any:
    """Return what ``do`` returns; of several ranks the first does it for all, and all raise what it raises."""
    if all_ranks is None:
        return do()
    with agreed(all_ranks):
        return all_ranks.exchange(do() if is_first(all_ranks) else None)[0]


def alike(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let ranks compare the arguments before they call a function, which then fails on all or none."""
    signature = inspect.signature(function)

    @wraps(function)
    def compared(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if (all_ranks := ranks()) is not None:
            given = signature.bind(*args, **kwargs).arguments
            given.pop("device", None)  # each has its own
            all_ranks.check_alike(given)
        return function(*args, **kwargs)

    return compared


def sweep(simulate: Callable[[range], _R], world_count: int, *, together: int) -> list[_R]:
    """Simulate the worlds of a sweep, some of them together; ranks of ``mpirun`` share them out.

    Each rank simulates its worlds by itself, and gets what the others found at the end. Which worlds are together does
    not depend on the number of ranks: worlds of one model may have their substeps and the form of their sums in common,
    so that results have the bits of one process on any device.

    Args:
        simulate: Called with the numbers of worlds that it is to simulate together; what it returns goes to all ranks,
            and has to be what :mod:`pickle` takes, such as NumPy arrays.
        world_count: Number of worlds.
        together: Worlds of a call, of the last one fewer; rank r of R has every R-th call from the r-th on.

    Returns:
        What each call returned, in the order of worlds; the same on all ranks.

    Raises:
        InputError: A number is none, or differs between ranks. What ``simulate`` raises on one rank, all raise.
    """
    check_count("world_count", world_count)
    check_count("together", together)
    calls = [range(first, min(first + together, world_count)) for first in range(0, world_count, together)]
    all_ranks = ranks()
    if all_ranks is None:
        return [simulate(worlds) for worlds in calls]
    all_ranks.check_alike({"world_count": world_count, "together": together})
    with agreed(all_ranks):
        found = []
        with alone():
            for worlds in calls[all_ranks.rank :: all_ranks.size]:
                if all_ranks.has_failed():
                    break
                found.append(pickle.dumps(simulate(worlds)))  # here, so that what cannot be is told to all
        each = all_ranks.exchange(found)
    return [pickle.loads(each[call % all_ranks.size][call // all_ranks.size]) for call in range(len(calls))]


def _checksum(value: Any, before: int = 0) -> int:
    """Checksum of an argument that is the same in all processes that were given the same; of objects by their type."""
    if hasattr(value, "numpy"):
        value = value.numpy()
    if isinstance(value, (list, tuple)):
        try:
            array = np.asarray(value)
        except Exception:  # rows of different lengths, or what fails to become an array
            array = np.zeros((), object)
        value = value if array.dtype.hasobject else array
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, one.name) for one in dataclasses.fields(value)]
    if isinstance(value, (list, tuple)):
        for one in value:
            before = _checksum(one, before)
        return zlib.crc32(b"[]", before)
    if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
        data = np.ascontiguousarray(value)
        before = zlib.crc32(f"{data.dtype} {np.shape(value)}".encode(), before)
        return zlib.crc32(data.reshape(-1).view(np.uint8), before)
    plain = value is None or isinstance(value, (str, bytes, bool, int, float, os.PathLike))
    return zlib.crc32((repr(value) if plain else type(value).__qualname__).encode(), before)


class Ranks:
    """The processes of one program.

    Attributes:
        size: How many they are.
        rank: Which of them this is, from 0.
        local_rank: The same among those of this host.
    """

    def __init__(self, mpi):
        """Join those that the launcher started; ``mpi`` is the module ``mpi4py.MPI``."""
        self._mpi, self._all = mpi, mpi.COMM_WORLD
        self.size, self.rank = self._all.size, self._all.rank
        host = self._all.Split_type(mpi.COMM_TYPE_SHARED)
        self.local_rank = host.rank
        self._failures, self._gpus = self._all.Dup(), None
        self._show, sys.excepthook = sys.excepthook, self._end

    def share(self, count: int) -> tuple[int, int]:
        """Begin and end of this rank's part of ``count`` pieces of work."""
        return count * self.rank // self.size, count * (self.rank + 1) // self.size

    def merge(self, array) -> None:
        """Give each rank what any of them has in a contiguous Warp array, where the others have zeros.

        Raises:
            InputError: A graph of a CPU is being captured, which would not do this when it is launched.
        """
        if array.device.is_cuda:
            self._gpus = self._gpus or _Nccl(self, array.device)
            self._gpus.merge(array)
            return
        if array.device.is_capturing:
            raise InputError("device: what ranks exchange is in no graph of a CPU; launch without one")
        self._all.Allreduce(self._mpi.IN_PLACE, array.numpy().reshape(-1).view(np.int32), self._mpi.SUM)

    def exchange(self, value: Any, error: Exception | None = None) -> list:
        """Return what each rank has; where some have an error instead, all raise that of the first of these."""
        others = range(self.size) if error is not None else ()
        told = [self._failures.isend(None, other) for other in others if other != self.rank]
        kind = type(error) if isinstance(error, (InputError, SimulationError)) else RuntimeError
        text = str(error) if kind is type(error) else f"{type(error).__name__}: {error}"
        each = self._all.allgather((None if error is None else (kind, text), value))
        failed = [rank for rank, (line, _) in enumerate(each) if line is not None]
        for rank in failed:
            if rank != self.rank:
                self._failures.recv(source=rank)
        for request in told:
            request.wait()
        if not failed:
            return [value for _, value in each]
        kind, text = each[failed[0]][0]
        if any(line != (kind, text) for line, _ in each):
            text = f"rank {failed[0]}: {text}"
        shared = kind(one_line(text))
        shared.__dict__["of_all_ranks"] = True
        raise shared from error

    def has_failed(self) -> bool:
        """Whether one of them has an error, and waits to exchange it."""
        return self._failures.iprobe()

    def check_alike(self, given: dict[str, Any], what: str = "") -> None:
        """Raise ``InputError`` on all ranks where a value differs between them.

        Args:
            given: Values by the names that the message has for them.
            what: What the message begins with.
        """
        each = self.exchange({name: _checksum(value) for name, value in given.items()})
        for rank, other in enumerate(each):
            for name in (*each[0], *other):
                if each[0].get(name) != other.get(name):
                    told = f"rank {rank} was given another value than rank 0; ranks share out one calculation"
                    raise InputError(f"{what}{name}: {told}")

    def fail(self, line: str, code: int, tell) -> None:
        """Tell of a failure once: by rank 0 where all ranks fail alike, else by this one, and end the others.

        Args:
            line: What is wrong.
            code: Exit code.
            tell: Prints a line.
        """
        everyone, until = self._failures.Ibarrier(), time.monotonic() + _GRACE
        while not everyone.Test():
            if time.monotonic() > until:
                tell(f"rank {self.rank}: {line}")
                sys.stdout.flush()
                self._all.Abort(code)
            time.sleep(0.01)
        if self.rank == 0:
            tell(line)

    def _end(self, kind, error, trace) -> None:
        """Show what nobody has caught, and end the other ranks, which would wait for this one."""
        self.fail(str(error), 1, lambda _: self._show(kind, error, trace))


class _Nccl:
    """NVIDIA's library for GPUs of several ranks."""

    def __init__(self, others: Ranks, device):
        """Make a communicator of the Warp devices of all ranks."""
        import warp as wp  # noqa: PLC0415 - the command asks for ranks before it quiets Warp

        try:
            self._library = library = ctypes.CDLL(_nccl_path())
        except OSError as error:
            raise InputError(f"device: ranks on GPUs need nvidia-nccl-cu12 or -cu13 of pip ({error})") from None
        self._current = wp.ScopedDevice
        library.ncclGetErrorString.restype = ctypes.c_char_p
        identifier = (ctypes.c_char * _ID_BYTES)()
        if others.rank == 0:
            self._check(library.ncclGetUniqueId(ctypes.byref(identifier)))
        identifier = _Identifier.from_buffer_copy(others.exchange(bytes(identifier))[0])
        self._communicator = ctypes.c_void_p()
        with wp.ScopedDevice(device):
            self._check(
                library.ncclCommInitRank(ctypes.byref(self._communicator), others.size, identifier, others.rank)
            )
            self.merge(wp.zeros(1, dtype=wp.int32, device=device))  # connects, which a graph cannot
            wp.synchronize_device(device)

    def merge(self, array) -> None:
        """Launch :meth:`Ranks.merge` on the device's stream."""
        words = ctypes.c_size_t(array.shape[0] * array.strides[0] // 4)
        place, stream = ctypes.c_void_p(array.ptr), ctypes.c_void_p(array.device.stream.cuda_stream)
        with self._current(array.device):
            self._check(self._library.ncclAllReduce(place, place, words, _INT32, _SUM, self._communicator, stream))

    def _check(self, result: int) -> None:
        if result:
            text = self._library.ncclGetErrorString(result).decode()
            raise InputError(f"device: NCCL between the ranks' GPUs fails ({text}): has each one of its own?")


class _Identifier(ctypes.Structure):
    _fields_ = (("internal", ctypes.c_char * _ID_BYTES),)


def _nccl_path() -> str:
    """The library: of the package ``nvidia-nccl-cu12`` or ``-cu13``, else the system's."""
    try:
        spec = find_spec("nvidia.nccl")
    except ModuleNotFoundError:
        spec = None
    for folder in spec.submodule_search_locations or () if spec else ():
        path = Path(folder, "lib", "libnccl.so.2")
        if path.exists():
            return str(path)
    return "libnccl.so.2"
