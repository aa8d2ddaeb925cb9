"""A sweep over 1,024 worlds with different currents determines the current at which a ball jumps to a coil.

The force on an iron ball of volume V on the axis of a solenoid is 3 μ0 V H dH/dz. It exceeds the weight above a
threshold current, and the worlds bracket this current in one run.

Runs: ``python -m warpmag.examples worlds``
"""

import math

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

MU0 = 4e-7 * math.pi  # T·m/A
RADIUS, DENSITY, GRAVITY = 0.005, 7870.0, 9.81  # m, kg/m³, m/s²
COIL_RADIUS, COIL_LENGTH, COIL_HEIGHT = 0.015, 0.01, 0.02  # m


def axis_field(z: float) -> float:
    """Return the field of the solenoid on its axis at z from its middle, per ampere [1/m]."""
    ends = z + 0.5 * COIL_LENGTH, z - 0.5 * COIL_LENGTH
    return (ends[0] / math.hypot(ends[0], COIL_RADIUS) - ends[1] / math.hypot(ends[1], COIL_RADIUS)) / (2 * COIL_LENGTH)


def lifting_current() -> float:
    """Return the ampere-turns above which the ball jumps from the ground [A]."""
    below, step = RADIUS - COIL_HEIGHT, 1e-6
    slope = (axis_field(below + step) - axis_field(below - step)) / (2 * step)
    return math.sqrt(DENSITY * GRAVITY / (3.0 * MU0 * axis_field(below) * slope))


class Example:
    """Worlds with a ball, a coil above it and a plate that catches the ball."""

    def __init__(self, viewer, args):
        """Build the scene."""
        world = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
        warpmag.register_custom_attributes(world)
        iron = newton.ModelBuilder.ShapeConfig(density=DENSITY)
        ball = world.add_body(xform=wp.transform((0.0, 0.0, RADIUS), wp.quat_identity()))
        world.add_shape_sphere(ball, radius=RADIUS, cfg=iron)
        warpmag.add_inducible(world, body=ball)
        above = wp.transform((0.0, 0.0, COIL_HEIGHT), wp.quat_identity())
        warpmag.add_coil(world, shape="solenoid", radius=COIL_RADIUS, length=COIL_LENGTH, xform=above, label="coil")
        plate = wp.transform((0.0, 0.0, 0.0145), wp.quat_identity())
        world.add_shape_box(-1, xform=plate, hx=0.015, hy=0.015, hz=0.0005)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -GRAVITY))
        builder.replicate(world, args.world_count)
        builder.add_ground_plane()

        self.simulation = warpmag.Simulation(builder, dt=1e-3)
        self.currents = lifting_current() * np.linspace(0.9, 1.1, args.world_count)
        self.simulation.magnetics.set_current("coil", self.currents)
        self.display = warpmag.Display(viewer, self.simulation.model, self.simulation.magnetics)
        self.sim_time = 0.0
        self.viewer = viewer

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=20)
        parser.add_argument("--world-count", type=int, default=1024, help="Number of worlds.")
        return parser

    def step(self):
        """Advance by a frame of 20 ms."""
        for _ in range(20):
            self.simulation.step()
        self.sim_time = self.simulation.time

    def render(self):
        """Show all worlds side by side."""
        self.display.show(self.sim_time, self.simulation.state)

    def lifted(self) -> np.ndarray:
        """Return True for each world whose ball hangs at the plate, shape [worlds]."""
        return self.simulation.state.body_q.numpy()[:, 2] > 0.0085

    def test_final(self):
        """Check that balls jump above the current of the closed form only; the compliance of contacts costs 0.3 %."""
        current, lifted = lifting_current(), self.lifted()
        assert lifted[self.currents > 1.003 * current].all()
        assert not lifted[self.currents < 0.997 * current].any()

    def summary(self) -> str:
        """Return the result in one line."""
        least = self.currents[self.lifted()].min(initial=math.inf)
        return (
            f"{self.lifted().sum()} of {len(self.currents)} balls jumped, from {least:.1f} ampere-turns on; "
            f"the closed form is {lifting_current():.1f}"
        )


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
