"""Million: a cloud of iron balls without weight is drawn into a clump by a permanent magnet in its middle.

``python -m warpmag.scenes_usd.million -o million.usdc``
"""

import math
import os

import numpy as np

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring

_CELLS = 12  # largest number of moments along an edge of the magnet


def author(
    path: str | os.PathLike,
    *,
    balls: int = 1_000_000,
    radius: float = 0.0025,
    saturation: float = 1.7e6,
    spacing: float = 0.0075,
    magnet: float = 0.4,
    magnetization: float = 1e6,
    friction: float = 0.4,
    seed: int = 1,
) -> None:
    """Write the stage to ``path``.

    Args:
        balls: Number of balls.
        radius: Radius of the balls [m].
        saturation: Saturation magnetization of the balls [A/m].
        spacing: Mean distance of neighboring balls [m].
        magnet: Edge of the magnet, a cube, over the radius of the cloud.
        magnetization: Magnetization of the magnet, along z [A/m].
        friction: Coefficient of friction of all materials.
        seed: Seed of the positions of the balls.
    """
    authoring.check_count("balls", balls)
    if not 0.0 < magnet < 1.0:
        raise InputError(f"magnet: must be between 0 and 1, got {magnet:g}")
    if not spacing > 2.2 * radius:
        raise InputError(f"spacing: balls of radius {radius:g} m need more than {2.2 * radius:g} m, got {spacing:g}")
    edge = float(max(magnet * (spacing * np.cbrt(0.75 * balls / math.pi)), 4.0 * radius))
    positions = cloud(balls, radius, spacing, edge, np.random.default_rng(seed))
    stage = authoring.new_stage(
        f"Million: {balls} iron balls without weight are drawn into a clump by a permanent magnet\n\n"
        "No gravity, ordinary friction, steps of 1 ms.",
        seconds=1.0,
    )
    authoring.add_scene(stage, MagneticSettings(), gravity=0.0)
    iron = authoring.add_iron_material(stage, friction=friction)
    red = authoring.add_magnet_material(stage, density=authoring.IRON_DENSITY, friction=friction)
    # cells hardly larger than balls: bodies in contact must be near pairs, which are summed one by one
    cell, origin = max(edge / _CELLS, 2.0 * radius), (0.0, 0.0, 0.0)
    permanent = Magnet(kind="permanent", magnetization=(0.0, 0.0, magnetization), moment_spacing=cell)
    authoring.add_box(stage, "/World/Magnet", origin, (edge,) * 3, red, motion=authoring.KINEMATIC, magnet=permanent)
    authoring.add_balls(stage, "/World/Balls", positions, radius, iron, magnet=Magnet(saturation=saturation))
    reach = float(np.linalg.norm(positions, axis=1).max())
    authoring.add_camera(stage, (1.2 * reach, -3.6 * reach, 1.2 * reach), origin)
    authoring.save(stage, path)


def cloud(count: int, radius: float, spacing: float, edge: float, random: np.random.Generator) -> np.ndarray:
    """Return the centers of balls [m], shape [count, 3], around a cube of edge ``edge`` [m], from the middle outwards.

    Distances of the balls are at least 2.1 radii.
    """
    free = 0.5 * edge + radius + 0.5 * spacing
    reach = math.ceil(np.cbrt(0.75 * (count + (2.0 * free / spacing) ** 3) / math.pi)) + 2
    axis = np.arange(-reach, reach + 1) * spacing
    sites = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    sites = sites[np.abs(sites).max(axis=1) >= free]
    nearest = np.argsort(np.round((sites**2).sum(axis=1) / spacing**2, 6), kind="stable")[:count]
    return authoring.scatter(sites[nearest], spacing, 2.1 * radius, random)


if __name__ == "__main__":
    authoring.run(author)
