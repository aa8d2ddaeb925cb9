"""A bar magnet on a rotating arm drags a chain of magnetic balls over a table.

Only magnetism holds the chain together. The motor works against the friction under the balls.

Runs: ``python -m warpmag.examples chain``
"""

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

RADIUS, DENSITY, FRICTION = 0.005, 7500.0, 0.2  # m, kg/m³
ARM, HALF_LENGTH = 0.06, 0.01  # m
SPEED, GAIN = 2.0, 1e-2  # rad/s, N·m·s


class Example:
    """An arm with a bar magnet and the balls behind it."""

    def __init__(self, viewer, args):
        """Build the scene."""
        builder = newton.ModelBuilder()
        warpmag.register_custom_attributes(builder)
        rough = newton.ModelBuilder.ShapeConfig(mu=2.0 * FRICTION, mu_rolling=0.0, mu_torsional=0.0)
        smooth = newton.ModelBuilder.ShapeConfig(density=DENSITY, mu=0.0, mu_rolling=0.0, mu_torsional=0.0)
        builder.add_ground_plane(cfg=rough)  # Newton takes the mean of two shapes: only the table has friction
        rotor = builder.add_link()
        bar = wp.transform((ARM, 0.0, RADIUS), wp.quat_identity())
        builder.add_shape_box(rotor, xform=bar, hx=RADIUS, hy=HALF_LENGTH, hz=0.9 * RADIUS, cfg=smooth)
        warpmag.add_permanent(builder, body=rotor, magnetization=(0.0, 2e5, 0.0))
        motor = builder.add_joint_revolute(
            -1, rotor, axis=(0.0, 0.0, 1.0), target_qd=SPEED, target_kd=GAIN,
            actuator_mode=newton.JointTargetMode.VELOCITY,
        )  # fmt: skip
        builder.add_articulation([motor])
        for number in range(args.balls):
            distance = HALF_LENGTH + (2 * number + 1) * 1.001 * RADIUS
            ball = builder.add_body(xform=wp.transform((ARM, -distance, RADIUS), wp.quat_identity()))
            builder.add_shape_sphere(ball, radius=RADIUS, cfg=smooth)
            warpmag.add_permanent(builder, body=ball, magnetization=(0.0, 2e5, 0.0))

        self.simulation = warpmag.Simulation(builder, dt=1e-3)
        self.display = warpmag.Display(viewer, self.simulation.model, self.simulation.magnetics)
        self.sim_time = 0.0
        self.viewer = viewer
        self.torques = []

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=150)
        parser.add_argument("--balls", type=int, default=8, help="Balls in the chain.")
        return parser

    def step(self):
        """Advance by a frame of 20 ms."""
        for _ in range(20):
            self.simulation.step()
        self.sim_time = self.simulation.time
        speed = self.simulation.state.body_qd.numpy()[0, 5]
        self.torques.append((GAIN * (SPEED - speed), self.friction_torque()))

    def render(self):
        """Show the chain."""
        self.display.show(self.sim_time, self.simulation.state)

    def friction_torque(self) -> float:
        """Return the torque of Coulomb friction, opposite to slip velocities, under all balls about the axis [N·m]."""
        state, weights = self.simulation.state, 9.81 * self.simulation.model.body_mass.numpy()[1:]
        x, velocities = state.body_q.numpy()[1:, :2].astype(float), state.body_qd.numpy()[1:].astype(float)
        slip = velocities[:, :2] + RADIUS * np.stack([-velocities[:, 4], velocities[:, 3]], axis=1)
        slip /= np.linalg.norm(slip, axis=1, keepdims=True)
        return float(FRICTION * weights @ (x[:, 0] * slip[:, 1] - x[:, 1] * slip[:, 0]))

    def mean_torques(self) -> tuple[float, float]:
        """Return the torques of the motor and of friction [N·m], means over the second half of the run."""
        motor, friction = np.mean(self.torques[len(self.torques) // 2 :], axis=0)
        return float(motor), float(friction)

    def test_final(self):
        """Check that the chain holds, points head to tail, and that friction alone balances the motor."""
        poses = self.simulation.state.body_q.numpy()[1:].astype(float)
        links = np.diff(poses[:, :3], axis=0)
        np.testing.assert_allclose(np.linalg.norm(links, axis=1), 2.0 * RADIUS, rtol=0.02)
        moments = self.simulation.magnetics.shape_moments()[1:]
        moments /= np.linalg.norm(moments, axis=1, keepdims=True)
        cosines = -np.sum(moments[:-1] * links, axis=1) / np.linalg.norm(links, axis=1)
        assert cosines.min() > 0.9, f"a ball of the chain points across it, {cosines}"
        motor, friction = self.mean_torques()
        np.testing.assert_allclose(motor, friction, rtol=0.2)  # the balls swing and touch each other

    def summary(self) -> str:
        """Return the result in one line."""
        motor, friction = (1e3 * torque for torque in self.mean_torques())
        return f"the motor turns with {motor:.3g} mN·m, against {friction:.3g} mN·m of friction under the chain"


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
