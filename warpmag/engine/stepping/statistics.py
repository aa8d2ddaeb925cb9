"""Statistics of a run, its summary and its warnings."""

import math
from array import array
from dataclasses import dataclass, field, fields

import numpy as np

from warpmag.declarations.checks import check_flag, check_not_negative, check_whole
from warpmag.engine.stepping.stepper import StepReport
from warpmag.errors import InputError

_COARSE = 1e-3
"""Coarseness of positions above which a warning is issued. Contacts settle to about a thousandth of the thickness."""
_UNTIMED = (math.nan,) * 3
"""Placeholder for the times of a step that compiled kernels."""
_DEEP = 0.05
"""Penetration over the thickness above which a warning is issued."""


@dataclass
class Statistics:
    """Statistics of a run.

    Attributes:
        magnets: Movable bodies with magnets.
        steps: Number of steps.
        substeps: Number of substeps, without rejected attempts.
        repeated: Number of rejected attempts at a step.
        capped: Number of steps where a body moved farther than allowed even in the shortest substep.
        regrown: Number of steps that enlarged contact or pair buffers.
        unconverged: Number of induction solves that did not converge. Short substeps share a solve.
        error: Largest magnetization error of any substep.
        field_error: Relative error of the last field by the fast multipole method at 256 random magnets, compared with
            sums over all pairs; 0 without that method.
        peak_speed: Highest speed of a body [m/s].
        overlap: Deepest penetration over the half-thickness of the thinner body; for a ball that is its radius.
        depth: Deepest penetration [m].
        final_overlap: Deepest penetration at the end over the half-thickness of the thinner body.
        rms_speed: Root mean square speed of the magnets at the end [m/s].
        held: Bodies that touch a permanent or fixed magnet at the end, and bodies off the ground that touch it through
            others off the ground.
        held_rms_speed: Root mean square speed of held bodies [m/s].
        held_median_speed: Median speed of held bodies [m/s]; below the RMS if single bodies slide without friction.
        farthest: Largest distance of a magnet from the mean initial position, in any frame [m].
        overlapping: Number of overlapping contacts at the start.
        coarseness: Spacing of single-precision positions at the start over the half-thickness of the thinnest body.
        wall_seconds: Duration of the run [s]; in ``warpmag run`` without the compilation of kernels.
    """

    magnets: int = 0
    steps: int = 0
    substeps: int = 0
    repeated: int = 0
    capped: int = 0
    regrown: int = 0
    unconverged: int = 0
    error: float = 0.0
    field_error: float = 0.0
    peak_speed: float = 0.0
    overlap: float = 0.0
    depth: float = 0.0
    final_overlap: float = 0.0
    rms_speed: float = 0.0
    held: int = 0
    held_rms_speed: float = 0.0
    held_median_speed: float = 0.0
    farthest: float = 0.0
    overlapping: int = 0
    coarseness: float = 0.0
    wall_seconds: float = 0.0
    _evaluations: array = field(default_factory=lambda: array("i"), repr=False)
    _seconds: array = field(default_factory=lambda: array("f"), repr=False)

    def add_step(self, report: StepReport) -> None:
        """Add the report of a step."""
        self.steps += 1
        self.substeps += report.substeps
        self.repeated += report.attempts - 1
        self.capped += report.capped
        self.regrown += report.regrown
        self._evaluations.append(report.evaluations)
        self.unconverged += report.unconverged
        self.error = max(self.error, report.error)
        self.peak_speed = max(self.peak_speed, report.speed)
        self.overlap = max(self.overlap, report.overlap)
        self.depth = max(self.depth, report.depth)
        self._seconds.extend(report.seconds or _UNTIMED)

    @property
    def evaluations(self) -> list[int]:
        """Number of field evaluations of each step."""
        return self._evaluations.tolist()

    @property
    def milliseconds(self) -> tuple[float, float, float]:
        """Mean times per step of induction Ti, forces Tf and rigid bodies Tr [ms], as in Table 1 of the paper."""
        return self.milliseconds_since(0)

    def milliseconds_since(self, step: int) -> tuple[float, float, float]:
        """Return :attr:`milliseconds` of the steps from index ``step`` on."""
        check_whole("step", step)
        check_not_negative("step", step)
        seconds = np.array(self._seconds, dtype=float).reshape(-1, len(_UNTIMED))[step:]
        timed = seconds[np.isfinite(seconds).all(axis=1)]
        return tuple((1e3 * timed.mean(axis=0)).tolist()) if len(timed) else (0.0, 0.0, 0.0)

    def save(self) -> dict[str, np.ndarray]:
        """Return copies of all values by name, since steps continue while the values are written."""
        return {entry.name: np.array(getattr(self, entry.name)) for entry in fields(self)}

    def load(self, saved: dict[str, np.ndarray]) -> None:
        """Set the values that :meth:`save` returned; others raise :class:`InputError`."""
        for name, present in self.save().items():
            current, value = getattr(self, name), saved[name]
            if value.dtype.kind != present.dtype.kind or value.ndim != present.ndim:
                raise InputError(f"checkpoint: {name} does not fit this run")
            entries = value.tolist()
            setattr(self, name, array(current.typecode, entries) if isinstance(current, array) else entries)

    def warnings(self) -> list[str]:
        """Return warnings about the accuracy of the run, one line each."""
        lines = []
        if self.overlapping:
            plural = self.overlapping > 1
            lines.append(f"{self.overlapping} pair{'s' * plural} of bodies overlap{'s' * (not plural)} at the start")
        if self.coarseness > _COARSE:
            spacing = f"{100.0 * self.coarseness:.2g} % of a half-thickness"
            lines.append(f"bodies are far from the origin: positions in single precision are {spacing} apart")
        if self.unconverged:
            solves = f"{self.unconverged} induction solve{'s' * (self.unconverged > 1)}"
            lines.append(f"{solves} did not converge, in {self.substeps} substeps")
        if self.final_overlap > _DEEP:
            lines.append(f"bodies overlap by {100.0 * self.final_overlap:.0f} % of their half-thickness at the end")
        if self.capped:
            lines.append(f"bodies were too fast for the shortest substep in {self.capped} of {self.steps} steps")
        return lines

    def summary(self, details: bool = True) -> list[str]:
        """Return the summary of the run, line by line.

        Args:
            details: Include the times of a step, field evaluations, substeps and buffer growths.
        """
        check_flag("details", details)
        if not self.steps:
            return ["no steps"]
        lines = [
            f"magnets        {self.magnets} moving",
            f"steps          {self.steps}",
            *(self._details() if details else ()),
            f"speed          RMS {100.0 * self.rms_speed:.2f} cm/s at the end, peak {self.peak_speed:.2f} m/s",
            f"penetration    {100.0 * self.overlap:.2f} % of the half-thickness at most ({1e3 * self.depth:.4f} mm), "
            f"{100.0 * self.final_overlap:.2f} % at the end",
            f"farthest       {self.farthest:.3f} m from the mean initial position",
        ]
        if self.held:
            rms, median = 100.0 * self.held_rms_speed, 100.0 * self.held_median_speed
            lines.append(f"held           {self.held} by a magnet, RMS {rms:.2f} cm/s, median {median:.2f} cm/s")
        return lines

    def _details(self) -> list[str]:
        """Return the lines about substeps, times and fields."""
        induction, force, rigid = self.milliseconds
        evaluations = np.array(self.evaluations)
        mean = 1e3 * self.wall_seconds / self.steps
        whole = f"{mean:.2f} ms with output: " if mean else ""  # steps outside of a run are not timed
        by_multipoles = f", of fields by multipoles {self.field_error:.1e} at the end" if self.field_error else ""
        return [
            f"substeps       {self.substeps / self.steps:.2f} each, {self.repeated} steps repeated, "
            f"{self.regrown} buffer growths",
            f"time per step  {whole}induction Ti {induction:.2f} ms, forces Tf {force:.2f} ms, "
            f"bodies Tr {rigid:.2f} ms",
            f"field          {evaluations.mean():.1f} evaluations per step (median {np.median(evaluations):.0f}, "
            f"max {evaluations.max()}), magnetization error at most {self.error:.1e}{by_multipoles}",
        ]
