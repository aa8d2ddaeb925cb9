"""Ranks: processes that ``mpirun`` starts, and that share out the sums over pairs of one simulation.

Each rank has all moments, and on a host with GPUs one of these. It sums its part of the work list of all pairs, and
gets what the others summed; all that is small it does as they do. The work list is that of one process, so that the
results are its bits. A process by itself has no ranks, and imports nothing for them.

A rank stores sums where the others have zeros. Bits are merged, not numbers: to add zeros as integers keeps a number as
it is, whatever the order. ``mpi4py`` does that on CPUs and across hosts, and between GPUs NVIDIA's NCCL, whose library
is called directly: it is captured in a CUDA graph with the kernels before and after.
"""

import ctypes
import os
import sys
import time
import zlib
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from warpmag.errors import InputError

_COUNTS = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE")
"""What launchers tell their processes: how many they are."""
_GRACE = 5.0
"""Time [s] in which ranks that fail alike all do."""
_ID_BYTES, _INT32, _SUM = 128, 2, 0
"""Size of NCCL's unique identifier, and its numbers of a type and an operation (``nccl.h``)."""


@cache
def ranks() -> "Ranks | None":
    """The ranks that this process is one of; None where it is by itself.

    Raises:
        InputError: A launcher has started several processes, but ``mpi4py`` is not installed.
    """
    if all(os.environ.get(name, "1") == "1" for name in _COUNTS):
        return None
    try:
        from mpi4py import MPI  # noqa: PLC0415 - initializes MPI, which only processes of a launcher may
    except ImportError as error:
        raise InputError(f"mpirun: ranks need the extra 'ranks', pip install 'warpmag[ranks]' ({error})") from None
    return Ranks(MPI) if MPI.COMM_WORLD.size > 1 else None


def is_first(all_ranks: "Ranks | None") -> bool:
    """Whether this process is the one that writes and prints: the first rank, or one by itself."""
    return all_ranks is None or all_ranks.rank == 0


def by_first(do: Callable):
    """Return what ``do`` returns; of several ranks the first does it for all."""
    all_ranks = ranks()
    if all_ranks is None:
        return do()
    return all_ranks.broadcast(do() if is_first(all_ranks) else None)


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

    def share(self, count: int) -> tuple[int, int]:
        """Begin and end of this rank's part of ``count`` pieces of work."""
        return count * self.rank // self.size, count * (self.rank + 1) // self.size

    def merge(self, array) -> None:
        """Give each rank what any of them has in a contiguous Warp array, where the others have zeros."""
        if array.device.is_cuda:
            self._gpus = self._gpus or _Nccl(self, array.device)
            self._gpus.merge(array)
            return
        self._all.Allreduce(self._mpi.IN_PLACE, array.numpy().reshape(-1).view(np.int32), self._mpi.SUM)

    def check_alike(self, what: str, *values) -> None:
        """Raise ``InputError`` on all ranks where ``values``, arrays or texts, differ between them."""
        mine = 0
        for value in values:
            if isinstance(value, str):
                value = np.frombuffer(value.encode(), np.uint8)
            data = value if isinstance(value, np.ndarray) else value.numpy()
            mine = zlib.crc32(np.ascontiguousarray(data).reshape(-1).view(np.uint8), mine)
        each = self._all.allgather(mine)
        other = next((rank for rank, one in enumerate(each) if one != each[0]), None)
        if other is not None:
            raise InputError(f"{what}: rank {other} was given others than rank 0; ranks share out one calculation")

    def broadcast(self, value):
        """Return what rank 0 has."""
        return self._all.bcast(value)

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
        identifier = _Identifier.from_buffer_copy(others.broadcast(bytes(identifier)))
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
