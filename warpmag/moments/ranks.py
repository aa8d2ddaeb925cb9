"""Ranks: processes started by ``mpirun`` that share the sums over pairs of one simulation.

Each rank holds all moments, and uses one GPU if the host has GPUs. It computes its share of the list of pairs and
then receives the sums of the other ranks. Every rank does all other work itself. The list of pairs does not depend on
the number of ranks, so that results are bitwise the same. A single process imports neither MPI nor NCCL.

Sums are merged as integers. Each rank stores its own sums, and zeros elsewhere. Adding zeros to the bits of a number
does not change them, in any order. ``mpi4py`` merges arrays of CPUs and across hosts. NVIDIA's NCCL merges arrays of
GPUs. Python calls the NCCL library directly, so that a CUDA graph captures it between kernels.

An error of one rank is exchanged before any rank waits for sums: for the arguments of calls, for work that the first
rank does for all, and at the end of a sweep. All ranks then raise the same message.
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

from warpmag.declarations.checks import check_count, short_repr
from warpmag.errors import InputError, SimulationError, extra, one_line

_COUNTS = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE")
"""Environment variables of launchers with the number of processes."""
_ABORT_DELAY = 5.0
"""Time [s] that a failed rank waits for the others to fail as well, before it aborts them."""
_ID_BYTES, _INT32, _SUM = 128, 2, 0
"""NCCL's size of a unique identifier [bytes], type ``ncclInt32`` and operation ``ncclSum`` (``nccl.h``)."""

_P = ParamSpec("_P")
_R = TypeVar("_R")
_disabled = 0
"""Number of :func:`without_ranks` contexts that are open."""


@cache
def launched_ranks() -> "Ranks | None":
    """Return the ranks that a launcher started, or None in a single process. Ranks need ``mpi4py``."""
    if all(os.environ.get(name, "1") == "1" for name in _COUNTS):
        return None
    try:
        from mpi4py import MPI  # noqa: PLC0415 - initializes MPI, allowed in processes of a launcher only
    except ImportError as error:
        raise InputError(f"mpirun: ranks need {extra('ranks')}: {error}") from None
    return Ranks(MPI) if MPI.COMM_WORLD.size > 1 else None


def current_ranks() -> "Ranks | None":
    """Return the ranks that share the sums of newly made objects, or None if this process computes all sums."""
    return None if _disabled else launched_ranks()


@contextmanager
def without_ranks() -> Iterator[None]:
    """Make this process compute all sums of objects made in this context, also later, without the other ranks."""
    global _disabled  # for all threads, because a thread that shared sums would wait for the other ranks
    _disabled += 1
    try:
        yield
    finally:
        _disabled -= 1


@contextmanager
def errors_on_all_ranks(all_ranks: "Ranks | None") -> Iterator[None]:
    """Raise an error of one rank on all ranks. The ranks may exchange values in this context, but not merge arrays."""
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


def is_first_rank(all_ranks: "Ranks | None") -> bool:
    """Return True on the rank that writes files and prints: the first one, or a single process."""
    return all_ranks is None or all_ranks.rank == 0


def on_first_rank(function: Callable[[], Any], all_ranks: "Ranks | None") -> Any:
    """Call a function on the first rank only; return its result, or raise its error, on all ranks."""
    if all_ranks is None:
        return function()
    with errors_on_all_ranks(all_ranks):
        return all_ranks.exchange(function() if is_first_rank(all_ranks) else None)[0]


def compare_arguments(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function to raise ``InputError`` on all ranks if its arguments differ between ranks."""
    signature = inspect.signature(function)

    @wraps(function)
    def compared(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if (all_ranks := current_ranks()) is not None:
            arguments = signature.bind(*args, **kwargs).arguments
            arguments.pop("device", None)  # each rank has its own
            all_ranks.check_equal(arguments)
        return function(*args, **kwargs)

    return compared


def sweep(simulate: Callable[[range], _R], world_count: int, *, together: int) -> list[_R]:
    """Simulate many worlds in groups, which the ranks of ``mpirun`` share.

    Each rank simulates its groups on its own. At the end all ranks receive all results. Worlds of a group may share
    substeps and the method of summation, so results may depend on ``together``. They do not depend on the number of
    ranks: they are bitwise identical to those of a single process if ``simulate`` itself repeats bit by bit.

    Args:
        simulate: Function that takes the range of the worlds of a group. Its result is sent to all ranks and must be
            picklable, such as NumPy arrays.
        world_count: Number of worlds.
        together: Worlds of a group; the last group may have fewer. Rank r of R simulates every R-th group from the
            r-th on.

    Returns:
        The result of each group, in the order of worlds; the same on all ranks.

    Raises:
        InputError: ``simulate`` is not a function; ``world_count`` or ``together`` is not a whole number from 1 on, or
            differs between ranks. An error of ``simulate`` on one rank is raised on all ranks.

    Example:
        >>> import warpmag
        >>> warpmag.sweep(lambda worlds: [world**2 for world in worlds], 5, together=2)
        [[0, 1], [4, 9], [16]]
    """
    if not callable(simulate):
        raise InputError(f"simulate: must be a function, got {short_repr(simulate)}")
    check_count("world_count", world_count)
    check_count("together", together)
    groups = [range(first, min(first + together, world_count)) for first in range(0, world_count, together)]
    all_ranks = current_ranks()
    if all_ranks is None:
        return [simulate(worlds) for worlds in groups]
    all_ranks.check_equal({"world_count": world_count, "together": together})
    with errors_on_all_ranks(all_ranks):
        own_results = []
        with without_ranks():
            for worlds in groups[all_ranks.rank :: all_ranks.size]:
                if all_ranks.has_failed():
                    break
                own_results.append(pickle.dumps(simulate(worlds)))  # here, so that its error reaches all ranks
        results = all_ranks.exchange(own_results)
    return [pickle.loads(results[group % all_ranks.size][group // all_ranks.size]) for group in range(len(groups))]


def _checksum(value: Any, before: int = 0) -> int:
    """Return a checksum of an argument, equal in all processes for equal values. Other objects count by type."""
    if hasattr(value, "numpy"):
        value = value.numpy()
    if isinstance(value, (list, tuple)):
        try:
            array = np.asarray(value)
        except Exception:  # rows of different lengths, or an object that raises
            array = np.zeros((), object)
        value = value if array.dtype.hasobject else array
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, (list, tuple)):
        for item in value:
            before = _checksum(item, before)
        return zlib.crc32(b"[]", before)
    if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
        data = np.ascontiguousarray(value)
        before = zlib.crc32(f"{data.dtype} {np.shape(value)}".encode(), before)
        return zlib.crc32(data.reshape(-1).view(np.uint8), before)
    plain = value is None or isinstance(value, (str, bytes, bool, int, float, os.PathLike))
    return zlib.crc32((repr(value) if plain else type(value).__qualname__).encode(), before)


class Ranks:
    """Processes of one program that MPI connects.

    Attributes:
        size: Number of processes.
        rank: Number of this process, from 0.
        local_rank: Number of this process on its host, from 0.
    """

    def __init__(self, mpi):
        """Join the processes that the launcher started; ``mpi`` is the module ``mpi4py.MPI``."""
        self._mpi, self._all = mpi, mpi.COMM_WORLD
        self.size, self.rank = self._all.size, self._all.rank
        host = self._all.Split_type(mpi.COMM_TYPE_SHARED)
        self.local_rank = host.rank
        self._failures, self._gpus = self._all.Dup(), None
        self._excepthook, sys.excepthook = sys.excepthook, self._fail_uncaught

    def share(self, count: int) -> tuple[int, int]:
        """Return begin and end of this rank's share of ``count`` pieces of work."""
        return count * self.rank // self.size, count * (self.rank + 1) // self.size

    def merge(self, array) -> None:
        """Sum a contiguous Warp array over all ranks, in place. Each 32-bit word may be nonzero on one rank only."""
        if array.device.is_cuda:
            self._gpus = self._gpus or _Nccl(self, array.device)
            self._gpus.merge(array)
            return
        if array.device.is_capturing:
            raise InputError("device: a graph of a CPU cannot exchange arrays between ranks; launch without a graph")
        self._all.Allreduce(self._mpi.IN_PLACE, array.numpy().reshape(-1).view(np.int32), self._mpi.SUM)

    def exchange(self, value: Any, error: Exception | None = None) -> list:
        """Return the values of all ranks. If ranks pass an error, all ranks raise the error of the first of them."""
        others = range(self.size) if error is not None else ()
        notices = [self._failures.isend(None, other) for other in others if other != self.rank]
        kind = type(error) if isinstance(error, (InputError, SimulationError)) else RuntimeError
        text = str(error) if kind is type(error) else f"{type(error).__name__}: {error}"
        each = self._all.allgather((None if error is None else (kind, text), value))
        failed = [rank for rank, (line, _) in enumerate(each) if line is not None]
        for rank in failed:
            if rank != self.rank:
                self._failures.recv(source=rank)
        for notice in notices:
            notice.wait()
        if not failed:
            return [value for _, value in each]
        kind, text = each[failed[0]][0]
        if any(line != (kind, text) for line, _ in each):
            text = f"rank {failed[0]}: {text}"
        shared = kind(one_line(text))
        shared.__dict__["of_all_ranks"] = True
        raise shared from error

    def has_failed(self) -> bool:
        """Return True if another rank waits in :meth:`exchange` with an error."""
        return self._failures.iprobe()

    def check_equal(self, values: dict[str, Any], prefix: str = "") -> None:
        """Raise ``InputError`` on all ranks if a value differs. Messages begin with ``prefix`` and the value's name."""
        each = self.exchange({name: _checksum(value) for name, value in values.items()})
        for rank, other in enumerate(each):
            for name in (*each[0], *other):
                if each[0].get(name) != other.get(name):
                    text = f"{prefix}{name}: differs between rank {rank} and rank 0"
                    raise InputError(f"{text}; the ranks of one calculation need equal arguments")

    def fail(self, line: str, code: int, show) -> None:
        """Report a failure once by ``show(line)``: on rank 0 if all ranks fail.

        Otherwise this rank reports it, and aborts the others with the exit code.
        """
        barrier, until = self._failures.Ibarrier(), time.monotonic() + _ABORT_DELAY
        while not barrier.Test():
            if time.monotonic() > until:
                show(f"rank {self.rank}: {line}")
                sys.stdout.flush()
                self._all.Abort(code)
            time.sleep(0.01)
        if self.rank == 0:
            show(line)

    def _fail_uncaught(self, kind, error, trace) -> None:
        """Show an uncaught exception, and abort the other ranks, which would wait for this rank."""
        self.fail(str(error), 1, lambda _: self._excepthook(kind, error, trace))


class _Nccl:
    """NVIDIA's library NCCL, which merges arrays on the GPUs of several ranks."""

    def __init__(self, ranks: Ranks, device):
        """Make a communicator of all ranks, each with its Warp device."""
        import warp as wp  # noqa: PLC0415 - the command reads the ranks before it silences Warp

        try:
            self._library = library = ctypes.CDLL(_nccl_path())
        except OSError as error:
            raise InputError(f"device: ranks on GPUs need nvidia-nccl-cu12 or -cu13 of pip ({error})") from None
        self._scoped_device = wp.ScopedDevice
        library.ncclGetErrorString.restype = ctypes.c_char_p
        identifier = (ctypes.c_char * _ID_BYTES)()
        if ranks.rank == 0:
            self._check(library.ncclGetUniqueId(ctypes.byref(identifier)))
        identifier = _Identifier.from_buffer_copy(ranks.exchange(bytes(identifier))[0])
        self._communicator = ctypes.c_void_p()
        with wp.ScopedDevice(device):
            self._check(library.ncclCommInitRank(ctypes.byref(self._communicator), ranks.size, identifier, ranks.rank))
            self.merge(wp.zeros(1, dtype=wp.int32, device=device))  # connects the ranks, impossible in a graph
            wp.synchronize_device(device)

    def merge(self, array) -> None:
        """Launch :meth:`Ranks.merge` on the stream of the device."""
        words = ctypes.c_size_t(array.shape[0] * array.strides[0] // 4)
        pointer, stream = ctypes.c_void_p(array.ptr), ctypes.c_void_p(array.device.stream.cuda_stream)
        with self._scoped_device(array.device):
            self._check(self._library.ncclAllReduce(pointer, pointer, words, _INT32, _SUM, self._communicator, stream))

    def _check(self, result: int) -> None:
        if result:
            text = self._library.ncclGetErrorString(result).decode()
            raise InputError(f"device: NCCL between the ranks' GPUs failed ({text}); each rank needs a GPU of its own")


class _Identifier(ctypes.Structure):
    _fields_ = (("internal", ctypes.c_char * _ID_BYTES),)


def _nccl_path() -> str:
    """Return the path of NCCL in the package ``nvidia-nccl-cu12`` or ``-cu13``, or its name in the system."""
    try:
        spec = find_spec("nvidia.nccl")
    except ModuleNotFoundError:
        spec = None
    for folder in spec.submodule_search_locations or () if spec else ():
        path = Path(folder, "lib", "libnccl.so.2")
        if path.exists():
            return str(path)
    return "libnccl.so.2"
