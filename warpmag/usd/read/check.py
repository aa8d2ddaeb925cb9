"""What a stage holds and what is wrong with it, for ``warpmag check``."""

import os
from dataclasses import dataclass, replace

from pxr import Tf, Usd, UsdGeom, UsdValidation

from warpmag.errors import InputError
from warpmag.usd.read.clock import StageClock, stage_clock, stage_name
from warpmag.usd.read.guard import readable
from warpmag.usd.read.instancers import complete_instances
from warpmag.usd.read.joints import joint_findings
from warpmag.usd.read.reader import StageContents, open_apart, survey
from warpmag.usd.read.session import file_of
from warpmag.usd.read.swarms import Swarm, swarms_of
from warpmag.usd.read.units import units_of
from warpmag.usd.values import Finding, quiet

_SEVERITIES = {"Error": "error", "Warn": "warning"}


@dataclass(frozen=True)
class StageReport:
    """What a stage holds and what is wrong with it.

    Attributes:
        path: File of the stage.
        metres_per_unit: Unit of length [m].
        kilograms_per_unit: Unit of mass [kg].
        up_axis: ``Y`` or ``Z``.
        clock: How time runs, None where that is wrong.
        contents: Bodies, colliders, magnets and settings.
        findings: All that is wrong, the findings of ``UsdValidation`` included; errors before warnings.
        broken_rules: What ``UsdValidation`` calls an error. A stage that breaks a rule of USD runs: it is a warning.
    """

    path: str
    metres_per_unit: float
    kilograms_per_unit: float
    up_axis: str
    clock: StageClock | None
    contents: StageContents
    findings: tuple[Finding, ...]
    broken_rules: tuple[Finding, ...]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings for which a run refuses the stage."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """The findings with which a stage still runs, broken rules of USD among them."""
        return tuple(finding for finding in self.findings if finding.severity != "error")

    def magnets(self, kind: str) -> list[str]:
        """Paths of the magnets of one kind, ``inducible`` or ``permanent``."""
        return [path for path, magnet in self.contents.magnets.items() if magnet.kind == kind]


def check(path: str | os.PathLike) -> StageReport:
    """Find out what a stage holds and everything that is wrong with it.

    Raises:
        InputError: The file cannot be opened as a stage at all.
    """
    stage, apart = open_apart(path)
    with readable(str(path)):
        complete_instances([one for one in apart if not one.whole])
        report = inspect(stage, path)
        for swarm in swarms_of(stage, apart):
            _name_balls(report.contents, swarm)
    return report


def inspect(stage: Usd.Stage, path: str | os.PathLike) -> StageReport:
    """Do what :func:`check` does with an open stage.

    Args:
        stage: As :func:`open_stage` opened it.
        path: File of the stage.
    """
    with readable(str(path)):
        return _report(stage, path)


def _name_balls(contents: StageContents, swarm: Swarm) -> None:
    """Let the balls of an instancer be among what a stage holds, behind the one that has prims."""
    for names in (contents.bodies, contents.colliders):
        for prim, others in swarm.like(names).items():
            after = names.index(prim) + 1
            names[after:after] = others
    for prim, others in swarm.like(list(contents.magnets)).items():
        contents.magnets |= dict.fromkeys(others, contents.magnets[prim])


def _report(stage: Usd.Stage, path: str | os.PathLike) -> StageReport:
    contents = survey(stage)
    findings = [*contents.findings, *joint_findings(stage, contents.motions)]
    try:
        clock = stage_clock(stage)
    except InputError as error:
        clock = None
        where, _, message = str(error).rpartition(": ")
        findings.append(Finding(where, message))
    rules, units = validate(file_of(stage)), units_of(stage)
    findings += [replace(one, severity="warning") for one in rules]
    return StageReport(
        path=str(path),
        metres_per_unit=units.metres,
        kilograms_per_unit=units.kilograms,
        up_axis=UsdGeom.GetStageUpAxis(stage),
        clock=clock,
        contents=contents,
        findings=tuple(sorted(dict.fromkeys(findings), key=lambda finding: finding.severity != "error")),
        broken_rules=tuple(one for one in rules if one.severity == "error"),
    )


@quiet()
def validate(stage: Usd.Stage) -> list[Finding]:
    """Return the errors and warnings of USD's own validators, those for usdz packages left out."""
    registry = UsdValidation.ValidationRegistry()
    packages = {one.name for one in registry.GetValidatorMetadataForKeyword("UsdzValidators")}
    names = [one.name for one in registry.GetAllValidatorMetadata() if not one.isSuite and one.name not in packages]
    try:
        errors = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(names)).Validate(stage)
    except Tf.ErrorException as error:  # transforms that cannot be composed stop them all
        reason = error.args[0].commentary if error.args else type(error).__name__
        return [Finding(stage_name(stage), f"USD's validators cannot read it ({' '.join(str(reason).split())})")]
    findings = []
    for error in errors:
        severity = _SEVERITIES.get(error.GetType().name)
        # This rule also fires for a turned body whose scales differ, by a decomposition that is not unique; survey()
        # finds the sheared ones.
        if severity and error.GetName() != "RigidBodyOrientationScale":
            message = f"{' '.join(error.GetMessage().split())} [{error.GetIdentifier()}]"
            findings.append(Finding(_place(error, stage), message, severity))
    return sorted(findings, key=lambda one: (one.where, one.message))  # its threads have found them in any order


def _place(error, stage) -> str:
    for site in error.GetSites():
        if site.IsProperty():
            return str(site.GetProperty().GetPath())
        if site.IsPrim() and not site.GetPrim().IsPseudoRoot():
            return str(site.GetPrim().GetPath())
    return stage_name(stage)
