"""Worlds of the calls: right arguments by name, which are made anew after a call that changed them."""

import os
from typing import Any

import newton
import numpy as np
import warp as wp

import warpmag
from warpmag.declarations.keys import Keys
from warpmag.moments.probe import FieldProbe

from .stages import new_arguments

M = (0.0, 0.0, 1e6)
POINTS = np.array([(0.0, 0.0, 0.05), (0.02, 0.0, 0.0)])
KEYS = Keys(np.array([0.0, 1.0]), np.array([[1.0], [2.0]]), "linear").to_text()
TIME_STEP = 1e-3  # s
OFTEN = 50
"""Calls without arguments after which a world is made anew; calls with arguments make it anew if they were taken."""
KINDS = "coils", "worlds", "gradients", "distant"
"""Kinds of worlds, each for ``OFTEN`` calls in turn: one with coils, two of it in a model, one whose model requires
gradients, which voltages of coils have not, and one with a plate that acts by few moments, which coils do not allow."""


CONSTANTS: dict[str, Any] = {
    "positions": POINTS,
    "points": POINTS,
    "worlds": np.zeros(len(POINTS), np.int32),
    "gradients": True,
    "body": 0,
    "sites": "site",
    "ampere_turns": 2.0,
    "voltage": 2.0,
    "external_field": (0.0, 0.0, 1e4),
    "count": 2,
    "dt": TIME_STEP,
    "time": 0.0,
    "frames": 1,
    "magnetization": M,
    "magnetizations": {1: M},
    "material": "iron",
    "name": "iron",
    "saturation": 1.3e6,
    "fields": [0.0, 1e3, 1e5],
    "flux_densities": [0.0, 1.0, 1.5],
    "radius": 0.005,
    "radii": 0.005,
    "moments": np.ones((2, 3)),
    "origin": (0.0, 0.0, 0.0),
    "spacing": 0.01,
    "values": np.ones((3, 3, 3, 3)),
    "path": os.devnull,
    "output": None,
    "device": "cpu",
    "dtype": "float32",
}
"""Right arguments that are the same in every world."""


def new_world(balls: int = 2, kind: str = "coils") -> dict[str, Any]:
    """Return right arguments by name: a model of balls, iron, coils and a site, with all that takes its states."""
    builder, source = _new_parts(balls, kind)
    scene = builder
    if kind == "worlds":
        scene = newton.ModelBuilder()
        warpmag.register_attributes(scene)
        scene.replicate(builder, 2)
    model = scene.finalize(device="cpu", requires_grad=kind == "gradients")
    if kind != "distant":
        model.warpmag.current_keys[source] = KEYS  # as USD's importer leaves them
    magnetics, state = warpmag.Magnetics(model), model.state()
    magnetics.apply(state, dt=TIME_STEP)
    made = {
        "builder": builder,
        "scene": builder,
        "model": model,
        "state": state,
        "control": model.control(),
        "magnetics": magnetics,
        "system": magnetics.system,
        "viewer": newton.viewer.ViewerNull(),
        "coil": source,
        "kind": kind,
        "sensor": warpmag.SensorMagnetometer(model, magnetics, "site"),
        "probe": FieldProbe(magnetics.system, 2),
    }
    return CONSTANTS | new_arguments() | made


def _new_parts(balls: int, kind: str) -> tuple[newton.ModelBuilder, int]:
    """Return the builder of one world, and its first coil, or its plate in a distant world."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for number in range(balls):
        body = builder.add_body(xform=wp.transform((0.0, 0.0, 0.015 * number), wp.quat_identity()))
        builder.add_shape_sphere(body, radius=0.005)
        builder.add_shape_sphere(body, xform=wp.transform((0.0, 0.02, 0.0), wp.quat_identity()), radius=0.001)
        if number % 2:
            warpmag.add_inducible(builder, body=body)
        else:
            warpmag.add_permanent(builder, body=body, magnetization=M)
    builder.add_site(0, label="site")
    if kind == "distant":
        return builder, _add_plate(builder)
    source = warpmag.add_coil(builder, body=0, radius=0.01, label="coil")
    if kind in ("coils", "worlds"):
        warpmag.add_coil(builder, body=0, radius=0.01, wire_radius=1e-4, resistance=1.0, turns=10, label="driven")
    return builder, source


def _add_plate(builder: newton.ModelBuilder) -> int:
    """Add a plate of iron of more than 64 cells, far from the balls; return its shape."""
    plate = builder.add_body(xform=wp.transform((0.5, 0.0, 0.0), wp.quat_identity()))
    shape = builder.add_shape_box(plate, hx=0.03, hy=0.03, hz=0.0015)
    warpmag.add_inducible(builder, body=plate)
    return shape


def new_builder(world: dict) -> newton.ModelBuilder:
    """Return a builder of a ball as a magnet, which a simulation may change."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    builder.add_shape_sphere(builder.add_body(), radius=0.005)
    warpmag.add_permanent(builder, body=0, magnetization=M)
    return builder
