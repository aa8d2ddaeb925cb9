"""Wild calls of every public function of builders, models, states and arrays, in child processes: a crash counts.

Four of each by default, one in each kind of world, and six with ``--long``; as many as wanted with
``python -m tests.fuzz.calls``.
"""

import inspect
import os
import re
import signal
from importlib import import_module
from pathlib import Path

import pytest
from fuzz.calls import caller, children, functions, worlds
from fuzz.calls.stages import RECORDS

pytestmark = pytest.mark.no_cover  # what is drawn decides no line of the report
PAGES = Path(__file__).parents[1] / "docs" / "api"
ENTRY = re.compile(r"^\.\. auto(function|class):: (warpmag\.\S+)\n((?:   :.*\n)*)", re.MULTILINE)
HEAVY = ("Simulation", "Display")
"""Owners whose construction takes long: half of the calls."""


@pytest.fixture(scope="module", autouse=True)
def kernels():
    """Compiled before the first fork."""
    for kind in worlds.KINDS:
        worlds.new_world(kind=kind)


@pytest.mark.parametrize("owner", [*functions.OWNERS, "functions"])
def test_wild_calls_are_refused_or_finite(owner, device, request):
    if device != "cpu":
        pytest.skip("a GPU does not survive a fork")
    names = [
        name for name in functions.targets() if (name.partition(".")[0] in functions.OWNERS) == (owner != "functions")
    ]
    names = [name for name in names if owner in ("functions", name.partition(".")[0])]
    count, step = (2, 1) if owner in HEAVY else (4, worlds.OFTEN)  # else each in a world of another kind
    if request.config.getoption("--long"):
        count += count // 2
    numbers = [*range(0, count * step, step)]
    results = [outcome for name in names for outcome in children.outcomes(name, 7, numbers)]
    assert [(outcome.number, outcome.call, outcome.problem) for outcome in results if outcome.problem] == []
    assert len(results) == count * len(names) and any(outcome.taken for outcome in results)


def test_a_crash_is_seen(monkeypatch):
    """The call that ended its process is named, and those after it are made."""

    def call(self, number, announce):
        announce(f"call {number}")
        if number == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return caller.Outcome(number, f"call {number}", taken=True)

    monkeypatch.setattr(caller.Caller, "call", call)
    results = {outcome.number: outcome for outcome in children.outcomes("wrench", 0, list(range(4)))}
    assert sorted(results) == [0, 1, 2, 3]
    assert results[2].call == "call 2" and results[2].problem == f"its process ended with the status {signal.SIGKILL:d}"
    assert not any(results[number].problem for number in (0, 1, 3))


def documented():
    """Names of the functions and of the methods with arguments on the pages; those for Isaac Lab need that program."""
    for page in sorted(set(PAGES.glob("*.md")) - {PAGES / "isaaclab.md"}):
        for kind, path, options in ENTRY.findall(page.read_text(encoding="utf-8")):
            place, _, name = path.rpartition(".")
            if kind == "function":
                yield f"usd.{name}" if place == "warpmag.usd" else name
                continue
            owner, excluded = getattr(import_module(place), name), re.findall(r"\w+", options)
            if owner in RECORDS or "special-members" in options:
                yield name  # the records' methods are called by the functions that author them
            for method, function in vars(owner).items() if ":members:" in options and owner not in RECORDS else ():
                listed = inspect.isfunction(function) and method[0] != "_" and method not in excluded
                if listed and len(inspect.signature(function).parameters) > 1:
                    yield f"{name}.{method}"


def test_every_documented_function_is_called():
    names = set(documented())
    assert {"h_field", "Magnetics.apply", "SensorMagnetometer", "usd.magnet_of", "Coil"} <= names
    assert names - set(functions.targets()) == set()
