"""Compares warpmag's forces between iron bodies and magnets with converged ones: ``python -m bench.iron [NAME ...]``.

Setups and references are those of ``bench.reference.iron_bodies``. Arguments are beginnings of names of setups. Each
setup and number of moments is one JSON line. Its errors are relative to the largest force, and to each body's moment.
"""

import argparse
import math
import time

import newton
import numpy as np
import warp as wp

import warpmag
from bench.machine import line_writer
from bench.prisms import prism
from bench.reference.iron_bodies import SETUPS, Body, Setup, load
from warpmag.declarations.magnets import CONTACT_MODELS

_UNSATURATED = 1e9  # saturation magnetization of iron with a linear curve [A/m]
_SETTLED = 1e-5  # tolerance of the solve, far below the errors of interest


def main() -> None:
    """Compare the setups named on the command line, or all."""
    parser = argparse.ArgumentParser(prog="python -m bench.iron", description=__doc__.partition(":")[0])
    parser.add_argument("names", nargs="*", default=[""], help="beginnings of names of setups; all without")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cells", type=int, nargs="+", default=(0, 2000), help="moments of each body; 0: automatic")
    parser.add_argument("--contact-model", default="dipole", choices=CONTACT_MODELS)
    options = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    write, table = line_writer(options.device), load()
    for name, cells in ((name, cells) for name in table for cells in options.cells):
        if name.startswith(tuple(options.names)):
            values = errors(SETUPS[name], table[name], cells, options.device, options.contact_model)
            write({"setup": name, "cells": cells, "contact_model": options.contact_model, **values})


def errors(setup: Setup, reference: dict, cells: int = 0, device="cpu", contact_model: str = "dipole") -> dict:
    """Relative errors of warpmag's forces and moments of a setup, with about ``cells`` moments in each body.

    ``force_ratios`` and ``moment_ratios`` are values over those of the reference along them, one for each body.
    """
    began = time.perf_counter()
    forces, moments, magnetics = model_forces(setup, cells, device, contact_model)
    system, seconds = magnetics.system, time.perf_counter() - began
    expected_forces, expected_moments = np.array(reference["forces"]), np.array(reference["moments"])
    line = {"moment_error": float((_lengths(moments - expected_moments) / _lengths(expected_moments)).max())}
    line["moment_ratios"] = _ratios(moments, expected_moments)
    if len(setup.bodies) > 1:
        largest = _lengths(expected_forces).max()
        line["force_error"] = float(_lengths(forces - expected_forces).max() / largest)
        line["force_ratios"] = _ratios(forces, expected_forces)
        line["force_sum"] = float(np.linalg.norm(forces.sum(axis=0)) / largest)
    return line | {
        "moments": system.count,
        "evaluations": int(system.evaluations.numpy()[0]),
        "converged": bool(system.converged.numpy()[0]),
        "seconds": seconds,
    }


def model_forces(
    setup: Setup, cells: int, device, contact_model: str
) -> tuple[np.ndarray, np.ndarray, warpmag.Magnetics]:
    """Forces [N] and moments [A·m²] of the bodies, shape [n, 3], in a Newton model; and its magnets."""
    model = model_of(setup, cells, device, single_balls=contact_model == "multipole")
    settings = {"external_field": setup.field, "rtol": _SETTLED, "contact_model": contact_model}
    magnetics, state = warpmag.Magnetics(model, **settings), model.state()
    state.clear_forces()
    magnetics.apply(state)
    moments = np.zeros((len(setup.bodies), 3))
    moments[magnetics.shapes] = magnetics.shape_moments()
    return state.body_f.numpy()[:, :3].astype(float), moments, magnetics


def model_of(setup: Setup, cells: int, device, *, single_balls: bool = False) -> newton.Model:
    """Model of a setup with about ``cells`` moments in each body; 0 means automatic numbers, as of ``single_balls``."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    for body in setup.bodies:
        _add(builder, body, 0 if single_balls and body.shape == "ball" else cells)
    return builder.finalize(device=device)


def _add(builder: newton.ModelBuilder, body: Body, cells: int) -> None:
    """Add a body with its shape and its magnet."""
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), body.turn)
    link = builder.add_body(xform=wp.transform(body.center, turn))
    if body.shape == "box":
        builder.add_shape_box(link, hx=body.size[0], hy=body.size[1], hz=body.size[2])
    elif body.shape == "cylinder":
        builder.add_shape_cylinder(link, radius=body.size[0], half_height=body.size[1])
    elif body.shape == "prism":
        builder.add_shape_mesh(link, mesh=prism(body.outline, body.size[0]))
    else:
        builder.add_shape_sphere(link, radius=body.size[0])
    spacing = math.cbrt(body.volume / cells) if cells else 0.0
    if body.magnetization:
        permeability = 1.0 + body.susceptibility
        recoil = {"recoil_permeability": permeability, "moment_spacing": spacing} if body.susceptibility else {}
        warpmag.add_permanent(builder, body=link, magnetization=body.magnetization, **recoil)
    elif body.material:
        warpmag.add_inducible(builder, body=link, material=body.material, moment_spacing=spacing)
    else:
        linear = {"saturation": _UNSATURATED, "susceptibility": body.susceptibility}
        warpmag.add_inducible(builder, body=link, moment_spacing=spacing, **linear)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=1)


def _ratios(values: np.ndarray, expected: np.ndarray) -> list[float | None]:
    """Components of values along the expected ones over their lengths; None for the smallest, by symmetry 0."""
    squares = (expected**2).sum(axis=1)
    significant = squares > 1e-6 * squares.max()
    products = (values * expected).sum(axis=1) / np.where(significant, squares, 1.0)
    return [round(float(p), 5) if s else None for p, s in zip(products, significant, strict=True)]


if __name__ == "__main__":
    main()
