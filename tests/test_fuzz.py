"""Stages spoiled at random: each ends in one line, or in a run that says what the stage says.

Two of each source by default, eighteen more with ``--long``, and as many as wanted with ``python -m tests.fuzz``.
"""

import math
import os
import signal
import time

import pytest
from fuzz import campaign, truth
from fuzz.campaign import BAD_INPUT, OK, Campaign, Verdict, in_process, judge, make
from fuzz.resumes import author_runs, judge_resume
from fuzz.sources import author
from pxr import Usd
from small_stages import physics, write

from warpmag.engine.stepping.scene import import_scene

FEW, MANY, SEED = range(14), range(14, 140), 20
"""Mutants that are judged by default, and with ``--long``; sources take turns."""


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    return author(tmp_path_factory.mktemp("sources"))


def test_mutants_repeat(sources, tmp_path):
    for number in range(0, 60, 13):
        made = []
        for name in ("once", "again"):
            folder = tmp_path / f"{name}{number}"
            folder.mkdir()
            path, _, done = make(number, SEED, folder, sources)
            made.append((done, path.read_bytes()))
        assert made[0] == made[1]


@pytest.mark.no_cover  # what is drawn decides no line of the report, and counting lines doubles its time
@pytest.mark.parametrize("numbers", [FEW, pytest.param(MANY, marks=pytest.mark.long)], ids=["few", "many"])
def test_spoiled_stages_are_refused_or_run(numbers, device, sources, tmp_path):
    verdicts = [judge(number, SEED, tmp_path, sources, in_process, device) for number in numbers]
    assert [(verdict.number, verdict.done, verdict.problems) for verdict in verdicts if verdict.problems] == []
    refused = sum(verdict.run == BAD_INPUT for verdict in verdicts)
    assert len(numbers) // 5 < refused < len(numbers)  # the mutator does neither too little nor too much


@pytest.mark.no_cover
def test_spoiled_runs_are_refused_or_resumed(device, sources, tmp_path):
    """Also by the values of a run that nobody interrupted."""
    if device != "cpu":
        pytest.skip("bits are compared")
    runs = author_runs(sources[:1], tmp_path / "runs")
    verdicts = [judge_resume(number, SEED, tmp_path, runs, in_process) for number in range(12)]
    assert [(verdict.number, verdict.done, verdict.problems) for verdict in verdicts if verdict.problems] == []
    assert {verdict.run for verdict in verdicts} == {OK, BAD_INPUT}


WEIGHS = {
    "its material": ("", "", 7870.0),
    "its own density": ("float physics:density = 500", "", 500.0),
    "that of what is bound": ("rel material:binding:physics = </World/Oak>", "float physics:density = 700", 700.0),
    "nothing else": ("rel material:binding:physics = </World/Oak>", "", 7870.0),
}


@pytest.mark.parametrize("metres", [1.0, 0.01])
@pytest.mark.parametrize("case", WEIGHS)
def test_what_a_named_material_weighs_is_known_to_both(case, metres, tmp_path):
    """Of USD alone as the campaign reads it, and of the model."""
    lines, of_oak, density = WEIGHS[case]
    schemas = "RigidBody Collision Mass".split()
    iron = f"""def Sphere "Ball" (prepend apiSchemas = [{"".join(f'"Physics{schema}API", ' for schema in schemas)}
        "MaterialBindingAPI", "WarpmagMagnetAPI"]) {{
        uniform token warpmag:material = "iron"
        {lines}
    }}
    def Material "Oak" (prepend apiSchemas = ["PhysicsMaterialAPI"]) {{
        {of_oak}
    }}
    """
    path = write(tmp_path, physics(), iron)
    path.write_text(path.read_text().replace("metersPerUnit = 1", f"metersPerUnit = {metres}"))
    stage = Usd.Stage.Open(str(path))
    usual = density if "density" not in lines + of_oak else density / metres**3  # the stage's own in its own unit
    wanted = 4.0 / 3.0 * math.pi * usual * metres**3
    reading = truth.Reading(stage)
    assert reading.mass(stage.GetPrimAtPath("/World/Ball")) == pytest.approx(wanted, rel=1e-6)
    scene = import_scene(path)
    assert scene.builder.body_mass[scene.bodies["/World/Ball"]] == pytest.approx(wanted, rel=1e-5)  # single precision


@pytest.mark.parametrize(("batch", "workers"), [pytest.param(1, 1, marks=pytest.mark.long), (1, 3), (5, 2), (50, 4)])
def test_a_campaign_survives_its_workers(batch, workers, tmp_path, monkeypatch):
    def judge_or_die(number, seed, folder, *_):
        (folder / f"{number:05}").mkdir(exist_ok=True)
        if number == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 7:
            time.sleep(60.0)
        if number == 11:
            raise ValueError("odd")
        problems = ["much"] if number == 13 else []
        seconds = campaign.CPU_SECONDS + 1.0 if number == 17 else 1.0
        return Verdict(number, "usda", f"{seed}-{number}", 2, 2, problems=problems, seconds=seconds)

    monkeypatch.setattr(campaign, "judge", judge_or_die)
    monkeypatch.setattr(campaign, "WALL_SECONDS", 1.0)
    verdicts = {verdict.number: verdict for verdict in Campaign(5, tmp_path, [], batch, workers).verdicts(range(20))}
    assert sorted(verdicts) == list(range(20))
    problems = {number: " ".join(verdict.problems) for number, verdict in verdicts.items() if verdict.problems}
    assert problems.keys() == {3, 7, 11, 13, 17}
    assert problems[3] == "died of SIGKILL" and problems[7] == "hung for 1.0 s" and "ValueError" in problems[11]
    assert problems[17] == "took 31 s of CPU time"
    assert {verdict.done for verdict in verdicts.values() if not verdict.problems} == {
        f"5-{n}" for n in {*range(20)} - {3, 7, 11, 13, 17}
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{n:05}" for n in (3, 7, 11, 13, 17)]
