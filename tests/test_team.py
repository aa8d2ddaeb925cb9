"""Threads of a CPU that share the work of a launch, and processes."""

import os
import subprocess
import sys

import pytest

FORK = """
import os
import numpy as np
import warp
from warpmag.kernels.shared import team
import warpmag
warp.config.log_level = warp.LOG_ERROR
team.cores = lambda: 3
rng = np.random.default_rng(1)
x, m = rng.normal(size=(2, 6000, 3))
before = warpmag.h_field(x, m, device="cpu")
assert (team.team().numpy()[:2, 0] > 0).all()  # two members have been started
child = os.fork()
same = np.array_equal(warpmag.h_field(x, m, device="cpu"), before)
if child == 0:
    os._exit(0 if same and (team.team().numpy()[:2, 0] > 0).all() else 1)
print(same, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_has_threads_of_its_own():
    """A fork copies the members' records, but not their threads."""
    result = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=300)
    assert result.stdout.split() == ["True", "0"], result.stderr
