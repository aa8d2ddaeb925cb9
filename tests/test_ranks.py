"""Ranks: two processes that mpirun starts end with the bits of one."""

import importlib.util
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warpmag.errors import InputError
from warpmag.moments.ranks import Ranks
from warpmag.scenes_usd import balls_up, sakura_tree

MPIRUN = Path(sysconfig.get_path("scripts"), "mpirun")
SCRIPT = Path(__file__).with_name("ranks_program.py")
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mpi4py") is None or not MPIRUN.exists(), reason="the extra 'ranks' is not installed"
)


@pytest.fixture(autouse=True, scope="module")
def one_gpu_each(device):
    if "cuda" in device and wp.get_cuda_device_count() < 2:
        pytest.skip("NCCL wants a GPU for each of two ranks")


def start(ranks: int, *command):
    """Run a program of Python's in so many processes, and return what came of it."""
    root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    launcher = [str(MPIRUN), "--oversubscribe", "-n", str(ranks)] if ranks > 1 else []
    return subprocess.run(
        [*launcher, sys.executable, *map(str, command)], env=os.environ | root, capture_output=True, text=True,
        timeout=600,
    )  # fmt: skip


def merged(done, part) -> list[int]:
    """Return how many times each rank merged its sums in a part of the program."""
    return [int(line.split()[2]) for line in done.stderr.splitlines() if line.startswith(f"merged {part} ")]


def run_command(folder, device, ranks, sums):
    """Words of the program that run a scene with some sums; the scene is written into ``folder``."""
    scene = folder / "scene.usdc"
    if device == "cpu":
        balls_up.author(scene, columns=5, rows=5, layers=2)
    else:  # as many as a GPU shares out
        sakura_tree.author(scene, balls=6000 if sums == "direct" else 400_000)
    command = ["run", scene, "-o", folder / f"{ranks}" / "out.usda", "--frames", 1, "--method", sums]
    return [*command, *([] if "cuda" in device else ["--device", device])]


@pytest.fixture(scope="module")
def calls(tmp_path_factory, device):
    """Results of one process and of two that call functions, then run a scene; those of calls of each process."""
    folder, done, results = tmp_path_factory.mktemp("calls"), [], []
    for ranks in (1, 2):
        run = run_command(folder, device, ranks, "direct")
        done.append(start(ranks, "-m", "mpi4py", SCRIPT, "calls", folder / f"of_{ranks}", device[:4], "then", *run))
        assert done[-1].returncode == 0, done[-1].stderr
        for rank in range(ranks):
            with np.load(folder / f"of_{ranks}_{rank}.npz") as saved:
                results.append(dict(saved))
    return done, results, folder


def test_two_ranks_end_with_the_bits_of_one(calls, device):
    done, (single, *two), _ = calls
    assert merged(done[0], "calls") == [0]
    first, second = merged(done[1], "calls")
    # on a CPU some 14 sums of 3 sizes, and those of the worlds; a GPU shares out those of thousands of moments only
    assert first == second > (40 if device == "cpu" else 4)
    for other in two:
        assert other.keys() == single.keys() >= {"sweep", "worlds", "multipole force"}
        for name, bits in other.items():
            assert np.isfinite(bits).all(), name
            assert single[name].tobytes() == bits.tobytes(), name


def test_worlds_of_a_sweep_are_each_its_own(calls):
    poses = calls[1][0]["sweep"]
    assert poses.shape == (5, 2, 7)
    assert (poses[:, 0, 2] != poses[0, 0, 2]).sum() == 4  # in another field a ball is pulled otherwise


def test_a_difference_raises_an_error_of_one_line_on_all_ranks(calls):
    given = "differs between rank 1 and rank 0; the ranks of one calculation need equal arguments"
    lines = {
        "h_field": f"positions: {given}",
        "not finite": f"moments: {given}",
        "wrench": f"radii: {given}",
        "solve_induction": f"saturation: {given}",
        "permanent": f"permanent: {given}",
        "Magnetics": f"Magnetics: model.warpmag.saturation: {given}",
        "rtol": f"Magnetics: rtol: {given}",
        "Simulation": f"step: {given}",
        "one only": "rank 1: no.usda: no such file",
        "on_first_rank": "rank 0: ZeroDivisionError: integer division or modulo by zero",
        "sweep": "rank 1: ZeroDivisionError: integer division or modulo by zero",
    }
    printed = calls[0][1].stdout.splitlines()
    for name, line in lines.items():
        assert {f"{rank} {name}: {line}" for rank in range(2)} <= set(printed), name


def summary(done) -> list[str]:
    """Lines of a run, without those of calls, which begin with the rank."""
    return [line for line in done.stdout.splitlines() if line[:2] not in ("0 ", "1 ")]


@pytest.mark.parametrize("sums", ["direct", pytest.param("fmm", marks=pytest.mark.long)])
def test_a_run_by_two_ranks_writes_the_bits_of_one(calls, tmp_path, device, sums):
    runs, _, folder = calls
    if sums != "direct":
        runs, folder = [start(n, SCRIPT, *run_command(tmp_path, device, n, sums)) for n in (1, 2)], tmp_path
        assert [done.returncode for done in runs] == [0, 0], [done.stderr for done in runs]
    # fields and forces of substeps; of a GPU those that are captured
    assert merged(runs[0], "run") == [0] and min(merged(runs[1], "run")) > (30 if device == "cpu" else 0)
    assert len(summary(runs[0])) == len(summary(runs[1])) > 0  # only rank 0 prints
    first, second = ((folder / f"{ranks}" / "out.cache.usdc").read_bytes() for ranks in (1, 2))
    assert first == second


def test_a_graph_of_a_cpu_that_would_not_merge_sums_is_refused():
    sums = wp.zeros(3, dtype=float, device="cpu")
    with wp.ScopedCapture("cpu"), pytest.raises(InputError, match="a graph of a CPU cannot exchange"):
        Ranks.merge(object.__new__(Ranks), sums)


@pytest.mark.long
@pytest.mark.parametrize(
    "end, line",
    [("os.kill(os.getpid(), 9)", "signal 9"), ("raise warpmag.InputError('bad: here')", "Error: bad: here")],
)
def test_a_rank_that_ends_leaves_none_waiting(end, line):
    lines = (
        "import os, numpy as np, warpmag",
        "from warpmag.moments.ranks import current_ranks",
        f"if current_ranks().rank: {end}",
        "warpmag.h_field(np.eye(3), np.eye(3), device='cpu')",
    )
    done = start(2, "-c", "\n".join(lines))
    assert done.returncode != 0
    assert done.stderr.count(line) == 1, done.stderr


@pytest.mark.parametrize(
    "output, line",
    [("", "no such file"), pytest.param("/proc/out.usda", "rank 0: /proc/out.usda", marks=pytest.mark.long)],
)
def test_a_failure_prints_one_line(output, line, tmp_path):
    command = ["-m", "warpmag.cli", "run", tmp_path / "no.usda" if not output else "falling_magnet", "--device", "cpu"]
    done = start(2, *command, *(["-o", output] if output else []))
    assert done.returncode == 2
    lines = [entry for entry in done.stderr.splitlines() if entry.startswith("warpmag: ")]
    assert len(lines) == 1 and line in lines[0], done.stderr
