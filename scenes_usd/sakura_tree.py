"""Sakura Tree: iron balls rain on a tree with a magnet at the end of each branch (Kim and Han 2022, Fig. 6).

``python -m warpmag.scenes_usd.sakura_tree -o sakura_tree.usdc``

The tree grows by space colonization (Runions, Lane and Prusinkiewicz 2007): twigs grow in steps towards the points of a
crown that are nearest to them, until they reach these points.
"""

import itertools
import math
import os
from dataclasses import dataclass

import numpy as np

from warpmag.declarations.magnets import Magnet, MagneticSettings
from warpmag.errors import InputError
from warpmag.scenes_usd import authoring

BARK_COLOR = (0.14, 0.075, 0.055)
BUD_COLOR = (0.9, 0.35, 0.5)

_STEP, _REACHED = 0.032, 0.04
"""Length of a step of growth, and the distance at which a point of the crown is reached, over the tree's height."""
_UPWARD = 0.15  # upward pull on every twig, over the pull of one point
_CROWN_DISTANCE = 0.068  # smallest distance of the points of the crown over the tree's height
_TWIG = 0.7  # radius of a twig at its end over the radius of its bud
_PIPES = 2.9  # exponent n of the radii at a fork, r^n = Σ r_k^n (da Vinci: 2)
_TAPER = 1.015  # ratio of the radii of a segment and the segment above it
_BALL_DISTANCE = 0.75
"""Smallest distance of the balls in the sky over their mean spacing; beyond 0.9 random positions run out."""
_USUAL = 2500  # number of balls of a rain as wide as the crown; more balls make the rain wider and higher in proportion
_MANY = 10_000  # larger numbers of balls are authored as instances, on a jittered lattice
_CROWN_CENTER, _CROWN = (0.0, 0.0, 0.66), (0.56, 0.56, 0.34)
"""Center and semi-axes of the ellipsoid of the crown, over the tree's height."""
_TRUNK = ((0.0, 0.0, 0.0), (0.01, -0.006, 0.05), (0.012, -0.014, 0.1), (0.002, -0.018, 0.15), (-0.012, -0.01, 0.2))
"""The trunk below the first fork, over the tree's height."""


@dataclass(frozen=True)
class Tree:
    """A tree of straight segments, each from the node's parent to the node."""

    nodes: np.ndarray  # positions [m], shape [n, 3]
    parents: np.ndarray  # parent of each node, of smaller index, -1 for the root, shape [n]
    radii: np.ndarray  # radius of the segment that ends at each node [m], shape [n]

    @property
    def tips(self) -> np.ndarray:
        """Nodes without children."""
        return np.setdiff1d(np.arange(len(self.nodes)), self.parents)


def author(
    path: str | os.PathLike,
    *,
    balls: int = 2500,
    branches: int = 180,
    radius: float = 0.005,
    saturation: float = 1.7e6,
    height: float = 0.4,
    bud_radius: float = 0.004,
    magnetization: float = 6e6,
    spacing: float = 0.022,
    friction: float = 0.4,
    seed: int = 7,
) -> None:
    """Write the stage to ``path``.

    Args:
        balls: Number of balls.
        branches: Largest number of ends of branches; fewer if the crown has no room.
        radius: Radius of the balls [m].
        saturation: Saturation magnetization of the balls [A/m].
        height: Height of the tree [m].
        bud_radius: Radius of the magnets at the ends of the branches [m].
        magnetization: Magnetization of these magnets, along the branch [A/m].
        spacing: Mean distance of neighboring balls in the sky [m].
        friction: Coefficient of friction of all materials.
        seed: Seed of the tree and of the rain.
    """
    for name, value in (("balls", balls), ("branches", branches)):
        authoring.check_count(name, value)
    tree = grow(branches, height, bud_radius, np.random.default_rng(seed))
    stage = authoring.new_stage(
        f"Sakura Tree: {balls} iron balls fall from the sky and cling to the magnets at the ends of the branches\n\n"
        "Kim and Han 2022, Fig. 6. Ordinary friction, steps of 1 ms.",
        seconds=5.0,
    )
    authoring.add_scene(stage, MagneticSettings())
    bark = authoring.add_material(stage, "Bark", color=BARK_COLOR, roughness=0.9, density=700.0, friction=friction)
    bud = authoring.add_material(stage, "Bud", color=BUD_COLOR, roughness=0.4, density=7500.0, friction=friction)
    iron = authoring.add_iron_material(stage, friction=friction)
    authoring.add_gray_ground(stage, size=10.0 * height, friction=friction)
    _add_tree(stage, tree, bark, bud, bud_radius, magnetization)
    inducible = Magnet(saturation=saturation)
    positions = rain(balls, radius, spacing, height, np.random.default_rng(seed))
    if balls > _MANY:
        authoring.add_balls(stage, "/World/Balls", positions, radius, iron, magnet=inducible)
    else:
        authoring.add_ball_prims(stage, positions, radius, iron, digits=5, magnet=inducible)
    authoring.add_camera(stage, (1.3 * height, -4.6 * height, 1.2 * height), (0.0, 0.0, 0.8 * height))
    authoring.save(stage, path)


def _add_tree(stage, tree, bark, bud, bud_radius, magnetization) -> None:
    """Author the tree as one kinematic body, so that balls that touch any part of it count as held by a magnet."""
    authoring.add_body(stage, "/World/Tree", (0.0, 0.0, 0.0), kinematic=True)
    for node in range(1, len(tree.nodes)):
        path, radius = f"/World/Tree/Branch_{node:04d}", float(tree.radii[node])
        start, end = tree.nodes[tree.parents[node]], tree.nodes[node]
        authoring.add_capsule(stage, path, start, end, radius, bark, color=BARK_COLOR)
    for number, tip in enumerate(tree.tips):
        direction = tree.nodes[tip] - tree.nodes[tree.parents[tip]]
        direction *= magnetization / np.linalg.norm(direction)
        magnet = Magnet(kind="permanent", magnetization=tuple(direction.tolist()))
        options = {"motion": authoring.STATIC, "magnet": magnet, "color": BUD_COLOR}
        authoring.add_ball(stage, f"/World/Tree/Bud_{number:04d}", tree.nodes[tip], bud_radius, bud, **options)


def grow(branches: int, height: float, bud_radius: float, random: np.random.Generator) -> Tree:
    """Grow a tree of ``height`` [m] to at most ``branches`` random points of its crown; its buds do not touch."""
    if not 0.0 < bud_radius < 0.5 * _STEP * height:
        raise InputError(f"bud_radius: must be positive and below {0.5 * _STEP * height:g} m, got {bud_radius:g}")
    targets = _crown(branches, random)
    nodes, parents = [np.array(node) for node in _TRUNK], list(range(-1, len(_TRUNK) - 1))
    fork = len(_TRUNK) - 1
    while len(targets):
        nearest = fork + np.linalg.norm(targets[:, None] - nodes[fork:], axis=2).argmin(axis=1)
        count = len(nodes)
        for node in np.unique(nearest):
            pulls = targets[nearest == node] - nodes[node]
            direction = (pulls / np.linalg.norm(pulls, axis=1, keepdims=True)).sum(axis=0)
            direction[2] += _UPWARD
            # rounded, so that the same tree grows on every machine
            new = np.round(nodes[node] + _STEP * direction / np.linalg.norm(direction), 6)
            if np.linalg.norm(np.array(nodes) - new, axis=1).min() > 0.6 * _STEP:
                nodes.append(new)
                parents.append(int(node))
        if len(nodes) == count:
            break  # points that pull a twig back and forth remain unreached
        distances = np.linalg.norm(targets[:, None] - nodes[count:], axis=2).min(axis=1)
        targets = targets[distances > _REACHED]
    nodes, parents = np.array(nodes), np.array(parents)
    nodes, parents = _without_close_tips(nodes, parents, 2.5 * bud_radius / height)
    return Tree(height * nodes, parents, _radii(parents, _TWIG * bud_radius))


def _crown(count: int, random: np.random.Generator) -> np.ndarray:
    """Return points in the upper part of the crown's ellipsoid, shape [n, 3]."""
    points = np.empty((0, 3))
    for _ in range(200 * count):
        point = random.uniform(-1.0, 1.0, 3)
        if np.linalg.norm(point) > 1.0 or point[2] < -0.55 + 0.3 * np.hypot(*point[:2]):
            continue
        point = np.array(_CROWN_CENTER) + np.array(_CROWN) * point
        if not len(points) or np.linalg.norm(points - point, axis=1).min() > _CROWN_DISTANCE:
            points = np.vstack([points, point])
        if len(points) == count:
            break
    return points


def _without_close_tips(nodes, parents, least) -> tuple[np.ndarray, np.ndarray]:
    """Remove twigs whose ends are nearer to another node than the distance ``least``, each down to its fork."""
    while True:
        forks = np.bincount(parents[1:], minlength=len(nodes))
        tips = np.flatnonzero(forks == 0)
        for tip in tips:
            rest = np.delete(nodes, [tip, parents[tip]], axis=0)
            if np.linalg.norm(rest - nodes[tip], axis=1).min() < least:
                break
        else:
            return nodes, parents
        twig = [tip]
        while forks[parents[twig[-1]]] == 1:
            twig.append(parents[twig[-1]])
        keep = np.setdiff1d(np.arange(len(nodes)), twig)
        parents = np.concatenate([[-1], np.searchsorted(keep, parents[keep[1:]])])
        nodes = nodes[keep]


def _radii(parents, twig) -> np.ndarray:
    """Return the radius of each segment from the radii of its children (``_PIPES``) and the taper."""
    sums = np.zeros(len(parents))
    radii = np.full(len(parents), twig)
    for node in reversed(range(len(parents))):
        if sums[node]:
            radii[node] = _TAPER * sums[node] ** (1.0 / _PIPES)
        if node:
            sums[parents[node]] += radii[node] ** _PIPES
    return radii


def rain(count: int, radius: float, spacing: float, height: float, random: np.random.Generator) -> np.ndarray:
    """Return random centers of balls [m] above a tree of ``height`` [m], from the lowest up, shape [count, 3].

    ``spacing`` is the edge of the mean volume per ball [m].
    """
    least = _BALL_DISTANCE * spacing
    if least < authoring.BALL_SPACING * radius:
        needed = authoring.BALL_SPACING * radius / _BALL_DISTANCE
        raise InputError(f"spacing: balls of radius {radius:g} m need at least {needed:g} m, got {spacing:g} m")
    reach = max(_CROWN[0] * height, spacing) * max(1.0, count / _USUAL) ** (1.0 / 3.0)
    bottom = (_CROWN_CENTER[2] + _CROWN[2] + 0.15) * height
    depth = count * spacing**3 / (math.pi * reach**2)
    if count > _MANY:
        return _lattice_rain(count, reach, spacing, random) + np.array([0.0, 0.0, bottom])
    positions: list[list[float]] = []
    cells: dict[tuple[int, ...], list[list[float]]] = {}
    around = list(itertools.product((-1, 0, 1), repeat=3))
    while len(positions) < count:
        position = np.round(random.uniform((-reach, -reach, bottom), (reach, reach, bottom + depth)), 6).tolist()
        x, y, z = (int(coordinate // least) for coordinate in position)
        neighbors = [ball for a, b, c in around for ball in cells.get((x + a, y + b, z + c), ())]
        if math.hypot(*position[:2]) <= reach and all(math.dist(ball, position) > least for ball in neighbors):
            positions.append(position)
            cells.setdefault((x, y, z), []).append(position)
    return np.array(sorted(positions, key=lambda position: position[2]))


def _lattice_rain(count: int, reach: float, spacing: float, random: np.random.Generator) -> np.ndarray:
    """Return positions above z = 0 within ``reach`` of the z axis, from the lowest up, shape [count, 3]."""
    side = math.ceil(reach / spacing)
    axis = np.arange(-side, side + 1) * spacing
    disc = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    disc = disc[np.hypot(*disc.T) <= reach]
    layers = math.ceil(count / len(disc))
    heights = np.repeat((np.arange(layers) + 0.5) * spacing, len(disc))
    sites = np.column_stack([np.tile(disc, (layers, 1)), heights])[:count]
    return authoring.scatter(sites, spacing, _BALL_DISTANCE * spacing, random)


if __name__ == "__main__":
    authoring.run(author)
