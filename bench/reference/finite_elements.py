"""Finite elements for the setups of ``iron_bodies``: ``python -m bench.reference.finite_elements``.

Needs NGSolve: ``pip install ngsolve``. Results are added to ``iron_bodies.json``; arguments name the setups to solve.

The scalar potential ψ has H = −∇ψ, with the applied field included, and ψ = −H0·x far away. It minimizes the coenergy:
∫ B(H)·∇v = 0 for all v, B = μ0 ((1 + χ(|H|)) H + M). A measured curve is solved by secants and then by Newton's method.
The force on a body is −∫ T ∇g over the air, T Maxwell's stress. g is harmonic, 1 on the body and 0 on all others. This
equals the integral of T over a surface around the body, averaged over such surfaces.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import argparse
import json
import math
import time

import ngsolve as ng
import numpy as np
from scipy.interpolate import make_interp_spline

from bench.reference.finite_element_meshes import Resolution, axial_domain, solid_domain
from bench.reference.iron_bodies import FILE, SETUPS, Body, Setup, load
from bench.reference.oracle import MU0
from warpmag.declarations.materials import MATERIALS

RESOLUTIONS = {
    True: (Resolution(4, 3, 1.3), Resolution(5, 4, 1.0)),
    False: (Resolution(3, 1, 1.8), Resolution(3, 3, 1.4)),
}
"""Coarse and fine elements of axial setups (True) and of others; the change between them is in the table."""
_SECANTS, _NEWTON_STEPS = 6, 25
_LEAST_STEP = 1e-15  # energy of the last step of Newton's method over that of the field


class Solution:
    """Potential of one setup on one mesh, and forces and moments of its bodies."""

    def __init__(self, setup: Setup, resolution: Resolution):
        """Make the mesh and solve."""
        self.bodies = setup.bodies
        self.domain = (axial_domain if setup.is_axial else solid_domain)(setup, resolution)
        self.mesh, self.weight = self.domain.mesh, self.domain.weight
        self.space = ng.H1(self.mesh, order=resolution.order, dirichlet="far")
        self.potential = ng.GridFunction(self.space)
        place = ng.CF((ng.x, ng.y, ng.z)[: len(self.domain.axes)])
        self.potential.Set(-self._vector(setup.field) * place, definedon=self.mesh.Boundaries("far"))
        self._magnetized = ng.LinearForm(self.space)
        for k, body in enumerate(self.bodies):
            if body.magnetization:
                magnetization = self._vector(body.magnetization)
                slope = ng.grad(self.space.TestFunction())
                self._magnetized += self._integral(magnetization * slope, f"body{k}")
        self._magnetized.Assemble()
        self._flux = self._flux_form()
        is_curved = any(body.material for body in self.bodies)
        for _ in range(_SECANTS if is_curved else 1):
            self._step_by_secants()
        if is_curved:
            self._iterate_newton()

    def moments(self) -> np.ndarray:
        """Moments of the bodies [A·m²], shape [n, 3]."""
        moments, h = np.zeros((len(self.bodies), 3)), -ng.grad(self.potential)
        for k, body in enumerate(self.bodies):
            m = self._susceptibility(body, h) * h + self._vector(body.magnetization or (0.0, 0.0, 0.0))
            for column, axis in enumerate(self.domain.axes):
                if axis not in self.domain.mirrors:
                    moments[k, axis] = 1e-9 * ng.Integrate(self._integral(m[column], f"body{k}"), self.mesh)
        return moments

    def forces(self) -> np.ndarray:
        """Forces on the bodies [N], shape [n, 3]."""
        surfaces = "|".join(f"surface{k}" for k in range(len(self.bodies)))
        space = ng.H1(self.mesh, order=self.space.globalorder, dirichlet=f"far|{surfaces}", definedon="air")
        u, v = space.TnT()
        form = ng.BilinearForm(ng.grad(u) * ng.grad(v) * self.weight * ng.dx("air"), symmetric=True)
        inverse = _Inverse(form)
        forces, h = np.zeros((len(self.bodies), 3)), -ng.grad(self.potential)
        for k in range(len(self.bodies)):
            share = ng.GridFunction(space)
            share.Set(1.0, definedon=self.mesh.Boundaries(f"surface{k}"))
            share.vec.data -= inverse.applied(form.mat * share.vec)
            slope = ng.grad(share)
            stress = MU0 * (h * (h * slope) - 0.5 * (h * h) * slope)
            for column, axis in enumerate(self.domain.axes):
                if axis not in self.domain.mirrors:
                    forces[k, axis] = -1e-6 * ng.Integrate(self._integral(stress[column], "air"), self.mesh)
        return forces

    def _vector(self, vector):
        """Components of a vector in the coordinates of the mesh."""
        return ng.CF(tuple(vector[axis] for axis in self.domain.axes))

    def _integral(self, integrand, region: str):
        """Integral over the volume of a region, or its term of a form [mm³]."""
        return integrand * self.weight * ng.dx(region, bonus_intorder=2)

    def _susceptibility(self, body: Body, gradient):
        """Susceptibility M/H of a body where the potential has a gradient."""
        if not body.material:
            return ng.CF(body.susceptibility)
        logarithm = np.linspace(np.log(0.5), np.log(5e6), 1500)  # of H [A/m]
        h = np.exp(logarithm)
        spline = make_interp_spline(logarithm, MATERIALS[body.material].curve.magnetization(h) / h, 3)
        return ng.BSpline(4, list(spline.t), list(spline.c))(0.5 * ng.log(gradient * gradient + 1.0))

    def _flux_form(self, gradient=None):
        """Form of B/μ0 without magnets, with susceptibilities at a given gradient, or at that of the argument."""
        u, v = self.space.TnT()
        form = ng.BilinearForm(self.space)
        form += ng.grad(u) * ng.grad(v) * self.weight * ng.dx
        for k, body in enumerate(self.bodies):
            if body.material or body.susceptibility:
                susceptibility = self._susceptibility(body, ng.grad(u) if gradient is None else gradient)
                form += self._integral(susceptibility * (ng.grad(u) * ng.grad(v)), f"body{k}")
        return form

    def _residual(self):
        """Integrals of B·∇v/μ0 of the free degrees of freedom."""
        residual = self.potential.vec.CreateVector()
        self._flux.Apply(self.potential.vec, residual)
        residual.data -= self._magnetized.vec
        ng.Projector(self.space.FreeDofs(), True).Project(residual)
        return residual

    def _step_by_secants(self) -> None:
        """Solve with the susceptibilities of the present potential."""
        frozen = ng.GridFunction(self.space)
        frozen.vec.data = self.potential.vec
        inverse = _Inverse(self._flux_form(ng.grad(frozen)))
        self.potential.vec.data -= inverse.applied(self._residual())

    def _iterate_newton(self) -> None:
        """Solve by Newton's method, whose steps are halved until the energy of the step falls."""
        slope = ng.grad(self.potential)
        least = _LEAST_STEP * ng.Integrate(slope * slope * self.weight, self.mesh)
        for _ in range(_NEWTON_STEPS):
            residual, begin = self._residual(), self.potential.vec.CreateVector()
            begin.data = self.potential.vec
            self._flux.AssembleLinearization(begin)
            step, length = begin.CreateVector(), 1.0
            step.data = self._flux.mat.Inverse(self.space.FreeDofs(), inverse="sparsecholesky") * residual
            energy = ng.InnerProduct(step, residual)
            self.potential.vec.data = begin - step
            if energy < least:
                return
            while abs(ng.InnerProduct(step, self._residual())) > 0.9 * energy and length > 1e-3:
                length *= 0.5
                self.potential.vec.data = begin - length * step
        raise RuntimeError("Newton's method does not converge")


class _Inverse:
    """Inverse of a symmetric form without fixed degrees of freedom: direct in a plane, iterative in space."""

    def __init__(self, form):
        self._form, self._is_flat = form, form.space.mesh.dim == 2
        preconditioner = None if self._is_flat else ng.Preconditioner(form, "bddc")
        form.Assemble()
        free = form.space.FreeDofs()
        if self._is_flat:
            self._inverse = form.mat.Inverse(free, inverse="sparsecholesky")
        else:
            self._inverse = ng.CGSolver(form.mat, preconditioner.mat, tol=1e-9, maxiter=2000)

    def applied(self, vector):
        """Product with a vector."""
        product = vector.CreateVector() if hasattr(vector, "CreateVector") else self._form.mat.CreateColVector()
        product.data = self._inverse * vector
        return product


def solve(name: str) -> dict:
    """Row of the table for a setup."""
    setup, results = SETUPS[name], []
    for resolution in RESOLUTIONS[setup.is_axial]:
        solution = Solution(setup, resolution)
        results.append((solution.forces(), solution.moments()))
    (forces, moments), (fine_forces, fine_moments) = results
    row = {
        "forces": _rounded(fine_forces), "moments": _rounded(fine_moments),
        "moment_change": _short(np.abs(fine_moments - moments).max() / np.abs(fine_moments).max()),
        "order": solution.space.globalorder, "elements": solution.mesh.ne, "unknowns": solution.space.ndof,
    }  # fmt: skip
    if len(setup.bodies) > 1:
        largest = np.abs(fine_forces).max()
        row["force_change"] = _short(np.abs(fine_forces - forces).max() / largest)
        row["force_sum"] = _short(np.abs(fine_forces.sum(axis=0)).max() / largest)
    return row


def _short(number: float) -> float:
    return float(f"{number:.1e}")


def _rounded(vectors: np.ndarray) -> list[list[float]]:
    """Vectors rounded to eight digits of the largest component."""
    digits = 8 - math.ceil(math.log10(max(np.abs(vectors).max(), 1e-12)))
    return (np.round(vectors, digits) + 0.0).tolist()


def main() -> None:
    """Solve the setups named on the command line, or all, and write the table."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.reference.finite_elements", description=__doc__.partition(":")[0]
    )
    parser.add_argument("names", nargs="*", help="beginnings of names of setups; all without")
    names = parser.parse_args().names or [""]
    for name in SETUPS:
        if name.startswith(tuple(names)):
            began, row = time.monotonic(), solve(name)
            rows = load() | {name: row}
            ordered = [
                f"{json.dumps(key, ensure_ascii=False)}: {json.dumps(rows[key])}" for key in SETUPS if key in rows
            ]
            FILE.write_text("{\n" + ",\n".join(ordered) + "\n}\n", encoding="utf-8")
            print(name, row, f"{time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
