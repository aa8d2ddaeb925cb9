"""Bodies of cells in a system of moments, and their corrections of the field and of the forces."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpmag.kernels.applied.fields import AppliedForces
from warpmag.kernels.applied.near_cells import FACE_SPLIT, NearCellBody
from warpmag.kernels.cells.cell_pairs import CellPairs
from warpmag.kernels.cells.couplings import CellCouplings
from warpmag.moments.arrays import PersistentArray
from warpmag.moments.layout import MomentLayout
from warpmag.shapes.demagnetization import Coupling, couplings_in_worlds
from warpmag.shapes.face_charges import face_response


class SystemCells:
    """Corrections between the cells of a body, and between cells of different bodies, in the arrays of a system.

    Args:
        layout: Worlds and bodies of the moments.
        couplings: First moment and coupling of each body in one copy of the worlds.
        closed_forms: First moments of bodies whose near field has a closed form, in place of corrections.
        rotatable: Nonzero for moments whose torque is evaluated, Warp array, shape [n].
        packed: All moments, packed (``kernels.pairs.packing.PackedMoments``).
        moments: Moments [A·m²], Warp array, shape [n].
        h: Field to add to [A/m], Warp array, shape [n].
        forces, torques: Forces [N] and torques [N·m] to add to, Warp arrays, shape [n].

    Attributes:
        bodies: First moment of each body of all copies, and its coupling among the other bodies of its world.
        couplings: Corrections within the bodies.
        pairs: Corrections between different bodies; None where no world has several.
        rotations: Rotation of each body from its frame to the world's (x, y, z, w), shape [bodies]; the caller writes
            it.
    """

    def __init__(
        self, layout: MomentLayout, couplings: Sequence[tuple[int, Coupling]], closed_forms: set[int], *,
        rotatable, packed, moments, h, forces, torques,
    ):  # fmt: skip
        """Lay out the tables on the device of the moments."""
        firsts = [first for first, _ in couplings]
        worlds, copies = layout.worlds[firsts], range(layout.copies)
        self._takes_part = [coupling.near and first not in closed_forms for first, coupling in couplings]
        ball_worlds = set(layout.worlds[layout.single_balls & ~layout.permanent].tolist())
        iron = [first not in closed_forms for first in firsts]
        among = couplings_in_worlds([coupling for _, coupling in couplings], worlds.tolist(), iron, ball_worlds)
        step = len(layout.radii)
        bodies = list(zip(firsts, among, strict=True))
        self.bodies = [(first + step * copy, coupling) for copy in copies for first, coupling in bodies]
        parts = np.bincount(worlds, self._takes_part, layout.world_count)
        paired = bool(parts.max() > 1) or bool(parts[layout.worlds[layout.single_balls]].any())
        self.couplings, self.pairs = CellCouplings(self.bodies, moments, h, paired=paired), None
        self.rotations = self.couplings.rotations
        if paired:
            takes_part = self._takes_part * layout.copies
            arrays = rotatable, packed, h, forces, torques
            self.pairs = CellPairs(self.bodies, takes_part, self.couplings, layout.whole(), *arrays)
        self._of_one_copy, self._wrenches = bodies, (forces, torques)

    @property
    def crowded(self) -> wp.array | None:
        """1 if some cells have too many near cells; such cells act as balls or uniform boxes, shape [1]."""
        return None if self.pairs is None else self.pairs.crowded

    def average_sources(self, sources: AppliedForces):
        """Average the fields of permanent bodies over the cells near them."""
        bodies: list[NearCellBody | None] = [None] * len(self._of_one_copy)
        for number, (first, coupling) in enumerate(self._of_one_copy):
            if self._takes_part[number]:
                response = face_response(tuple(coupling.cell_sides), tuple(coupling.grid_extents), FACE_SPLIT)
                bodies[number] = NearCellBody(first, coupling, response)
        if any(bodies):
            sources.include_cells(bodies, self.rotations, *self._wrenches)

    def request_search(self, chosen):
        """Rebuild the lists of near cells in the next solve if any entry of ``chosen`` is not 0."""
        if self.pairs is not None:
            self.pairs.request_search(chosen)

    def persistent_arrays(self) -> dict[str, PersistentArray]:
        """Return the arrays that one solve passes to the next, by name."""
        return {} if self.pairs is None else self.pairs.persistent_arrays()

    def find_pairs(self):
        """Launch the search for near cells of different bodies."""
        if self.pairs is not None:
            self.pairs.find()

    def add_field(self):
        """Launch the corrections of the field."""
        if self.pairs is not None:
            self.pairs.add_field()
        self.couplings.launch()

    def add_forces(self):
        """Launch the corrections of forces and torques."""
        if self.pairs is not None:
            self.pairs.add_forces()
