"""Times, rates and units of a stage."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from pxr import Usd, UsdGeom, UsdPhysics

from warpmag.errors import InputError
from warpmag.usd.read.units import units_of
from warpmag.usd.values import Finding, value_of

_RATES = (1e-3, 1e6)
_LATEST = 1e12
_MOST_FRAMES = 10_000_000


@dataclass(frozen=True)
class StageClock:
    """Time range and rates of a stage."""

    start: float  # first time code
    end: float  # last time code; equal to ``start`` where the stage has no range
    time_codes_per_second: float
    frames_per_second: float  # rate of the output frames [Hz]
    step: float | None  # time step of the physics [s], None where the stage has none


def stage_name(stage: Usd.Stage) -> str:
    """Return the name of a stage in messages."""
    return stage.GetRootLayer().realPath or "stage"


def start_of(stage: Usd.Stage) -> float:
    """Return the first time code of a stage; raises :class:`InputError` unless it is finite."""
    return _time_code(stage, "startTimeCode", stage.GetStartTimeCode())


def stage_clock(stage: Usd.Stage) -> StageClock:
    """Return times and rates of a stage; raises :class:`InputError` where they are invalid."""
    name = stage_name(stage)
    codes = stage.GetTimeCodesPerSecond()
    frames = stage.GetFramesPerSecond() if stage.HasAuthoredMetadata("framesPerSecond") else codes
    for key, rate in (("timeCodesPerSecond", codes), ("framesPerSecond", frames)):
        _check_rate(name, key, rate)
    start, end = start_of(stage), _time_code(stage, "endTimeCode", stage.GetEndTimeCode())
    if end < start and stage.HasAuthoredMetadata("endTimeCode"):
        raise InputError(f"{name}: endTimeCode {end:g} is before startTimeCode {start:g}")
    end = max(start, end)
    if (end - start) / codes * frames > _MOST_FRAMES:
        raise InputError(f"{name}: {(end - start) / codes * frames:g} frames from startTimeCode to endTimeCode")
    return StageClock(start, end, codes, frames, _step(stage))


def check_rates(stage: Usd.Stage) -> None:
    """Raise :class:`InputError` for a layer with an invalid rate: USD would loop forever over its samples.

    USD divides the rates of layers that differ, and NaN differs from itself.
    """
    for layer in stage.GetUsedLayers():
        key = "timeCodesPerSecond" if layer.HasTimeCodesPerSecond() else "framesPerSecond"
        _check_rate(layer.realPath or layer.identifier, key, layer.timeCodesPerSecond)


def scenes(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the physics scenes of a stage; Newton reads the first."""
    return [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene)]


def unit_findings(stage: Usd.Stage) -> Iterator[Finding]:
    """Yield errors in the units of a stage, and a warning where the unit of length is USD's default."""
    units, name = units_of(stage), stage_name(stage)
    for key, unit in (("metersPerUnit", units.meters), ("kilogramsPerUnit", units.kilograms)):
        if not 1e-50 < unit < 1e50:
            yield Finding(name, f"{key} must be positive and finite, got {unit:g}")
    if (up := UsdGeom.GetStageUpAxis(stage)) not in ("Y", "Z"):
        yield Finding(name, f"upAxis must be Y or Z, got {up!r}")
    if not stage.GetRootLayer().pseudoRoot.HasInfo("metersPerUnit"):
        message = f"metersPerUnit is not set, which in USD means {units.meters:g}: lengths are read in that unit"
        yield Finding(name, message, "warning")


def _check_rate(name, key, rate) -> None:
    if not (rate > 0.0 and math.isfinite(rate)):
        raise InputError(f"{name}: {key} must be positive and finite, got {rate}")
    if not _RATES[0] <= rate <= _RATES[1]:
        raise InputError(f"{name}: {key} must be from {_RATES[0]:g} to {_RATES[1]:g}, got {rate}")


def _step(stage) -> float | None:
    first = scenes(stage)[:1]
    steps = first[0].GetAttribute("newton:timeStepsPerSecond") if first else None
    if not (steps and steps.HasAuthoredValue()):
        return None
    rate = value_of(first[0], "newton:timeStepsPerSecond")
    return None if rate is None else 1.0 / rate


def _time_code(stage, key, code) -> float:
    if not abs(code) <= _LATEST:
        raise InputError(f"{stage_name(stage)}: {key} must be finite and at most {_LATEST:g} in size, got {code}")
    return code
