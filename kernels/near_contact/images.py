"""Mirror images of balls in flat faces of iron.

A flat face of iron of high permeability is a mirror: a ball near it interacts with its image, a ball of the mirrored
multipoles with charges of the opposite sign. A dipole m becomes 2 (n·m) n − m, with the normal n. The cells of the iron
respond to the ball's moment only. So the image takes part in the near-contact model as a near ball of its own ball. It
adds the higher multipoles and the flux through a contact. Its energy is half that of two balls.

* **Faces** are flat and convex. The weight of an image is a product over the edges of the face. It rises from 0 to 1 as
  the point below the ball moves from the edge to a distance of ``EDGE``. Its gradient is a force along the face.
* **Permeability.** Sources of an image are scaled by (μ − 1)/(μ + 1). μ is the differential permeability of the cells,
  averaged around the point below the ball, so that images fade as the iron saturates.
* **Reaction.** The iron feels the opposite force, at the ball's center, and the opposite torque. So forces and torques
  of ball and body balance.

Images have no images. A ball has at most ``IMAGES`` of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpmag.kernels.pairs.pair_law import INVERSE_4PI
from warpmag.kernels.pairs.wrench import MU0

IMAGES = 3  # largest number of images of a ball
EDGE = 0.3  # distance from an edge of a face [radii of the ball] at which an image has its full weight
DEEPEST_CENTER = 0.3  # height of a ball's center over a face [radii] below which it has no image
VIEW_ROWS = 8  # numbers of an image's view; as in ``images.h``


@dataclass(frozen=True)
class IronFaces:
    """Flat faces of an iron body of cells, in the frame of the body."""

    number: int  # index among the bodies of cells
    first: int  # first cell
    count: int  # number of cells
    world: int
    origin: np.ndarray  # position of the first cell [m], shape [3]
    planes: np.ndarray  # outward unit normal n and n·x on the face [m], shape [f, 4]
    edges: tuple[np.ndarray, ...]  # of each face: outward unit normals in its plane and their offsets [m], shape [e, 4]


def image_constants(images: bool) -> dict[str, int | float]:
    """Return the constants of ``images.h``; ``images`` is True if balls have images."""
    return dict(IMAGES=IMAGES if images else 0, EDGE=EDGE, DEEPEST_CENTER=DEEPEST_CENTER, VIEW_ROWS=VIEW_ROWS)


@cache
def face_arrays(dtype) -> Any:
    """Return the struct of the arrays of f faces, e edges and b bodies."""
    quaternion = wp.types.quaternion(dtype)

    @wp.struct
    class FaceArrays:
        begin: wp.array[wp.int32]  # first face in the world of a ball [balls]
        end: wp.array[wp.int32]  # index after the last one [balls]
        face: wp.array2d[wp.int32]  # body with faces, first edge and index after the last one [f, 3]
        cells: wp.array2d[wp.int32]  # body of cells, its first cell and index after the last one [b, 3]
        plane: wp.array2d[dtype]  # outward normal and offset [f, 4]
        edge: wp.array2d[dtype]  # outward normals of edges in their plane, and offsets [e, 4]
        origin: wp.array2d[dtype]  # position of a body's first cell in its frame [b, 3]
        rotation: wp.array[quaternion]  # from the frame of each body of cells to the world
        slope: wp.array[dtype]  # slopes k of the moments' curves [n]
        inverse_saturation: wp.array[dtype]  # 1/(V Ms) of the moments [1/(A·m²)] [n]
        curve: wp.array[wp.int32]  # ids of the curves [n]
        # Work:
        image_face: wp.array2d[wp.int32]  # face of an image, −1 for none [IMAGES, balls]
        view: wp.array3d[dtype]  # normal, weight, its gradient, and response of the iron [IMAGES, balls, 8]
        wrench: wp.array3d[dtype]  # force and torque of an image on its ball, over μ0/4π [IMAGES, balls, 6]

    return FaceArrays


def allocate(balls: int, faces: Sequence[IronFaces], rotations, worlds, radii, material, *, dtype, device) -> Any:
    """Return the arrays; empty ones without faces. ``balls`` is the number of moments, padded to ``CHUNK``."""
    a = face_arrays(dtype)()
    if not faces:
        return a

    def put(values, kind=dtype):
        return wp.array(np.ascontiguousarray(values), dtype=kind, device=device)

    counts = [len(body.planes) for body in faces]
    edges = [len(rows) for body in faces for rows in body.edges]
    ends = np.cumsum(edges)
    body = np.repeat(np.arange(len(faces)), counts)
    world = np.repeat([body.world for body in faces], counts)
    padded = np.pad(worlds, (0, balls - len(worlds)), constant_values=-1)
    a.begin, a.end = (put(np.searchsorted(world, padded, side=side), wp.int32) for side in ("left", "right"))
    a.face = put(np.stack([body, ends - edges, ends], axis=1), wp.int32)
    a.cells = put([(body.number, body.first, body.first + body.count) for body in faces], wp.int32)
    a.plane, a.origin = put(np.concatenate([body.planes for body in faces])), put([body.origin for body in faces])
    a.edge = put(np.concatenate([rows for body in faces for rows in body.edges]))
    saturated = 4.0 / 3.0 * np.pi * np.where(radii > 0.0, radii, 1.0).astype(float) ** 3 * material.saturation.numpy()
    a.rotation, a.slope, a.curve = rotations, material.slope, material.curve
    a.inverse_saturation = put(1.0 / saturated)
    a.image_face = put(np.full((IMAGES, balls), -1), wp.int32)
    a.view = wp.zeros((IMAGES, balls, VIEW_ROWS), dtype=dtype, device=device)
    a.wrench = wp.zeros((IMAGES, balls, 6), dtype=dtype, device=device)
    return a


@cache
def _reaction_kernel(dtype):
    vec3 = wp.types.vector(3, dtype)

    @wp.func
    def row3(rows: wp.array2d[dtype], first: int, i: int):
        return vec3(rows[first, i], rows[first + 1, i], rows[first + 2, i])

    @wp.kernel(module="unique", enable_backward=False)
    def add_reactions(
        faces: face_arrays(dtype),
        ranges: wp.array2d[int],
        packed: wp.array2d[dtype],
        unit: dtype,
        forces: wp.array[vec3],
        torques: wp.array[vec3],
    ):
        row = wp.tid()
        body = ranges[row, 0]
        first = faces.cells[body, 1]
        x, force, torque = row3(packed, 0, first), vec3(), vec3()
        for ball in range(ranges[row, 1], ranges[row, 2]):
            for k in range(IMAGES):
                f = faces.image_face[k, ball]
                if f >= 0:
                    if faces.face[f, 0] == body:
                        w = faces.wrench
                        push = vec3(w[k, ball, 0], w[k, ball, 1], w[k, ball, 2])
                        turn = vec3(w[k, ball, 3], w[k, ball, 4], w[k, ball, 5])
                        force -= push
                        torque -= turn + wp.cross(row3(packed, 0, ball) - x, push)
        forces[first] += unit * force
        torques[first] += unit * torque

    return add_reactions


class ImageReactions:
    """Launch of the reactions on iron bodies, whose first cells feel them.

    Args:
        faces: Arrays of the faces (:func:`face_arrays`).
        ranges: Index of each movable body, first moment of its world and index after the last one, shape [bodies, 3].
        packed: All moments, packed (``pairs.packing``).
        forces, torques: Forces [N] and torques [N·m] to add to, Warp arrays, shape [n].
    """

    def __init__(self, faces, ranges, packed, forces, torques):
        """Record the launch."""
        dtype, device = packed.dtype, packed.device
        ranges = wp.array(np.reshape(ranges, (-1, 3)).astype(np.int32), dtype=wp.int32, device=device)
        inputs = [faces, ranges, packed.packed, dtype(MU0 * INVERSE_4PI), forces, torques]
        self._launch = wp.launch(
            _reaction_kernel(dtype), dim=ranges.shape[0], inputs=inputs, device=device, record_cmd=True
        )

    def add(self):
        """Add the reactions to the forces and torques of the bodies' first cells."""
        if self._launch is not None:  # Warp records none if no body moves
            self._launch.launch()
