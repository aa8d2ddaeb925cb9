"""Checks a stage for ``warpmag check``: its contents, its errors, and the findings of USD's own validators."""

import os
from dataclasses import dataclass, replace

from pxr import Tf, Usd, UsdGeom, UsdValidation

from warpmag.declarations.checks import check_token
from warpmag.declarations.magnets import KINDS
from warpmag.errors import InputError, warn_caller
from warpmag.usd.read.ball_instancers import BallInstancer, ball_instancers
from warpmag.usd.read.clock import StageClock, stage_clock, stage_name
from warpmag.usd.read.input_errors import usd_errors
from warpmag.usd.read.instancers import complete_instances
from warpmag.usd.read.joints import joint_findings
from warpmag.usd.read.opening import open_deferred
from warpmag.usd.read.session import file_of
from warpmag.usd.read.survey import StageContents, survey
from warpmag.usd.read.units import units_of
from warpmag.usd.values import Finding, quiet

_SEVERITIES = {"Error": "error", "Warn": "warning"}


@dataclass(frozen=True)
class StageReport:
    """Contents of a stage, with its errors and warnings.

    Attributes:
        path: File of the stage.
        meters_per_unit: Unit of length [m].
        kilograms_per_unit: Unit of mass [kg].
        up_axis: ``Y`` or ``Z``.
        clock: Times and rates of the stage, None where they are invalid.
        contents: Bodies, colliders, magnets and settings.
        findings: All errors and warnings, errors first. Errors of ``UsdValidation`` are warnings here, because a stage
            that breaks a rule of USD still runs.
        broken_rules: Errors of ``UsdValidation``.
    """

    path: str
    meters_per_unit: float
    kilograms_per_unit: float
    up_axis: str
    clock: StageClock | None
    contents: StageContents
    findings: tuple[Finding, ...]
    broken_rules: tuple[Finding, ...]

    def __getattr__(self, name: str):
        """Return the unit of length under its earlier name."""
        if name == "metres_per_unit":
            message = "StageReport.metres_per_unit is deprecated, use meters_per_unit"
            warn_caller(message, DeprecationWarning)
            return self.meters_per_unit
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that prevent a run."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that do not prevent a run, including broken rules of USD."""
        return tuple(finding for finding in self.findings if finding.severity != "error")

    def magnets(self, kind: str) -> list[str]:
        """Return the paths of the magnets of one kind, ``inducible`` or ``permanent``."""
        check_token("kind", kind, KINDS)
        return [path for path, magnet in self.contents.magnets.items() if magnet.kind == kind]


def check(path: str | os.PathLike) -> StageReport:
    """Return the contents of a stage, with the errors and warnings found by reading it.

    The command ``warpmag check`` also builds the model, and reports the errors found there.

    Raises:
        InputError: The file cannot be opened as a stage.

    Example:
        >>> import warpmag
        >>> report = warpmag.check("lift.usda")  # a stage with a ball below a magnet
        >>> report.errors
        ()
    """
    stage, deferred = open_deferred(path)
    with usd_errors(str(path)):
        complete_instances([balls for balls in deferred if not balls.stays_instancer])
        report = inspect(stage, path)
        for instancer in ball_instancers(stage, deferred):
            _add_balls(report.contents, instancer)
    return report


def inspect(stage: Usd.Stage, path: str | os.PathLike) -> StageReport:
    """Return the report of :func:`check` on a stage that :func:`open_stage` opened from the file ``path``."""
    with usd_errors(str(path)):
        contents = survey(stage)
        findings = [*contents.findings, *joint_findings(stage, contents.motions)]
        try:
            clock = stage_clock(stage)
        except InputError as error:
            clock = None
            where, _, message = str(error).rpartition(": ")
            findings.append(Finding(where, message))
        rules, units = validate(file_of(stage)), units_of(stage)
        findings += [replace(rule, severity="warning") for rule in rules]
        return StageReport(
            path=str(path),
            meters_per_unit=units.meters,
            kilograms_per_unit=units.kilograms,
            up_axis=UsdGeom.GetStageUpAxis(stage),
            clock=clock,
            contents=contents,
            findings=tuple(sorted(dict.fromkeys(findings), key=lambda finding: finding.severity != "error")),
            broken_rules=tuple(rule for rule in rules if rule.severity == "error"),
        )


def _add_balls(contents: StageContents, instancer: BallInstancer) -> None:
    """Add the balls of an instancer to ``contents``, each after the identical ball that has prims."""
    for paths in (contents.bodies, contents.colliders):
        for prim, copies in instancer.copies_of(paths).items():
            position = paths.index(prim) + 1
            paths[position:position] = copies
    for prim, copies in instancer.copies_of(list(contents.magnets)).items():
        contents.magnets |= dict.fromkeys(copies, contents.magnets[prim])


@quiet()
def validate(stage: Usd.Stage) -> list[Finding]:
    """Return the errors and warnings of USD's own validators, except validators of usdz packages."""
    registry = UsdValidation.ValidationRegistry()
    packages = {validator.name for validator in registry.GetValidatorMetadataForKeyword("UsdzValidators")}
    validators = [validator for validator in registry.GetAllValidatorMetadata() if not validator.isSuite]
    names = [validator.name for validator in validators if validator.name not in packages]
    try:
        errors = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names)).Validate(stage)
    except Tf.ErrorException as error:  # a transform that cannot be composed stops all validators
        reason = error.args[0].commentary if error.args else type(error).__name__
        return [Finding(stage_name(stage), f"USD's validators cannot read it ({' '.join(str(reason).split())})")]
    findings = []
    for error in errors:
        severity = _SEVERITIES.get(error.GetType().name)
        # RigidBodyOrientationScale also fires for rotated bodies with non-uniform scale, as its decomposition is not
        # unique; survey() reports sheared bodies.
        if severity and error.GetName() != "RigidBodyOrientationScale":
            message = f"{' '.join(error.GetMessage().split())} [{error.GetIdentifier()}]"
            findings.append(Finding(_site(error, stage), message, severity))
    return sorted(findings, key=lambda finding: (finding.where, finding.message))  # threads return them in any order


def _site(error, stage) -> str:
    """Return the path of the property or prim of a validation error, else the name of the stage."""
    for site in error.GetSites():
        if site.IsProperty():
            return str(site.GetProperty().GetPath())
        if site.IsPrim() and not site.GetPrim().IsPseudoRoot():
            return str(site.GetPrim().GetPath())
    return stage_name(stage)
