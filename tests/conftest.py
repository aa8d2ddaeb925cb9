"""Options, markers and fixtures of the whole test suite.

Warp is imported by the ``device`` fixture only, so that tests of host code start without it.
"""

import pytest


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device that tests run on: cpu (default), cuda:0, ...")
    parser.addoption("--long", action="store_true", help="also run the tests marked 'long' (minutes)")


def pytest_collection_modifyitems(config, items):
    skips = {}
    if not config.getoption("--long"):
        skips["long"] = pytest.mark.skip(reason="takes minutes: runs with --long")
    if not config.getoption("--device").startswith("cuda"):
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
    wp.config.enable_backward = False  # as the command does, so that both find the same compiled kernels
    return str(wp.get_device(request.config.getoption("--device")))
