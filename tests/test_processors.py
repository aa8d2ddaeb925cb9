"""Sums on CPUs of other kinds than this one."""

import subprocess
import sys
from pathlib import Path

import pytest

CPU, FOLDER = Path("/proc/cpuinfo"), Path(__file__).resolve().parent
PROGRAM = """
import sys
sys.path += [{folder!r}, {root!r}]
import warp as wp, warpmag
from arrangements import pile, relative
from bench.reference import oracle
wp.config.cpu_compiler_flags, wp.config.kernel_cache_dir = "-target-cpu haswell", {cache!r}
x, mixed, m = pile(count=700)
for radii in (None, 0.0049, mixed):
    print("error", relative(warpmag.h_field(x, m, radii=radii, device="cpu"), oracle.h_field(x, m, radii=radii)))
forces, torques = warpmag.wrench(x, m, radii=mixed, device="cpu")
print("error", relative(torques, oracle.torque(m, oracle.h_field(x, m, radii=mixed))))
print("error", relative(forces, oracle.kelvin_force(m, oracle.field_gradient(x, m, radii=mixed))))
"""
"""Fields and forces with vectors of 256 bits, of points, balls of one radius and balls of three."""


@pytest.mark.skipif(not CPU.exists() or "avx2" not in CPU.read_text().split(), reason="needs a CPU with AVX2")
def test_narrower_vectors(device, tmp_path):
    """As on a CPU without AVX-512: the compiler has nothing to say of them."""
    if device != "cpu":
        pytest.skip("of a CPU")
    program = PROGRAM.format(folder=str(FOLDER), root=str(FOLDER.parent), cache=str(tmp_path))
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    errors = [float(line.split()[1]) for line in run.stdout.splitlines() if line.startswith("error")]
    assert len(errors) == 5
    assert all(error < 1e-6 for error in errors)  # as of wider vectors, see test_fields.py
    assert "[-W" not in run.stderr
