"""Worlds of a model that are copies of the first one, as after ``ModelBuilder.replicate``."""

from dataclasses import dataclass

import newton
import numpy as np

from warpmag.engine.magnets.grouping import BodyMagnet
from warpmag.kernels.shared.copies import repeat_rows

KINEMATIC = int(newton.BodyFlags.KINEMATIC)


def kinematic_bodies(model: newton.Model) -> np.ndarray:
    """Return True for the kinematic bodies of a model, shape [bodies]."""
    flags = model.body_flags  # None in a model without bodies
    return np.zeros(0, bool) if flags is None else (flags.numpy() & KINEMATIC) != 0


@dataclass(frozen=True)
class EqualWorlds:
    """Magnets of a model as copies of some of them, one after the other."""

    magnets: list[BodyMagnet]  # those of the first copy: of one world, or of all worlds
    copies: int
    body_step: int  # difference between the body of a magnet and that in the copy before; static magnets stay at -1
    shape_step: int  # the same for shapes

    @property
    def world_step(self) -> int:
        """Number of worlds of a copy."""
        return self.magnets[-1].world + 1

    def of_magnets(self, values, step: int = 0) -> np.ndarray:
        """Return the values of all magnets from those of a copy; values of -1 are the same in all copies."""
        values = np.asarray(values)
        return np.where(np.tile(values, self.copies) < 0, -1, repeat_rows(values, self.copies, step))

    def bodies(self) -> np.ndarray:
        """Return the body of each magnet, -1 for a static one."""
        return self.of_magnets([magnet.body for magnet in self.magnets], self.body_step)

    def world_numbers(self) -> np.ndarray:
        """Return the world of each magnet."""
        return self.of_magnets([magnet.world for magnet in self.magnets], self.world_step)


def equal_worlds(model: newton.Model, magnets: list[BodyMagnet]) -> EqualWorlds:
    """Return the magnets of the first world, of which all other worlds are copies, or else all magnets as one copy."""
    different = EqualWorlds(magnets, 1, 0, 0)
    copies = magnets[-1].world + 1
    count = len(magnets) // copies
    shapes = np.array([shape for magnet in magnets for shape in magnet.shapes])
    if copies == 1 or count * copies != len(magnets) or len(shapes) % copies:
        return different
    kinds = [(id(magnet.lattice), id(magnet.magnet), len(magnet.shapes)) for magnet in magnets]
    places = np.array([(magnet.world, magnet.body) for magnet in magnets]).reshape(copies, count, 2)
    kinds, shapes, bodies = np.reshape(kinds, (copies, -1)), shapes.reshape(copies, -1), places[..., 1]
    moves = np.append(~kinematic_bodies(model), False)[bodies]  # a static magnet has the body -1
    on_bodies = bodies[0] >= 0
    body_step = int(np.max(bodies[1, on_bodies] - bodies[0, on_bodies], initial=0))
    shape_step, copy = int(shapes[1, 0] - shapes[0, 0]), np.arange(copies)[:, None]
    expected_bodies = np.where(on_bodies, bodies[0] + copy * body_step, -1)
    is_equal = (
        (kinds == kinds[0]).all() and (moves == moves[0]).all() and (places[..., 0] == copy).all()
        and (bodies == expected_bodies).all() and (shapes == shapes[0] + copy * shape_step).all()
    )  # fmt: skip
    if not is_equal:
        return different
    return EqualWorlds(magnets[:count], copies, body_step, shape_step)
