"""Balls Up: a square stack of iron balls below a fixed permanent magnet (Kim and Han 2022, Fig. 3).

``python -m warpmag.scenes_usd.balls_up -o balls_up.usdc``
"""

import os

import numpy as np

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring


def author(
    path: str | os.PathLike,
    *,
    columns: int = 9,
    rows: int = 9,
    layers: int = 3,
    radius: float = 0.005,
    saturation: float = 1.7e6,
    magnet_size: float = 0.04,
    magnetization: float = 1e6,
    height: float = 0.051,
    conductivity: float = 1e7,
) -> None:
    """Write the stage to ``path``.

    Args:
        columns: Balls along x.
        rows: Balls along y.
        layers: Balls along z; the lowest layer rests on the ground.
        radius: Radius of the balls [m].
        saturation: Saturation magnetization of the balls [A/m].
        magnet_size: Edge of the magnet [m].
        magnetization: Magnetization of the magnet along z [A/m].
        height: Center of the magnet above the ground [m].
        conductivity: Electrical conductivity of the balls [S/m], by default of iron at room temperature: without
            friction, only eddy currents stop balls that hang and swing.
    """
    pitch = authoring.BALL_SPACING * radius
    top = (layers - 1) * pitch + 2.0 * radius
    if height - 0.5 * magnet_size <= top:
        raise InputError(f"height: the magnet must hang above the balls, whose top is at {top:g} m, got {height:g}")
    count = columns * rows * layers
    stage = authoring.new_stage(
        f"Balls Up: {count} iron balls jump to a permanent magnet above them and stick\n\n"
        "Kim and Han 2022, Fig. 3. No friction, no restitution, steps of 1 ms. Eddy currents brake the balls.",
        seconds=3.0,
    )
    authoring.add_scene(stage, MagneticSettings())
    iron, red = authoring.add_iron_material(stage), authoring.add_magnet_material(stage)
    authoring.add_gray_ground(stage, size=1.0)
    permanent = Magnet(kind="permanent", magnetization=(0.0, 0.0, magnetization))
    position, edges = (0.0, 0.0, height), (magnet_size,) * 3
    authoring.add_box(stage, "/World/Magnet", position, edges, red, magnet=permanent, motion=authoring.KINEMATIC)
    positions = [
        ((x - 0.5 * (columns - 1)) * pitch, (y - 0.5 * (rows - 1)) * pitch, radius + z * pitch)
        for z, y, x in np.ndindex(layers, rows, columns)
    ]
    inducible = Magnet(saturation=saturation, conductivity=conductivity)
    authoring.add_ball_prims(stage, positions, radius, iron, magnet=inducible)
    authoring.add_camera(stage, (0.28, -0.36, 0.2), (0.0, 0.0, 0.5 * height))
    authoring.save(stage, path)


if __name__ == "__main__":
    authoring.run(author)
