"""The web page of a motion, in a real browser without a network."""

import builtins
import math
import time

import numpy as np
import pytest
from browser import CHROMIUM, shown

from warpmag import cli
from warpmag.errors import InputError
from warpmag.show.export import export

pytest.importorskip("viser", reason="needs viser, of the extra 'viewers'")
PLACE, SIDE = 0.05, 0.02  # m
STAGE = f"""#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
    timeCodesPerSecond = 60
    startTimeCode = 0
    endTimeCode = 120
)
def Xform "World"
{{
    def Camera "Camera"
    {{
        float3 xformOp:rotateXYZ = (90, 0, 0)
        double3 xformOp:translate = (0, -1, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }}
    def Cube "Box" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"])
    {{
        bool physics:kinematicEnabled = 1
        double size = {SIDE}
        color3f[] primvars:displayColor = [(0.02, 0.5, 0.02)]
        double3 xformOp:translate.timeSamples = {{ 0: ({-PLACE}, 0, 0), 120: ({PLACE}, 0, 0) }}
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""
"""A green box that a camera on -y sees on its left for two seconds, then on its right."""

HALF = math.sqrt(0.75) * SIDE
AWAY = np.linalg.norm([PLACE + HALF, HALF, HALF]) / math.sin(math.radians(17.5))
"""Distance of a camera of 35° that just sees a ball around the way of the box, turned in any way."""
OUTER, INNER = (PLACE + SIDE / 2) / (AWAY - SIDE / 2), (PLACE - SIDE / 2) / (AWAY + SIDE / 2)
SEEN = 0.5 * (OUTER + INNER) / (OUTER - INNER)
"""Where the box is seen, in its widths from the middle: from the near outer to the far inner edge."""
HIDE = """document.head.appendChild(document.createElement("style")).textContent = \
".mantine-Notifications-root { display: none }\""""
"""Takes away what viser says of a browser without a GPU."""


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "box.usda"
    path.write_text(STAGE)
    return path


def across(page, wanted):
    """Return how far right of the middle the box stands, over its width, once ``wanted`` says so.

    While the page loads, lights and faces come one after the other, and the box is narrower.
    """
    end = time.monotonic() + 300.0  # a page that plays on shows each frame again and again, on a busy machine, too
    seen = set()
    while time.monotonic() < end:
        time.sleep(0.1)
        red, green, blue = np.moveaxis(page.picture(), -1, 0)
        columns = np.flatnonzero(((green > 1.5 * red) & (green > 1.5 * blue)).any(axis=0))
        if len(columns):
            middle = 0.5 * page.evaluate("window.innerWidth")
            place = (columns.mean() + 0.5 - middle) / len(columns)
            if wanted(place):
                return place
            seen.add(round(place, 2))
    raise AssertionError(f"the box was seen at {sorted(seen)} of its widths alone")


@pytest.mark.skipif(CHROMIUM is None, reason="needs the browser Chromium, of Debian's package chromium")
def test_a_page_orbits_and_plays_in_a_browser(stage, tmp_path, capsys):
    assert cli.main(["export", str(stage), "-o", str(tmp_path / "a <page>.html")]) == 0
    assert capsys.readouterr().out == f"written {tmp_path / 'a <page>.html'}\n"
    with shown(tmp_path / "a <page>.html", tmp_path / "browser") as page:
        page.evaluate(HIDE)
        for side in (-SEEN, SEEN):
            across(page, lambda place, side=side: abs(place - side) < 0.1 * SEEN)  # a pixel in some 20, twice
        assert page.evaluate("document.title") == "a <page>"
        height = page.evaluate("Math.max(...[...document.querySelectorAll('canvas')].map(one => one.clientHeight))")
        page.drag((150.0, 100.0), (150.0 + height / 4.0, 100.0))  # by 90°, to where the box comes from or goes to
        across(page, lambda place: abs(place) < 0.7 * SEEN)
        assert page.failures == []
        assert all(url.startswith(("file:", "data:", "blob:")) for url in page.requests) and page.requests


def test_an_invalid_page_raises_an_error_of_one_line(stage, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"cannot be written"):
        export(stage, stage / "page.html")
    real = builtins.__import__

    def without(name, *rest):
        if name == "viser":
            raise ModuleNotFoundError("No module named 'viser'", name="viser")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"a web page needs the extra 'viewers' \(.*\): No module named 'viser'"):
        export(stage, tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []
