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
from warpmag.ranks import Ranks

MPIRUN = Path(sysconfig.get_path("scripts"), "mpirun")
SCRIPT = Path(__file__).with_name("ranks_program.py")
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mpi4py") is None or not MPIRUN.exists(), reason="the extra 'ranks' is not installed"
)


def start(ranks: int, *command):
    """Run a program of Python's in so many processes, and return what came of it."""
    root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    launcher = [str(MPIRUN), "--oversubscribe", "-n", str(ranks)] if ranks > 1 else []
    return subprocess.run(
        [*launcher, sys.executable, *map(str, command)], env=os.environ | root, capture_output=True, text=True,
        timeout=600,
    )  # fmt: skip


def test_two_ranks_end_with_the_bits_of_one(tmp_path, device):
    results = []
    for ranks in (1, 2):
        done = start(ranks, "-m", "mpi4py", SCRIPT, tmp_path / f"of_{ranks}", device[:4])
        assert done.returncode == 0, done.stderr
        for rank in range(ranks):
            with np.load(tmp_path / f"of_{ranks}_{rank}.npz") as saved:
                results.append(dict(saved))
    one, *two = results
    assert one["merged"] == 0
    for other in two:
        assert other.pop("merged") > 10  # so many sums were shared out
        for name, bits in other.items():
            assert np.isfinite(bits).all(), name
            assert one[name].tobytes() == bits.tobytes(), name


def test_a_run_by_two_ranks_writes_the_bits_of_one(tmp_path, device):
    scene = tmp_path / "scene.usdc"
    from warpmag.scenes_usd import bundled  # noqa: PLC0415

    shutil.copyfile(bundled()["balls_up"], scene)
    told = []
    for ranks in (1, 2):
        out = tmp_path / f"{ranks}" / "out.usda"
        command = ["-m", "warpmag.cli", "run", scene, "-o", out, "--frames", 1]
        done = start(ranks, *command, *([] if "cuda" in device else ["--device", device]))
        assert done.returncode == 0, done.stderr
        told.append(done)
    assert told[0].stdout.count("\n") == told[1].stdout.count("\n")  # rank 0 alone tells of it
    first, second = ((tmp_path / f"{ranks}" / "out.cache.usdc").read_bytes() for ranks in (1, 2))
    assert first == second


def test_a_graph_of_a_cpu_that_would_not_merge_sums_is_refused():
    sums = wp.zeros(3, dtype=float, device="cpu")
    with wp.ScopedCapture("cpu"), pytest.raises(InputError, match="no graph of a CPU"):
        Ranks.merge(object.__new__(Ranks), sums)


def test_ranks_with_other_input_are_told_so():
    program = (
        "import numpy as np, warpmag, warpmag.ranks as r\n"
        "x = np.eye(3) * (1 + r.ranks().rank)\n"
        "try: warpmag.h_field(x, x, device='cpu')\n"
        "except warpmag.InputError as error: print(error)\n"
    )
    done = start(2, "-c", program)
    assert done.stdout.count("rank 1 was given others than rank 0") == 2, done.stderr


@pytest.mark.parametrize(
    "output, line",
    [("", "no such file"), pytest.param("/proc/out.usda", "rank 0: /proc/out.usda", marks=pytest.mark.long)],
)
def test_a_failure_is_told_in_one_line(output, line, tmp_path):
    command = ["-m", "warpmag.cli", "run", tmp_path / "no.usda" if not output else "falling_magnet", "--device", "cpu"]
    done = start(2, *command, *(["-o", output] if output else []))
    assert done.returncode == 2
    lines = [one for one in done.stderr.splitlines() if one.startswith("warpmag: ")]
    assert len(lines) == 1 and line in lines[0], done.stderr
