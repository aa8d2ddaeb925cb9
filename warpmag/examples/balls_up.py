"""Iron balls jump to a magnet above them, in a scene built with the Python API.

Kim and Han 2022, Fig. 3; ``warpmag run balls_up`` reads the same scene from a stage. There is no friction, so only
impacts dissipate energy.

Runs: ``python -m warpmag.examples balls_up``
"""

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

RADIUS = 0.005  # m
MAGNET = 0.04  # m, edge
HEIGHT = 0.051  # m, of the magnet's center above the ground


class Example:
    """243 balls in three layers, or fewer."""

    def __init__(self, viewer, args):
        """Build the scene."""
        builder = newton.ModelBuilder()
        warpmag.register_custom_attributes(builder)
        iron = newton.ModelBuilder.ShapeConfig(density=7870.0, mu=0.0)
        builder.add_ground_plane(cfg=iron)
        for x, y, z in np.ndindex(args.columns, args.columns, args.layers):
            center = 2.005 * RADIUS * (np.array((x, y)) - 0.5 * (args.columns - 1))
            ball = builder.add_body(xform=wp.transform((*center, (2.005 * z + 1.0) * RADIUS), wp.quat_identity()))
            builder.add_shape_sphere(ball, radius=RADIUS, cfg=iron)
            warpmag.add_inducible(builder, body=ball, saturation=1.7e6)
        above = wp.transform((0.0, 0.0, HEIGHT), wp.quat_identity())
        half = 0.5 * MAGNET
        cube = builder.add_shape_box(-1, xform=above, hx=half, hy=half, hz=half, cfg=iron)
        warpmag.add_permanent(builder, shape=cube, magnetization=(0.0, 0.0, 1e6))

        self.simulation = warpmag.Simulation(builder, dt=1e-3)
        self.display = warpmag.Display(viewer, self.simulation.model, self.simulation.magnetics)
        self.sim_time = 0.0
        self.viewer = viewer
        self.energies = [self.energy()]

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=100)
        parser.add_argument("--columns", type=int, default=9, help="Balls along x and along y.")
        parser.add_argument("--layers", type=int, default=3, help="Balls along z.")
        return parser

    def step(self):
        """Advance by a frame of 20 ms."""
        for _ in range(20):
            self.simulation.step()
        self.sim_time = self.simulation.time
        self.energies.append(self.energy())

    def render(self):
        """Show the balls."""
        self.display.show(self.sim_time, self.simulation.state)

    def energy(self) -> float:
        """Return the magnetic, kinetic and potential energy of all balls [J]."""
        state, masses = self.simulation.state, self.simulation.model.body_mass.numpy()
        speeds = np.linalg.norm(state.body_qd.numpy()[:, :3], axis=1)
        mechanical = masses @ (0.5 * speeds**2 + 9.81 * state.body_q.numpy()[:, 2])
        self.simulation.magnetics.induce(state)
        return float(mechanical + self.simulation.magnetics.energy()[0])

    def test_final(self):
        """Check that energy falls and rises in no frame, balls do not overlap, and some hang at the magnet."""
        gained, lost = max(np.diff(self.energies)), self.energies[0] - self.energies[-1]
        assert lost > 0.0 and gained < 0.01 * lost, f"energy rose by {gained:g} J in a frame, of {lost:g} J lost"
        figures = self.simulation.finish()
        assert figures.held > 0 and figures.final_overlap < 0.05

    def summary(self) -> str:
        """Return the result in one line."""
        figures = self.simulation.finish()
        lost = self.energies[0] - self.energies[-1]
        return f"{figures.held} of {figures.magnets} balls hang at the magnet, impacts took {lost:.3g} J"


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
