"""Builders of a few balls that several tests share."""

import newton
import warp as wp

import warpmag

R = 0.005  # m


def new_builder(**arguments):
    """A builder that knows warpmag's attributes."""
    builder = newton.ModelBuilder(**arguments)
    warpmag.register_attributes(builder)
    return builder


def add_ball(builder, position, magnetization=None, rotation=None, **arguments):
    """Add a ball of radius R, permanent if it has a magnetization, else inducible; return its body."""
    rotation = wp.quat_identity() if rotation is None else rotation
    body = builder.add_body(xform=wp.transform(position, rotation), **arguments)
    builder.add_shape_sphere(body, radius=R)
    if magnetization is None:
        warpmag.add_inducible(builder, body=body)
    else:
        warpmag.add_permanent(builder, body=body, magnetization=magnetization)
    return body
