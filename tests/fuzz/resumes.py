"""Interrupted runs whose files are damaged, exchanged or lost before ``warpmag run --resume`` goes on.

A resumed run has to end with one line, or with a stage whose values are those of a run that nobody interrupted. Runs
that were resumed with another step or another stage may differ, but have to be finite.
"""

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pxr import Usd

from .campaign import BAD_INPUT, OK, Verdict, cpu_seconds, messages, talk
from .truth import not_finite

FRAMES, LAST = 4, 2
"""Frames of a run, and the last one before it was interrupted."""
_OUTPUT, _CHECKPOINT = "out.usda", "out.resume.npz"


def author_runs(stages: list[Path], folder: Path) -> list[Path]:
    """Run stages to their end and to an interruption; return folders with ``whole``, ``part`` and the stage."""
    from warpmag.engine.stepping.simulation import Simulation  # noqa: PLC0415 - imports Warp, which reads the environment

    places = []
    for stage in stages:
        place = folder / stage.stem
        if not place.exists():
            place.mkdir(parents=True)
            shutil.copyfile(stage, place / "stage.usda")
            for name, last in (("whole", FRAMES), ("part", LAST)):
                simulation = Simulation(place / "stage.usda", device="cpu")
                output = place / name / _OUTPUT
                simulation.run(FRAMES, output=output, on_frame=lambda frame, last=last: frame < last)
        places.append(place)
    return places


def judge_resume(number: int, seed: int, folder: Path, runs: list[Path], command: Callable) -> Verdict:
    """Spoil an interrupted run, resume it, and look at what came of it."""
    began, chance = cpu_seconds(), random.Random(f"{seed}-{number}")
    verdict, place, run = Verdict(number, "run"), folder / f"{number:05}", runs[number % len(runs)]
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(run, place)
    faults = [chance.choice(FAULTS) for _ in range(chance.choice((1, 1, 2)))]
    done = [fault(place, runs, chance) for fault in faults]
    options = chance.choice(OPTIONS) if chance.random() < 0.2 else ()
    verdict.done = f"{run.name}: {'; '.join(done)} {' '.join(options)}"
    before = _content(place / "part", without=_CHECKPOINT)
    output = place / "part" / _OUTPUT
    arguments = ("run", str(place / "stage.usda"), "--frames", str(FRAMES), "--resume", "-o", str(output))
    verdict.run, _, stderr = command(*arguments, "--device", "cpu", *options)
    refusals = messages(stderr)
    verdict.line = refusals[-1] if refusals else ""
    verdict.problems += talk("run", stderr)
    if verdict.run == OK:
        same_run = not options and _stage_kept(place, run)
        verdict.problems += _problems(output, place / "whole" / _OUTPUT if same_run else None)
    elif verdict.run != BAD_INPUT:
        verdict.problems.append(f"ends with {verdict.run}: {verdict.line}")
    elif len(refusals) != 1:
        verdict.problems.append(f"{len(refusals)} lines")
    elif _stage_kept(place, run) and before == _content(run / "part", without=_CHECKPOINT):
        if (frames := _frames(output)) != LAST + 1:
            verdict.problems.append(f"a refused run left {frames} frames")
    verdict.seconds = cpu_seconds() - began
    return verdict


def _stage_kept(place: Path, run: Path) -> bool:
    """Return True if the stage of a copied run is that of the run."""
    return (place / "stage.usda").read_bytes() == (run / "stage.usda").read_bytes()


def _content(folder: Path, without: str) -> dict[str, bytes]:
    """Return the content of the regular files of a folder but one."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file() and path.name != without}


def _frames(output: Path) -> int:
    """Return the number of frames of a result."""
    return max((len(samples) for samples in _samples(Usd.Stage.Open(str(output))).values()), default=0)


def _problems(output: Path, expected: Path | None) -> list[str]:
    """Return faults of a result: values that are not finite, missing frames, other values than the expected ones."""
    try:
        stage = Usd.Stage.Open(str(output))
    except Exception as error:
        return [f"USD does not open it: {error}"[:200]]
    problems = not_finite(stage)
    if expected is None or problems:
        return problems
    given, wanted = _samples(stage), _samples(Usd.Stage.Open(str(expected)))
    if given.keys() != wanted.keys():
        return [f"{len(given)} attributes for {len(wanted)}"]
    return [f"{name} has other values" for name in wanted if given[name] != wanted[name]][:2]


def _samples(stage: Usd.Stage) -> dict[str, list]:
    """Return the samples of all animated attributes by their paths, as texts that keep each bit."""
    samples = {}
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        for attribute in prim.GetAttributes():
            if times := attribute.GetTimeSamples():
                samples[str(attribute.GetPath())] = [(time, repr(attribute.Get(time))) for time in times]
    return samples


def _files(place: Path) -> list[Path]:
    return sorted(path for path in (place / "part").iterdir() if path.is_file())


def cut(place, runs, chance) -> str:
    """Cut off the end of a file."""
    path = chance.choice(_files(place))
    size = path.stat().st_size
    os.truncate(path, chance.choice((0, 1, size // 2, max(size - 1, 0), chance.randrange(size + 1))))
    return f"{path.name} cut to {path.stat().st_size}"


def garble(place, runs, chance) -> str:
    """Change bytes of a file."""
    path = chance.choice(_files(place))
    data, count = bytearray(path.read_bytes()), chance.choice((1, 3, 100))
    for _ in range(count if data else 0):
        data[chance.randrange(len(data))] = chance.randrange(256)
    path.write_bytes(data)
    return f"{count} bytes of {path.name}"


def append(place, runs, chance) -> str:
    """Append bytes to a file."""
    path = chance.choice(_files(place))
    path.write_bytes(path.read_bytes() + chance.choice((b"\0" * 5000, b"x", path.read_bytes())))
    return f"{path.name} longer"


def lose(place, runs, chance) -> str:
    """Remove a file, or put something else in its place."""
    path, kind = chance.choice(_files(place)), chance.choice(("nothing", "a folder", "a link to nowhere", "a pipe"))
    path.unlink()
    if kind == "a folder":
        path.mkdir()
    elif kind == "a link to nowhere":
        path.symlink_to("nowhere")
    elif kind == "a pipe":
        os.mkfifo(path)
    return f"{kind} for {path.name}"


def exchange(place, runs, chance) -> str:
    """Take a file of another run, or of the one that ended."""
    path, other = chance.choice(_files(place)), chance.choice(runs)
    source = chance.choice(sorted((other / chance.choice(("whole", "part"))).iterdir()))
    shutil.copyfile(source, path)
    return f"{path.name} from {source.relative_to(other.parent)}"


def checkpoint(place, runs, chance) -> str:
    """Change an array of the checkpoint: its size, type, numbers, or its presence."""
    path = place / "part" / _CHECKPOINT
    try:
        arrays = dict(np.load(path))
    except Exception:
        return "nothing"
    name = chance.choice(sorted(arrays))
    array, kind = arrays[name], chance.choice(("gone", "longer", "of text", "not finite", "huge", "of objects", "flat"))
    if kind == "gone":
        del arrays[name]
    elif kind == "longer":
        arrays[name] = np.concatenate([np.ravel(array)] * 2)
    elif kind == "of text":
        arrays[name] = array.astype("U9")
    elif kind == "of objects":
        arrays[name] = np.array([path], object)
    elif kind == "flat":
        arrays[name] = np.ravel(array)[:1]
    elif array.dtype.kind == "f":
        arrays[name] = np.full_like(array, np.nan if kind == "not finite" else 1e30)
    elif array.dtype.kind in "iu":
        arrays[name] = np.full_like(array, np.iinfo(array.dtype).max)
    np.savez(path, **arrays)
    return f"{name} of the checkpoint {kind}"


def stage(place, runs, chance) -> str:
    """Take the stage of another run, or change a number in it."""
    path = place / "stage.usda"
    if chance.random() < 0.5:
        shutil.copyfile(chance.choice(runs) / "stage.usda", path)
        return "a stage of any run"
    lines = path.read_text(encoding="utf-8").splitlines()
    chosen = [number for number, line in enumerate(lines) if " = " in line and line.strip()[-1:].isdigit()]
    number = chance.choice(chosen)
    lines[number] = f"{lines[number].partition(' = ')[0]} = {chance.choice((0, 1, 2, 0.01))}"
    path.write_text("\n".join(lines), encoding="utf-8")
    return f"{lines[number].strip()}"


OPTIONS = (("--step", "5e-4"), ("--solver", "steel"), ("--rtol", "1e-3"), ("--force", "zeeman"))
"""Options of the resumed run alone."""
FAULTS: tuple[Callable, ...] = (cut, garble, garble, append, lose, exchange, exchange, checkpoint, checkpoint, stage)
