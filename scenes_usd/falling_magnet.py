"""Falling Magnet: a heavy, strong ball magnet falls on a stack of iron balls (Kim and Han 2022, Fig. 5).

``python -m warpmag.scenes_usd.falling_magnet -o falling_magnet.usdc``
"""

import math
import os

import numpy as np

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring


def author(
    path: str | os.PathLike,
    *,
    balls: int = 1032,
    layers: int = 6,
    radius: float = 0.005,
    saturation: float = 1.7e6,
    magnet_radius: float = 0.02,
    magnet_density: float = 7500.0,
    magnetization: float = 1e6,
    drop: float = 0.1,
    friction: float = 0.4,
) -> None:
    """Write the stage to ``path``.

    Args:
        balls: Number of balls.
        layers: Largest number of layers of the stack.
        radius: Radius of the balls [m].
        saturation: Saturation magnetization of the balls [A/m].
        magnet_radius: Radius of the magnet [m].
        magnet_density: Density of the magnet [kg/m³].
        magnetization: Magnetization of the magnet, along z [A/m].
        drop: Gap between the magnet and the top of the stack [m].
        friction: Coefficient of friction of all materials.
    """
    for name, value in (("balls", balls), ("layers", layers)):
        authoring.check_count(name, value)
    if not drop > 0.0:
        raise InputError(f"drop: the magnet must be above the stack, got {drop}")
    stage = authoring.new_stage(
        f"Falling Magnet: a heavy, strong magnet falls on a stack of {balls} iron balls, which cling to it\n\n"
        "Kim and Han 2022, Fig. 5. Ordinary friction, steps of 1 ms.",
        seconds=5.0,
    )
    authoring.add_scene(stage, MagneticSettings())
    iron = authoring.add_iron_material(stage, friction=friction)
    red = authoring.add_magnet_material(stage, density=magnet_density, friction=friction)
    authoring.add_gray_ground(stage, size=2.0, friction=friction)
    positions = stack(balls, layers, radius)
    authoring.add_ball_prims(stage, positions, radius, iron, digits=5, magnet=Magnet(saturation=saturation))
    top = float(positions[:, 2].max()) + radius
    permanent = Magnet(kind="permanent", magnetization=(0.0, 0.0, magnetization))
    position, color = (0.0, 0.0, top + drop + magnet_radius), authoring.MAGNET_COLOR
    authoring.add_ball(stage, "/World/Magnet", position, magnet_radius, red, magnet=permanent, color=color)
    reach = max(float(np.ptp(positions[:, 0])), top + drop + 2.0 * magnet_radius)
    authoring.add_camera(stage, (1.2 * reach, -3.2 * reach, 1.2 * reach), (0.0, 0.0, 0.46 * reach))
    authoring.save(stage, path)


def stack(count: int, layers: int, radius: float) -> np.ndarray:
    """Return the positions of balls in a round stack, each above the gap between four balls of the layer below.

    The balls fill the lowest cone with a slope of 45 degrees that holds them, so that four balls support each ball.
    There are at most ``layers`` layers. Positions [m] have the shape [count, 3], from the ground up.
    """
    pitch = authoring.BALL_SPACING * radius
    rise = pitch / math.sqrt(2.0)
    side = int(2.0 * math.sqrt(count)) + 4  # more than enough for all balls in one layer
    sites = []
    for layer in range(layers):
        line = (np.arange(side) - 0.5 * (side - 1) + 0.5 * (layer % 2)) * pitch
        x, y = np.meshgrid(line, line)
        sites.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, radius + layer * rise)], axis=1))
    sites = np.concatenate(sites)
    # height and angle break ties, so that the choice does not depend on rounding
    height_of_cone = np.round((np.linalg.norm(sites[:, :2], axis=1) + sites[:, 2]) / radius, 6)
    angle = np.round(np.arctan2(sites[:, 1], sites[:, 0]), 6)
    positions = sites[np.lexsort((angle, sites[:, 2], height_of_cone))[:count]]
    return positions[np.lexsort(positions.T)]


if __name__ == "__main__":
    authoring.run(author)
