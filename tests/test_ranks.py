"""Ranks: two processes that mpirun starts end with the bits of one."""

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warpmag.errors import InputError
from warpmag.moments.ranks import Ranks

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


def merged(done) -> list[int]:
    """How often the sums of each rank were merged."""
    return [int(line.split()[1]) for line in done.stderr.splitlines() if line.startswith("merged ")]


@pytest.fixture(scope="module")
def calls(tmp_path_factory, device):
    """What came of one process and of two that call functions, and the results of each of the three."""
    folder, done, results = tmp_path_factory.mktemp("calls"), [], []
    for ranks in (1, 2):
        done.append(start(ranks, "-m", "mpi4py", SCRIPT, "calls", folder / f"of_{ranks}", device[:4]))
        assert done[-1].returncode == 0, done[-1].stderr
        for rank in range(ranks):
            with np.load(folder / f"of_{ranks}_{rank}.npz") as saved:
                results.append(dict(saved))
    return done, results


def test_two_ranks_end_with_the_bits_of_one(calls, device):
    done, (single, *two) = calls
    assert merged(done[0]) == [0]
    first, second = merged(done[1])
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


@pytest.mark.parametrize("sums", ["direct", pytest.param("fmm", marks=pytest.mark.long)])
def test_a_run_by_two_ranks_writes_the_bits_of_one(tmp_path, device, sums):
    from warpmag.scenes_usd import bundled, sakura_tree  # noqa: PLC0415

    scene, runs = tmp_path / "scene.usdc", []
    if device == "cpu":
        shutil.copyfile(bundled()["balls_up"], scene)
    else:  # as many as a GPU shares out
        sakura_tree.author(scene, balls=6000 if sums == "direct" else 400_000)
    for ranks in (1, 2):
        out = tmp_path / f"{ranks}" / "out.usda"
        command = [SCRIPT, "run", scene, "-o", out, "--frames", 1, "--method", sums]
        done = start(ranks, *command, *([] if "cuda" in device else ["--device", device]))
        assert done.returncode == 0, done.stderr
        runs.append(done)
    # fields and forces of substeps; of a GPU those that are captured
    assert merged(runs[0]) == [0] and min(merged(runs[1])) > (30 if device == "cpu" else 0)
    assert runs[0].stdout.count("\n") == runs[1].stdout.count("\n")  # only rank 0 prints
    first, second = ((tmp_path / f"{ranks}" / "out.cache.usdc").read_bytes() for ranks in (1, 2))
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
