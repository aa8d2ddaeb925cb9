"""What runs under ``.ci/sanitize`` would see: each of these faults ends the process that commits it, with its name."""

import subprocess
import sys

import pytest

FAULTS = {
    "behind an array": ("address", "a.data[a.shape[0]] = 1.0f;", "heap-buffer-overflow"),
    "behind a local array": ("address", "float b[4] = {}; a.data[0] = b[a.shape[0]];", "index 16 out of bounds"),
    "overflow": ("address", "int n = 2147483647; a.data[0] = (float)(n + a.shape[0]);", "signed integer overflow"),
    "no such int": ("address", "a.data[0] = (float)(int)(3e9f * a.shape[0]);", "outside the range of representable"),
    "misaligned": ("address", "*(float*)((char*)a.data + a.shape[0] + 1) = 1.0f;", "misaligned address"),
    "race": (
        "thread",
        "warpmag::share_items(team.data, 2, 1 << 20, 1, [&](int) { a.data[0] += 1.0f; });",
        "data race",
    ),
}
PROGRAM = """
import warp as wp
wp.config.cpu_compiler_flags = {flags!r}
from warpmag.kernels.shared import team
from warpmag.kernels.shared.native import native_options
team.cores = lambda: 2
@wp.func_native({snippet!r})
def fault(a: wp.array[float], team: wp.array2d[wp.uint64]): ...
@wp.kernel(module="unique", enable_backward=False, module_options=native_options("shared/team.h", dtype=wp.float32))
def kernel(a: wp.array[float], team: wp.array2d[wp.uint64]):
    fault(a, team)
wp.launch(kernel, dim=1, inputs=[wp.zeros(16, dtype=float, device="cpu"), team.team()], device="cpu")
"""


@pytest.mark.parametrize("which", FAULTS)
def test_faults_are_seen(which, request, tmp_path):
    import warp as wp  # noqa: PLC0415 - as the device fixture does

    sanitizer, snippet, message = FAULTS[which]
    if request.config.getoption("--sanitize") != sanitizer:
        pytest.skip(f"runs under .ci/sanitize {sanitizer}")
    program = tmp_path / "program.py"  # in a file: Warp reads the source of kernels
    program.write_text(PROGRAM.format(flags=wp.config.cpu_compiler_flags, snippet=snippet))
    result = subprocess.run([sys.executable, program], capture_output=True, text=True, timeout=300)
    assert result.returncode != 0
    assert message in result.stderr
