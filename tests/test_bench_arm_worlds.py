"""Magnetic steps of an arm beside MuJoCo's: lines of all parts, and their picture."""

import json

import pytest

from bench import arm_worlds


def test_all_parts(tmp_path, device, monkeypatch, capsys):
    monkeypatch.setattr(arm_worlds, "GAPS", (0.1, 0.002))
    monkeypatch.setattr(arm_worlds, "SPACING_GAPS", (0.1,))
    monkeypatch.setattr(arm_worlds, "SPACINGS", (0.012, 0.0))
    measure = arm_worlds.measure
    monkeypatch.setattr(arm_worlds, "measure", lambda *work, **options: measure(*work, **options | {"seconds": 0.01}))
    options = ["--device", device, "--worlds", "1", "--steps", "2", "--refined", "0.003"]
    arm_worlds.main([*options, "-o", str(tmp_path / "lines")])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    gaps, spacings, phases = ([line for line in lines if line["part"] == part] for part in arm_worlds.PARTS)
    expected = [(*case, gap) for case in arm_worlds.CASES for gap in (0.1, 0.002)]
    assert [(line["object"], line["contact_model"], line["gap"]) for line in gaps] == expected
    for line in gaps:
        assert line["magnetics_ms"] > 0.0
        assert line["mujoco_ms"] > 0.0
        assert line["force"] > 0.0
    # few moments of the plate are good to 1 % (docs/physics/distant_bodies.md), and so is the reference far away
    assert gaps[0]["error"] < 0.02
    assert [line["cells"] for line in spacings] == [25, 722]
    assert spacings[1]["error"] == pytest.approx(gaps[0]["error"], abs=1e-4)
    assert [line["phase"] for line in phases] == list(arm_worlds.PHASES)
    arm_worlds.main(["--draw", str(tmp_path / "lines"), "-o", str(tmp_path / "lines.png")])
    assert (tmp_path / "lines.png").stat().st_size > 10_000
