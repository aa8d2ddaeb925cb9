"""Settings of a system of moments."""

from dataclasses import dataclass

from warpmag.declarations.checks import check_count, check_token
from warpmag.declarations.magnets import CONTACT_MODELS, DYNAMICS, check_force, check_rtol


@dataclass(frozen=True)
class SolverSettings:
    """Settings of the induction solve and of the forces, most of them as in :func:`warpmag.solve_induction`.

    With ``single_torque`` the torque m × H is computed also for an inducible ball of a single moment. It is 0 in
    equilibrium, where m is parallel to H, and measures the distance of the solve from equilibrium.
    """

    force: str = "kelvin"  # or ``zeeman``
    dynamics: str = "theta"
    contact_model: str = "dipole"
    method: str = "direct"
    rtol: float = 1e-3  # relative error of the inducible moments' magnetization at which a solve ends
    max_evaluations: int = 1000  # field evaluations after which a solve ends with ``converged`` 0
    step: float | None = None  # step κ = βΔtMs [dimensionless] of an explicit dynamics; None means its default
    damping: float | None = None  # damping α [dimensionless] of ``llg``; None means its default
    single_torque: bool = False

    def check(self, dtype: str) -> None:
        """Raise ``InputError`` for a setting out of range of ``dtype``, ``float32`` or ``float64``."""
        check_token("contact_model", self.contact_model, CONTACT_MODELS)
        check_token("dynamics", self.dynamics, DYNAMICS)
        check_force("force", self.force, self.contact_model)
        check_rtol("rtol", self.rtol, dtype)
        check_count("max_evaluations", self.max_evaluations)
