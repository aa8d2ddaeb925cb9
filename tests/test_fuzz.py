"""Stages spoiled at random: each is refused with one line, or loads and runs to finite numbers."""

import contextlib
import importlib.util
import math
import warnings
from pathlib import Path

import numpy as np
import pytest

from warpmag.engine.simulation import Simulation
from warpmag.errors import InputError, SimulationError
from warpmag.scenes_usd import balls_up, crystal_balls, falling_magnet
from warpmag.usd import check

COUNT, SEED = 60, 20


def load_mutate():
    spec = importlib.util.spec_from_file_location("mutate", Path(__file__).parent / "fuzz" / "mutate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.mutate


def small_scenes(folder):
    scenes = [folder / f"{name}.usda" for name in ("balls_up", "falling_magnet", "crystal_balls")]
    balls_up.author(scenes[0], columns=2, rows=1, layers=1)
    falling_magnet.author(scenes[1], balls=3, layers=1)
    crystal_balls.author(scenes[2], columns=4, rows=3, bar=2, bar_rows=1)
    return scenes


def run_a_frame(path, device, folder):
    """Run one frame; return the one line by which the stage is refused, or nothing."""
    try:
        simulation = Simulation(path, device=device)
        simulation.run(1, output=folder / "out.usda")
    except (InputError, SimulationError) as error:
        return str(error)
    for values in (simulation.state.body_q, simulation.state.body_qd, simulation.model.body_mass):
        assert np.isfinite(values.numpy()).all(), path
    assert np.isfinite(simulation.magnetics.shape_moments()).all(), path
    assert math.isfinite(simulation.statistics.farthest), path
    return ""


@pytest.fixture(scope="module")
def stages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mutants")
    scenes, mutate = small_scenes(folder), load_mutate()
    found = []
    for number in range(COUNT):
        path = folder / f"{number:03}.usda"
        found.append((path, mutate(scenes[number % len(scenes)], path, SEED * COUNT + number)))
    return found


def test_mutants_repeat(stages, tmp_path):
    again = tmp_path / "again"
    again.mkdir()
    scenes, mutate = small_scenes(again), load_mutate()
    for number in (0, COUNT - 1):
        assert mutate(scenes[number % len(scenes)], again / "one.usda", SEED * COUNT + number) == stages[number][1]
        assert (again / "one.usda").read_text() == stages[number][0].read_text()


def test_spoiled_stages_are_refused_or_run(device, stages, tmp_path):
    refused = 0
    for path, done in stages:
        errors = []
        with warnings.catch_warnings(), contextlib.suppress(InputError):
            warnings.simplefilter("ignore")
            errors = [str(one) for one in check(path).errors]
        line = run_a_frame(path, device, tmp_path)
        refused += bool(line)
        assert "\n" not in line and len(line) < 1000, done
        assert all("\n" not in one for one in errors), done
    assert COUNT // 5 < refused < COUNT  # the mutator does neither too little nor too much
