"""Two floating connectors with permanent magnets attract each other and mate.

Each has a north and a south pole in its face. They therefore mate in one orientation only, and the twisted connector
turns. No other forces act, so momentum is conserved.

Runs: ``python -m warpmag.examples connectors``
"""

import math
from typing import Any

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

HALF = (0.006, 0.012, 0.008)  # m, of a housing
POLE = 0.003  # m, half the edge of a magnet
GAP = 0.02  # m, between the faces at the start


class Example:
    """Two connectors; the second is shifted, tilted and twisted."""

    def __init__(self, viewer, args):
        """Build the scene."""
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        warpmag.register_custom_attributes(builder)
        twist = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), math.radians(args.twist))
        yaw = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), math.radians(15.0))
        self.add_connector(builder, wp.transform_identity(), face=1.0)
        self.add_connector(builder, wp.transform((2 * HALF[0] + GAP, 0.003, 0.002), wp.mul(yaw, twist)), face=-1.0)

        self.simulation = warpmag.Simulation(builder, dt=1e-3)
        self.display = warpmag.Display(viewer, self.simulation.model, self.simulation.magnetics)
        self.sim_time = 0.0
        self.viewer = viewer

    @staticmethod
    def add_connector(builder, pose, face):
        """Add a housing with two opposite magnets in its face."""
        body = builder.add_body(xform=pose)
        plastic = newton.ModelBuilder.ShapeConfig(density=1200.0, mu=0.02, mu_torsional=0.0)
        builder.add_shape_box(body, hx=HALF[0], hy=HALF[1], hz=HALF[2], cfg=plastic)
        for side in (1.0, -1.0):
            pole = wp.transform((face * (HALF[0] - POLE), side * 0.007, 0.0), wp.quat_identity())
            # the density of the plastic in the same place is added
            heavy = newton.ModelBuilder.ShapeConfig(density=6300.0, mu=0.02, mu_torsional=0.0)
            shape = builder.add_shape_box(body, xform=pole, hx=POLE, hy=POLE, hz=POLE, cfg=heavy)
            warpmag.add_permanent(builder, shape=shape, material="N42", direction=(side, 0.0, 0.0))

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=60)
        text = "Twist of the second connector about its axis [°]."
        parser.add_argument("--twist", type=float, default=40.0, help=text)
        return parser

    def step(self):
        """Advance by a frame of 10 ms."""
        for _ in range(10):
            self.simulation.step()
        self.sim_time = self.simulation.time

    def render(self):
        """Show the connectors."""
        self.display.show(self.sim_time, self.simulation.state)

    def mating(self) -> tuple[np.ndarray, float]:
        """Return the position of the second connector in the frame of the first [m], and its rotation [rad]."""
        first, second = (wp.transform(*pose) for pose in self.simulation.state.body_q.numpy())
        relative: Any = wp.transform_multiply(wp.transform_inverse(first), second)
        return np.array(relative.p), 2.0 * math.acos(min(1.0, abs(relative.q[3])))

    def test_final(self):
        """Check that the connectors are mated, and that their total momentum is still zero.

        Momentum is conserved to rounding. Contact impulses are bitwise opposite. Forces are sums over 500 moments,
        each rounded to float32. Their root sum of squares is ten times the resultant, so the relative error is
        10 · 6e-8. At rest this error repeats, so momentum grows in proportion to the impulse that the connectors
        exchange. The tolerance is three such standard deviations.
        """
        position, angle = self.mating()
        np.testing.assert_allclose(position, (2 * HALF[0], 0.0, 0.0), atol=1e-4)
        assert angle < math.radians(1.0)
        masses, speeds = self.simulation.model.body_mass.numpy(), self.simulation.state.body_qd.numpy()
        state = self.simulation.state
        state.clear_forces()
        self.simulation.magnetics.apply(state)
        impulse = np.linalg.norm(state.body_f.numpy()[0, :3]) * self.sim_time
        assert np.linalg.norm(masses @ speeds[:, :3]) < 2e-6 * impulse

    def summary(self) -> str:
        """Return the result in one line."""
        position, angle = self.mating()
        error = 1e3 * np.linalg.norm(position - np.array((2 * HALF[0], 0.0, 0.0)))
        return f"mated within {error:.2g} mm and {math.degrees(angle):.2g} degrees"


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
