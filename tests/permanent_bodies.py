"""Models of permanent boxes, cylinders and balls for tests, and their fields by magpylib."""

import magpylib
import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

import warpmag

M = 1.05e6  # A/m, N42
SIDE, GAP = 0.01, 5e-4  # m
CUBE, DISC = ("box", (SIDE / 2,) * 3), ("cylinder", (SIDE / 2, SIDE / 4))
LARGE = ("box", (0.02,) * 3)
BALL = ("ball", (0.005,))
ALONG, ASKEW = (0.0, 0.0, M), (0.3 * M, -0.2 * M, 0.9 * M)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0), UPRIGHT
TILTED = tuple(Rotation.from_euler("xyz", [20.0, 35.0, 10.0], degrees=True).as_quat())
SINGLE = 3e-6  # rounding of float32 sums of some hundred terms, relative to the largest


def add(builder, kind, size, place=(0.0, 0.0, 0.0), turn=UPRIGHT, magnetization=ALONG):
    """Add a body of one shape, permanent unless it has no magnetization."""
    body = builder.add_body(xform=wp.transform(wp.vec3(*place), wp.quat(*turn)))
    if kind == "box":
        builder.add_shape_box(body, hx=size[0], hy=size[1], hz=size[2])
    elif kind == "cylinder":
        builder.add_shape_cylinder(body, radius=size[0], half_height=size[1])
    else:
        heavy = newton.ModelBuilder.ShapeConfig(
            density=1e6
        )  # Newton corrects the inertia of light bodies with a warning
        builder.add_shape_sphere(body, radius=size[0], cfg=heavy)
    if magnetization is None:
        warpmag.add_inducible(builder, body=body)
    else:
        warpmag.add_permanent(builder, body=body, magnetization=magnetization)
    return body


def model_of(device, *parts):
    """Return magnetics and state of bodies (kind, size, position, rotation, magnetization)."""
    builder = newton.ModelBuilder()
    warpmag.register_attributes(builder)
    for part in parts:
        add(builder, *part)
    model = builder.finalize(device=device)
    return warpmag.Magnetics(model, rtol=1e-5), model.state()


def magnets(device, *parts):
    """Return magnetics and wrenches of such bodies, shape [bodies, 6]."""
    magnetics, state = model_of(device, *parts)
    magnetics.apply(state)
    return magnetics, state.body_f.numpy().astype(float)


def force_on_second(device, *parts):
    return magnets(device, *parts)[1][1, :3]


def reference(kind, size, place=(0.0, 0.0, 0.0), turn=UPRIGHT, magnetization=ALONG):
    pose = {"position": place, "orientation": Rotation.from_quat(turn), "magnetization": magnetization}
    if kind == "box":
        return magpylib.magnet.Cuboid(dimension=2.0 * np.array(size), **pose)
    if kind == "cylinder":
        return magpylib.magnet.Cylinder(dimension=(2.0 * size[0], 2.0 * size[1]), **pose)
    return magpylib.magnet.Sphere(diameter=2.0 * size[0], **pose)


def gradient_of(magnet, x, step=1e-6):
    """Return the gradient of the field by central differences, ∂H_i/∂x_k, shape [3, 3]."""
    columns = [(magnet.getH(x + step * axis) - magnet.getH(x - step * axis)) / (2.0 * step) for axis in np.eye(3)]
    return np.stack(columns, axis=1)
