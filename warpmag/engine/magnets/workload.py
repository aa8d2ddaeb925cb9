"""Number of moments of each body, and the time of a step by part, body and world."""

from dataclasses import dataclass

import numpy as np

from warpmag.engine.magnets.placed_moments import PlacedMoments
from warpmag.engine.magnets.selection import prim_label
from warpmag.kernels.applied.near_cells import NEAR
from warpmag.moments.part_times import part_times

_MOST_LINES = 10
"""Largest number of bodies in the text."""


@dataclass(frozen=True)
class BodyLoad:
    """Moments of one magnet and its estimated time. A magnet consists of all magnetic shapes of one body.

    Attributes:
        label: Label of its first shape.
        world: Newton world, -1 for none.
        kind: ``inducible`` or ``permanent``.
        moments: Number of moments.
        near_cells: Number of cells so close to a permanent magnet that its field is averaged over them.
        seconds: Estimated share of the time of a step [s].
    """

    label: str
    world: int
    kind: str
    moments: int
    near_cells: int
    seconds: float


@dataclass(frozen=True)
class Workload:
    """Time of each part of a step, and estimated time of each body; ``str`` returns both as a table.

    Attributes:
        seconds: Time of each part [s], by name.
        bodies: Moments and times of the magnets, the most expensive first.
        evaluations: Field evaluations of the last solve, shape [worlds with magnets].
    """

    seconds: dict[str, float]
    bodies: tuple[BodyLoad, ...]
    evaluations: np.ndarray

    @property
    def world_seconds(self) -> dict[int, float]:
        """Estimated time of each Newton world [s]."""
        worlds: dict[int, float] = {}
        for body in self.bodies:
            worlds[body.world] = worlds.get(body.world, 0.0) + body.seconds
        return worlds

    def __str__(self) -> str:
        """Return the parts and the most expensive bodies, line by line."""
        whole = sum(self.seconds.values())
        lines = [f"{1e3 * whole:10.3f} ms  a step, {self.evaluations.mean():.1f} evaluations of the field"]
        lines += [f"{1e3 * seconds:10.3f} ms  {part}" for part, seconds in self.seconds.items()]
        lines += [
            f"{1e3 * body.seconds:10.3f} ms  {body.label}, world {body.world}: {body.moments} moments, "
            f"{body.near_cells} near cells"
            for body in self.bodies[:_MOST_LINES]
        ]
        if len(self.bodies) > _MOST_LINES:
            lines.append(f"{'':13}  and {len(self.bodies) - _MOST_LINES} more bodies")
        return "\n".join(lines)


def workload(magnetics, placed: PlacedMoments) -> Workload:
    """Return the workload of the last solve of the moments ``placed``; see :meth:`Magnetics.workload`."""
    system, magnets = placed.system, magnetics.magnets
    counts, worlds = np.diff(placed.first), placed.worlds.world_numbers()
    near = np.add.reduceat(near_cells(system), placed.first[:-1])
    evaluations, seconds = system.evaluations.numpy(), part_times(system)
    in_world = np.bincount(worlds, counts)
    shares = {
        "neighbors": counts,
        "sources": near if near.any() else counts,
        "evaluations": counts * (in_world * np.maximum(evaluations, 1))[worlds],
    }
    pairs = counts * in_world[worlds]
    of_bodies = np.zeros(len(magnets))
    for part, time in seconds.items():
        share = shares.get(part, pairs).astype(float)
        of_bodies += time * share / share.sum()
    order, labels = np.argsort(-of_bodies, kind="stable"), magnetics.model.shape_label
    newton_worlds = magnetics.worlds
    rows = (
        (prim_label(magnets[k].shapes[0], labels), newton_worlds[worlds[k]], magnets[k].magnet.kind, counts[k], near[k])
        for k in order
    )
    bodies = tuple(
        BodyLoad(label, int(world), kind, int(count), int(cells), float(of_bodies[k]))
        for k, (label, world, kind, count, cells) in zip(order, rows, strict=True)
    )
    return Workload(seconds, bodies, evaluations)


def near_cells(system) -> np.ndarray:
    """Return 1 for each moment that is a cell near a permanent magnet, shape [n]."""
    near = np.zeros(system.count, int)
    interaction = system.source_interaction
    if interaction is not None and interaction.cell_count:
        cells = interaction.arrays.cells
        near[cells.cell.numpy()[:, 0]] = cells.near.numpy() == NEAR
    return near


def moments_line(magnetics) -> str:
    """Return the number of moments, and the body that has most of them, in words."""
    counts = [len(magnet.lattice.volumes) for magnet in magnetics.magnets]
    largest = int(np.argmax(counts))
    label = prim_label(magnetics.magnets[largest].shapes[0], magnetics.model.shape_label)
    if len(counts) == 1:
        return f"{counts[0]:,} in 1 body: {label}"
    return f"{sum(counts):,} in {len(counts):,} bodies, at most {counts[largest]:,} in one body: {label}"
