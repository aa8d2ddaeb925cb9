"""The magnets of a Newton model: which of its marked shapes are one, and in which world."""

from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp

from warpmag.engine.attributes import marked_shapes
from warpmag.engine.sampling import BodyLattice, ShapeSampler
from warpmag.errors import InputError
from warpmag.magnets import Magnet


@dataclass(frozen=True)
class BodyMagnet:
    """Shapes of one body that are one magnet.

    Attributes:
        magnet: The material, magnetization in the frame of the body.
        body: The body, -1 for a magnet fixed in the world.
        shapes: The shapes, together one volume.
        world: The world, counted among those that hold magnets.
        lattice: The sampled moments in the frame of the body, grouped by shape.
    """

    magnet: Magnet
    body: int
    shapes: tuple[int, ...]
    world: int
    lattice: BodyLattice


def find_magnets(model: newton.Model) -> tuple[list[BodyMagnet], np.ndarray]:
    """Group the marked shapes of ``model`` into magnets and sample them, in the order that the system wants.

    Args:
        model: The model.

    Returns:
        The magnets, and the Newton worlds that hold them, -1 where there are none.
    """
    body_of, rotations = model.shape_body.numpy().tolist(), model.shape_transform.numpy()[:, 3:].tolist()
    groups: list[tuple[Magnet, int, list[int]]] = []
    of_body: dict[int, list[tuple[Magnet, int, list[int]]]] = {}
    known: dict[tuple, Magnet] = {}  # few materials and rotations, of many shapes
    for shape, stored in marked_shapes(model).items():
        body, key = body_of[shape], (id(stored), *rotations[shape])
        magnet = known.get(key) or known.setdefault(key, _turned(stored, rotations[shape]))
        alike = [group for group in of_body.get(body, ()) if body >= 0 and _alike(group[0], magnet)]
        if alike:
            alike[0][2].append(shape)
        else:
            groups.append((magnet, body, [shape]))
            of_body.setdefault(body, []).append(groups[-1])
    worlds, held = _number_worlds(model, [shapes[0] for _, _, shapes in groups])
    sampler = ShapeSampler(model)
    magnets = [
        BodyMagnet(
            magnet,
            body,
            tuple(shapes),
            world,
            sampler.sample(shapes, magnet.moment_spacing, magnet.fixed),
        )
        for (magnet, body, shapes), world in zip(groups, worlds, strict=True)
    ]
    return sorted(magnets, key=lambda one: (one.world, one.magnet.fixed, one.body, one.shapes)), held


def _turned(magnet: Magnet, rotation: list[float]) -> Magnet:
    """Return a magnet of a shape in the frame of its body."""
    turned = wp.quat_rotate(wp.quat(*rotation), wp.vec3(*magnet.magnetization))
    return replace(magnet, magnetization=tuple(turned))


def _alike(a: Magnet, b: Magnet) -> bool:
    """Return whether two magnets of one body are the same material, magnetized alike up to rounding."""
    if a is b:
        return True
    if replace(a, magnetization=b.magnetization) != b:
        return False
    difference = np.linalg.norm(np.subtract(a.magnetization, b.magnetization))
    return bool(difference <= 1e-5 * np.linalg.norm(a.magnetization))


def _number_worlds(model: newton.Model, shapes: list[int]) -> tuple[list[int], np.ndarray]:
    """Return the world of each shape, counted among the worlds that hold magnets, and these, -1 if there are no worlds.

    A magnet outside all worlds belongs to the only one that holds magnets, if there is only one.
    """
    worlds = model.shape_world.numpy()[shapes]
    held = np.unique(worlds[worlds >= 0])
    if len(held) > 1 and (worlds < 0).any():
        label = model.shape_label[shapes[int(np.argmax(worlds < 0))]]
        raise InputError(f"{label}: a magnet outside all worlds, while {len(held)} worlds hold magnets of their own")
    numbers = np.where(worlds >= 0, np.searchsorted(held, worlds), 0).tolist()
    return numbers, held if len(held) else np.array([-1])
