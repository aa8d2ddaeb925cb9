"""Groups the magnetic shapes of a Newton model into magnets, with their worlds and sampled moments."""

from dataclasses import dataclass, replace

import newton
import numpy as np
import warp as wp

from warpmag.declarations.magnets import Magnet
from warpmag.engine.magnets.attributes import NAMESPACE, marked_shapes, unique_rows
from warpmag.engine.magnets.sampling import BodyLattice, ShapeSampler
from warpmag.errors import InputError


@dataclass(frozen=True)
class BodyMagnet:
    """One magnet: shapes of one body with the same material and magnetization."""

    magnet: Magnet  # material and magnetization, in the frame of the body
    body: int  # -1 for a magnet fixed in the world
    shapes: tuple[int, ...]  # their union is the volume of the magnet
    world: int  # index among the worlds with magnets
    lattice: BodyLattice


def find_magnets(model: newton.Model) -> tuple[list[BodyMagnet], np.ndarray]:
    """Return the magnets of a model, and the Newton worlds with magnets, [-1] for a model without worlds.

    Magnets are sorted by world, then magnets of the induction solve before fixed magnets, then by body.
    """
    magnet_of_shape = marked_shapes(model)
    shapes, stored = np.array(list(magnet_of_shape)), list(magnet_of_shape.values())
    _, first, stored_index = np.unique(list(map(id, stored)), return_index=True, return_inverse=True)
    shape_bodies = model.shape_body.numpy()[shapes]
    # many shapes share few pairs of material and rotation: each pair is rotated to the body's frame once
    pairs, pair_index = unique_rows(np.column_stack([stored_index, model.shape_transform.numpy()[shapes, 3:]]))
    magnets = [_in_body_frame(stored[first[int(pair[0])]], pair[1:].tolist()) for pair in pairs]
    groups = _group(shape_bodies, pair_index, magnets)
    first_rows = np.array([rows[0] for rows in groups])
    worlds, magnet_worlds = _number_worlds(model, shapes[first_rows])
    # single-shape magnets of equal geometry and material share a lattice; other magnets have a kind of their own
    sampler, single = (
        ShapeSampler(model, few=_allows_few_moments(model, magnets)),
        np.array([len(rows) == 1 for rows in groups]),
    )
    unique_kind = -1 - np.arange(len(groups))
    kinds = np.where(single, sampler.kinds[shapes[first_rows]], unique_kind)
    _, first, lattice_index = np.unique(
        np.stack([pair_index[first_rows], kinds]), axis=1, return_index=True, return_inverse=True
    )
    samples = [(shapes[groups[k]].tolist(), magnets[pair_index[groups[k][0]]]) for k in first]
    lattices = [sampler.sample(*sample) for sample in samples]
    fixed = np.array([magnet.fixed for magnet in magnets])[pair_index[first_rows]]
    order = np.lexsort((shapes[first_rows], shape_bodies[first_rows], fixed, worlds))
    columns = (pair_index[first_rows], shape_bodies[first_rows], worlds, lattice_index.ravel())
    table = zip(order.tolist(), *(column[order].tolist() for column in columns), strict=True)
    shape_of = shapes.tolist()
    return [
        BodyMagnet(magnets[pair], body, tuple(shape_of[row] for row in groups[group]), world, lattices[lattice])
        for group, pair, body, world, lattice in table
    ], magnet_worlds


def _allows_few_moments(model: newton.Model, magnets: list[Magnet]) -> bool:
    """Return True if few moments may stand for a permanent magnet with a closed form.

    Fields of coils and field maps are evaluated at the moments of a magnet, and so are fields at magnets with recoil
    permeability. They vary over a magnet nearby. Gradients know the pairs of moments alone.
    """
    has_sources = any(getattr(getattr(model, NAMESPACE, None), "source", ()))
    return not (has_sources or model.requires_grad or any(magnet.recoils for magnet in magnets))


def _group(bodies: np.ndarray, magnet_of: np.ndarray, magnets: list[Magnet]) -> list[list[int]]:
    """Return groups of rows: the shapes of one body with the same magnet. A shape without a body is a group.

    ``bodies`` and ``magnet_of`` hold the body and the index of the magnet of each shape, shape [n].
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


def _in_body_frame(magnet: Magnet, rotation: list[float]) -> Magnet:
    """Return a magnet in the frame of its body; ``rotation`` is the quaternion x y z w of its shape."""
    magnetization = wp.quat_rotate(wp.quat(*rotation), wp.vec3(*magnet.magnetization))
    return replace(magnet, magnetization=tuple(magnetization))


def _same_magnet(a: Magnet, b: Magnet) -> bool:
    """Return True if two magnets of one body have equal materials, and equal magnetizations up to rounding."""
    if a is b:
        return True
    if replace(a, magnetization=b.magnetization) != b:
        return False
    difference = np.linalg.norm(np.subtract(a.magnetization, b.magnetization))
    return bool(difference <= 1e-5 * np.linalg.norm(a.magnetization))


def _number_worlds(model: newton.Model, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of each shape's world among the worlds with magnets, and these worlds.

    A model without worlds has the worlds [-1]. A magnet outside all worlds belongs to the only world with magnets;
    several worlds raise an error.
    """
    worlds = model.shape_world.numpy()[shapes]
    magnet_worlds = np.unique(worlds[worlds >= 0])
    if len(magnet_worlds) > 1 and (worlds < 0).any():
        label = model.shape_label[shapes[int(np.argmax(worlds < 0))]]
        raise InputError(
            f"{label}: a magnet outside all worlds, while {len(magnet_worlds)} worlds hold magnets of their own"
        )
    numbers = np.where(worlds >= 0, np.searchsorted(magnet_worlds, worlds), 0)
    return numbers, magnet_worlds if len(magnet_worlds) else np.array([-1])
