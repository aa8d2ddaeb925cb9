"""Coils switched one after another lift steel balls out of a tray, carry them along, and drop them.

Brass balls stay in place. A coil lifts a steel ball if its current exceeds a threshold, here 1,180 ampere-turns. The
example ``worlds`` has a closed form of the threshold.

Runs: ``python -m warpmag.examples sorter``
"""

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

RADIUS = 0.005  # m, of the balls
PITCH = 0.022  # m, between coils
CEILING, COIL_HEIGHT = 0.014, 0.02  # m, of the plate along which carried balls slide, and of the coils
AMPERE_TURNS = 3000.0
HOLD = 0.2  # s, from one coil to the next


class Example:
    """A row of coils above a plate, and balls of steel and of brass below the first coil."""

    def __init__(self, viewer, args):
        """Build the scene."""
        builder = newton.ModelBuilder()
        warpmag.register_custom_attributes(builder)
        builder.add_ground_plane()
        plate = wp.transform((0.5 * (args.coils - 1) * PITCH, 0.0, CEILING + 0.0005), wp.quat_identity())
        slippery = newton.ModelBuilder.ShapeConfig(mu=0.1)
        builder.add_shape_box(-1, xform=plate, hx=0.5 * args.coils * PITCH + 0.02, hy=0.03, hz=0.0005, cfg=slippery)
        for coil in range(args.coils):
            pose = wp.transform((coil * PITCH, 0.0, COIL_HEIGHT), wp.quat_identity())
            warpmag.add_coil(builder, shape="solenoid", radius=0.015, length=0.01, xform=pose, label=f"coil{coil}")
        self.steel, self.brass = [], []
        for number in range(args.balls):
            x, y = 1.2 * RADIUS * np.array((-1.0, 1.0))[[number % 2, number // 2 % 2]]
            pose = wp.transform((x - 4.8 * RADIUS * (number // 4), y, RADIUS), wp.quat_identity())
            ball = builder.add_body(xform=pose)
            steel = number % 2 == 1
            metal = newton.ModelBuilder.ShapeConfig(density=7870.0 if steel else 8500.0, mu=0.3, mu_rolling=0.02)
            builder.add_shape_sphere(ball, radius=RADIUS, cfg=metal)
            (self.steel if steel else self.brass).append(ball)
            if steel:
                warpmag.add_inducible(builder, body=ball, material="1010-steel")

        self.simulation = warpmag.Simulation(builder, dt=1e-3)
        self.coils = args.coils
        self.display = warpmag.Display(viewer, self.simulation.model, self.simulation.magnetics)
        self.sim_time = 0.0
        self.viewer, self.start = viewer, self.positions()

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=60)
        parser.add_argument("--coils", type=int, default=4, help="Coils in the row.")
        parser.add_argument("--balls", type=int, default=4, help="Balls in the tray, half of them of steel.")
        return parser

    def step(self):
        """Advance by a frame of 20 ms."""
        active = int(self.sim_time / HOLD)
        for coil in range(self.coils):
            self.simulation.magnetics.set_current(f"coil{coil}", AMPERE_TURNS if coil == active else 0.0)
        for _ in range(20):
            self.simulation.step()
        self.sim_time = self.simulation.time

    def render(self):
        """Show the balls."""
        self.display.show(self.sim_time, self.simulation.state)

    def positions(self) -> np.ndarray:
        """Return the positions of the balls [m], shape [balls, 3]."""
        return self.simulation.state.body_q.numpy()[:, :3].astype(float)

    def test_final(self):
        """Check that all steel lies under the last coil, and all brass in its initial place."""
        positions, last = self.positions(), (self.coils - 1) * PITCH
        assert (np.abs(positions[self.steel, 0] - last) < 0.5 * PITCH).all(), positions[self.steel]
        np.testing.assert_allclose(positions[self.brass], self.start[self.brass], atol=1e-4)
        np.testing.assert_allclose(positions[:, 2], RADIUS, rtol=0.01)  # all balls lie on the ground

    def summary(self) -> str:
        """Return the result in one line."""
        distances = 1e3 * np.linalg.norm(self.positions() - self.start, axis=1)
        return f"steel was carried {distances[self.steel].round(1)} mm, brass {distances[self.brass].round(1)} mm"


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
