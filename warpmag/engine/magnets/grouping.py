"""The magnets of a Newton model: groups of shapes that are one magnet each, with their worlds and sampled moments."""

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
    """One magnet: shapes of one body with the same material and magnetization.

    Attributes:
        magnet: The material, magnetization in the frame of the body.
        body: The body, -1 for a magnet fixed in the world.
        shapes: The shapes, together one volume.
        world: Index of the world among those that hold magnets.
        lattice: The sampled moments in the frame of the body, grouped by shape.
    """

    magnet: Magnet
    body: int
    shapes: tuple[int, ...]
    world: int
    lattice: BodyLattice


def find_magnets(model: newton.Model) -> tuple[list[BodyMagnet], np.ndarray]:
    """Group the shapes of ``model`` that carry magnets, and sample the groups.

    Args:
        model: The model.

    Returns:
        The magnets, by world, then inducible before permanent ones, then by body; and the Newton worlds that hold
        them, [-1] for a model without worlds.
    """
    magnet_of_shape = marked_shapes(model)
    shapes, stored = np.array(list(magnet_of_shape)), list(magnet_of_shape.values())
    _, first, stored_of = np.unique(list(map(id, stored)), return_index=True, return_inverse=True)
    body_of = model.shape_body.numpy()[shapes]
    # many shapes share few materials and rotations: each pair is turned into the body's frame once
    pairs, pair_of = unique_rows(np.column_stack([stored_of, model.shape_transform.numpy()[shapes, 3:]]))
    magnets = [_in_body_frame(stored[first[int(pair[0])]], pair[1:].tolist()) for pair in pairs]
    groups = _group(body_of, pair_of, magnets)
    lead = np.array([rows[0] for rows in groups])
    worlds, held = _number_worlds(model, shapes[lead])
    # magnets of one shape share a lattice with others of the same shape and material
    sampler, single = ShapeSampler(model), np.array([len(rows) == 1 for rows in groups])
    own_kind = -1 - np.arange(len(groups))
    kinds = np.where(single, sampler.kinds[shapes[lead]], own_kind)
    _, first, lattice_of = np.unique(np.stack([pair_of[lead], kinds]), axis=1, return_index=True, return_inverse=True)
    lattices = [_sampled(sampler, shapes[groups[group]].tolist(), magnets[pair_of[lead[group]]]) for group in first]
    fixed = np.array([magnet.fixed for magnet in magnets])[pair_of[lead]]
    order = np.lexsort((shapes[lead], body_of[lead], fixed, worlds))
    columns = (pair_of[lead], body_of[lead], worlds, lattice_of.ravel())
    table = zip(order.tolist(), *(column[order].tolist() for column in columns), strict=True)
    shape_of = shapes.tolist()
    return [
        BodyMagnet(magnets[pair], body, tuple(shape_of[row] for row in groups[group]), world, lattices[lattice])
        for group, pair, body, world, lattice in table
    ], held


def _group(bodies: np.ndarray, magnet_of: np.ndarray, magnets: list[Magnet]) -> list[list[int]]:
    """Return groups of rows: the shapes of one body with the same material and magnetization.

    Args:
        bodies: Body of each shape, shape [n]; a shape without a body is a group of its own.
        magnet_of: Index into ``magnets`` of each shape, shape [n].
        magnets: Magnets, magnetizations in the frame of the body.
    """
    _, body, sizes = np.unique(bodies, return_inverse=True, return_counts=True)
    alone = (bodies < 0) | (sizes[body] == 1)
    groups = np.flatnonzero(alone)[:, None].tolist()
    groups_of_body: dict[int, list[list[int]]] = {}
    for row in np.flatnonzero(~alone).tolist():
        own_groups = groups_of_body.setdefault(int(bodies[row]), [])
        magnet = magnets[magnet_of[row]]
        group = next((group for group in own_groups if _same_magnet(magnets[magnet_of[group[0]]], magnet)), None)
        if group is None:
            own_groups.append(group := [])
        group.append(row)
    return groups + [group for own_groups in groups_of_body.values() for group in own_groups]


def _sampled(sampler: ShapeSampler, shapes: list[int], magnet: Magnet) -> BodyLattice:
    """Return the sampled moments of shapes that are one magnet."""
    return sampler.sample(shapes, magnet.moment_spacing, magnet.fixed, magnet.kind == "permanent")


def _in_body_frame(magnet: Magnet, rotation: list[float]) -> Magnet:
    """Return a magnet in the frame of its body; ``rotation`` is that of the shape, a quaternion x y z w."""
    magnetization = wp.quat_rotate(wp.quat(*rotation), wp.vec3(*magnet.magnetization))
    return replace(magnet, magnetization=tuple(magnetization))


def _same_magnet(a: Magnet, b: Magnet) -> bool:
    """Return whether two magnets of one body have the same material, and the same magnetization up to rounding."""
    if a is b:
        return True
    if replace(a, magnetization=b.magnetization) != b:
        return False
    difference = np.linalg.norm(np.subtract(a.magnetization, b.magnetization))
    return bool(difference <= 1e-5 * np.linalg.norm(a.magnetization))


def _number_worlds(model: newton.Model, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of each shape's world among the worlds that hold magnets, and these worlds.

    A model without worlds has the worlds [-1]. A magnet outside all worlds belongs to the world that holds magnets; an
    error is raised if there are several.
    """
    worlds = model.shape_world.numpy()[shapes]
    held = np.unique(worlds[worlds >= 0])
    if len(held) > 1 and (worlds < 0).any():
        label = model.shape_label[shapes[int(np.argmax(worlds < 0))]]
        raise InputError(f"{label}: a magnet outside all worlds, while {len(held)} worlds hold magnets of their own")
    numbers = np.where(worlds >= 0, np.searchsorted(held, worlds), 0)
    return numbers, held if len(held) else np.array([-1])
