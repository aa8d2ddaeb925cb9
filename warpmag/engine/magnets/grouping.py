"""The magnets of a Newton model: which of its marked shapes are one, and in which world."""

from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import marked_shapes, unique_rows
from warpmag.engine.magnets.sampling import BodyLattice, ShapeSampler
from warpmag.errors import InputError


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
    marked = marked_shapes(model)
    shapes, stored = np.array(list(marked)), list(marked.values())
    _, first, which = np.unique(list(map(id, stored)), return_index=True, return_inverse=True)
    body_of = model.shape_body.numpy()[shapes]
    # few materials and rotations, of many shapes
    rows, turned = unique_rows(np.column_stack([which, model.shape_transform.numpy()[shapes, 3:]]))
    magnets = [_turned(stored[first[int(row[0])]], row[1:].tolist()) for row in rows]
    members = _group(body_of, turned, magnets)
    lead = np.array([one[0] for one in members])
    worlds, held = _number_worlds(model, shapes[lead])
    sampler, single = ShapeSampler(model), np.array([len(one) == 1 for one in members])
    several = -1 - np.arange(len(members))  # magnets of several shapes are looked at one by one
    kinds = np.where(single, sampler.kinds[shapes[lead]], several)
    _, first, of_lattice = np.unique(np.stack([turned[lead], kinds]), axis=1, return_index=True, return_inverse=True)
    lattices = [_sampled(sampler, shapes[members[group]].tolist(), magnets[turned[lead[group]]]) for group in first]
    fixed = np.array([one.fixed for one in magnets])[turned[lead]]
    order = np.lexsort((shapes[lead], body_of[lead], fixed, worlds))
    columns = (turned[lead], body_of[lead], worlds, of_lattice.ravel())
    found = zip(order.tolist(), *(column[order].tolist() for column in columns), strict=True)
    listed = shapes.tolist()
    return [
        BodyMagnet(magnets[own], body, tuple(listed[one] for one in members[group]), world, lattices[lattice])
        for group, own, body, world, lattice in found
    ], held


def _group(bodies: np.ndarray, turned: np.ndarray, magnets: list[Magnet]) -> list[list[int]]:
    """Return which marked shapes are one magnet each: those of one body that are of one material; by their rows.

    Args:
        bodies: Body of each, shape [n]; a shape without one is a magnet of its own.
        turned: Which of ``magnets`` each is, shape [n].
        magnets: Materials, magnetizations in the frame of the body.
    """
    _, body, sizes = np.unique(bodies, return_inverse=True, return_counts=True)
    alone = (bodies < 0) | (sizes[body] == 1)
    groups = np.flatnonzero(alone)[:, None].tolist()
    of_body: dict[int, list[list[int]]] = {}
    for row in np.flatnonzero(~alone).tolist():
        known = of_body.setdefault(int(bodies[row]), [])
        mine = magnets[turned[row]]
        group = next((one for one in known if _alike(magnets[turned[one[0]]], mine)), None)
        if group is None:
            known.append(group := [])
        group.append(row)
    return groups + [one for known in of_body.values() for one in known]


def _sampled(sampler: ShapeSampler, shapes: list[int], magnet: Magnet) -> BodyLattice:
    return sampler.sample(shapes, magnet.moment_spacing, magnet.fixed, magnet.kind == "permanent")


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


def _number_worlds(model: newton.Model, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the world of each shape, counted among the worlds that hold magnets, and these, -1 if there are no worlds.

    A magnet outside all worlds belongs to the only one that holds magnets, if there is only one.
    """
    worlds = model.shape_world.numpy()[shapes]
    held = np.unique(worlds[worlds >= 0])
    if len(held) > 1 and (worlds < 0).any():
        label = model.shape_label[shapes[int(np.argmax(worlds < 0))]]
        raise InputError(f"{label}: a magnet outside all worlds, while {len(held)} worlds hold magnets of their own")
    numbers = np.where(worlds >= 0, np.searchsorted(held, worlds), 0)
    return numbers, held if len(held) else np.array([-1])
