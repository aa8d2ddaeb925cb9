"""Options, markers and fixtures of the whole test suite."""

import atexit
import functools
import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

if "PYTEST_XDIST_WORKER" in os.environ:  # a worker has a core: threads of NumPy's would wait for those of the others
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):  # tests start many interpreters, which import Newton
    os.environ["PYTHONPYCACHEPREFIX"] = tempfile.mkdtemp(prefix="warpmag_bytecode_")
    atexit.register(shutil.rmtree, os.environ["PYTHONPYCACHEPREFIX"], ignore_errors=True)
FOLDER = Path(__file__).parent
UNDEFINED = (
    *("alignment", "array-bounds", "bool", "builtin", "enum", "float-cast-overflow", "integer-divide-by-zero"),
    *("nonnull-attribute", "null", "object-size", "pointer-overflow", "return", "returns-nonnull-attribute"),
    *("shift-base", "shift-exponent", "signed-integer-overflow", "unreachable", "vla-bound"),
)
"""What Clang's driver calls ``undefined``, of what kernels can do; the compiler inside Warp knows no groups."""
QUICK = {
    *("structure", "oracle", "curves", "materials", "lattice", "harmonics", "pair_sums", "neighbors", "near_sums"),
    *("eddy", "translation", "applied", "baseline_dynamics", "system", "cells_compound", "coils"),
    *("engine_attributes", "engine_magnetics", "engine_simulation", "engine_xpbd", "stepping", "balls", "broad_phase"),
    *("ball_contacts", "coulomb", "near_contact_extremes", "usd_schemas", "usd_reader", "usd_crate", "usd_output"),
    *("usd_output_files", "export", "viewers", "observables"),
}
"""Files of tests marked ``quick``: every room, in under a minute on two cores with compiled kernels."""
SANITIZERS = {
    "address": f"-fsanitize={','.join(('address', *UNDEFINED))} -fsanitize-ignorelist={FOLDER}/sanitize_not.txt",
    "thread": "-fsanitize=thread -mllvm -tsan-instrument-memintrinsics=0",  # GCC's runtime lacks __tsan_memcpy
}
"""Flags that instrument native code. Warp refuses ``-fsanitize=address`` alone, which its own build must match."""


def pytest_addoption(parser):
    parser.addoption(
        "--device",
        default="cpu",
        help="Warp device that tests run on: cpu (default), cuda:0, ...; or emulated, CUDA's kernels on a CPU",
    )
    parser.addoption("--only-device", action="store_true", help="leave out tests that do the same whatever the device")
    parser.addoption("--long", action="store_true", help="also run the tests marked 'long' (minutes)")
    parser.addoption("--wild", type=int, default=150, metavar="N", help="wild calls of a function (default: 150)")
    parser.addoption(
        "--cpu",
        metavar="NAME",
        help="compile native code for this kind of processor, as Clang names it: haswell, znver3, x86-64-v3, ...",
    )
    parser.addoption("--sanitize", choices=tuple(SANITIZERS), help="instrument native code; what .ci/sanitize uses")


def pytest_configure(config):
    slow = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    settings.register_profile(
        "wild", max_examples=config.getoption("--wild"), deadline=None, suppress_health_check=slow
    )
    settings.load_profile("wild")
    if config.getoption("--device") == "emulated":
        import cuda_on_cpu  # noqa: PLC0415 - takes a while, and changes Warp for good

        cuda_on_cpu.start()
    if name := config.getoption("--cpu"):
        import warp as wp  # noqa: PLC0415 - kernels take the flags when they are imported

        wp.config.cpu_compiler_flags = wp.config.cpu_compiler_flags.replace("-march=native", f"-target-cpu {name}")
    if kind := config.getoption("--sanitize"):
        import warp as wp  # noqa: PLC0415 - kernels take the flags when they are imported

        wp.config.cpu_compiler_flags = f"-march=native {SANITIZERS[kind]}"


def pytest_collectstart():
    """Have Newton's kernels compiled as the command does, where test files import them: without their derivatives."""
    import warp as wp  # noqa: PLC0415 - not by the process that only hands out tests

    wp.config.enable_backward = False


def pytest_collection_finish():
    """Have Newton write the sources of its contact kernels once a process, not at each of a thousand simulations."""
    if phase := sys.modules.get("newton._src.geometry.narrow_phase"):
        for name, create in list(vars(phase).items()):
            if name.startswith("create_narrow_phase"):
                setattr(phase, name, functools.cache(create))


def pytest_collection_modifyitems(config, items):
    for item in items:
        if item.path.stem.removeprefix("test_") in QUICK:
            item.add_marker(pytest.mark.quick)
    if config.getoption("--only-device"):
        on_it = [x for x in items if "device" in x.fixturenames or x.get_closest_marker("cuda")]
        config.hook.pytest_deselected(items=[x for x in items if x not in on_it])
        items[:] = on_it
    skips = {}
    if not config.getoption("--long"):
        skips["long"] = pytest.mark.skip(reason="takes minutes: runs with --long")
    if not config.getoption("--device").startswith(("cuda", "emulated")):
        skips["cuda"] = pytest.mark.skip(reason="needs a CUDA device: runs with --device cuda:0")
    for item in items:
        for marker, skip in skips.items():
            if item.get_closest_marker(marker):
                item.add_marker(skip)


@pytest.fixture(scope="session")
def device(request):
    """Name of the Warp device under test; a name that Warp does not know fails every test that asks for it."""
    import warp as wp  # noqa: PLC0415 - only tests that launch kernels pay for this import

    wp.config.log_level = wp.LOG_WARNING
    wp.config.verbose_warnings = False
    name = request.config.getoption("--device")
    return str(wp.get_device("cpu" if name == "emulated" else name))
