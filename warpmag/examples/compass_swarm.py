"""Compass needles in oil follow a rotating field, or slip behind it when it turns too fast.

The torques of field and oil balance: c dα/dt = μ0 m H sin(ωt - α). A needle lags by the angle arcsin(ω/ωc) as long as
ω < ωc = μ0 m H/c. In faster fields it slips, with a mean speed of ω - √(ω² - ωc²) (Adler's equation). Each row of the
swarm has one H, which grows from row to row.

Runs: ``python -m warpmag.examples compass_swarm``
"""

import math

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

MU0 = 4e-7 * math.pi  # T·m/A
EXTENT = (0.01, 0.0015, 0.001)  # m, half extents of a needle
MAGNETIZATION = 8e5  # A/m
PITCH = 0.3  # m, so far that needles do not act on each other
SPEED = 16.0 * math.pi  # rad/s
MOMENT = MAGNETIZATION * 8.0 * math.prod(EXTENT)  # A·m²


class Example:
    """Rows of needles; each row is a world with its own field."""

    def __init__(self, viewer, args):
        """Build the scene."""
        row = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        warpmag.register_custom_attributes(row)
        self.fields = np.linspace(500.0, 2000.0, args.rows)  # A/m
        self.damping = MU0 * MOMENT * 1000.0 / SPEED  # N·m·s: needles begin to slip in 1000 A/m
        for column in range(args.columns):
            pose = wp.transform((column * PITCH, 0.0, 0.0), wp.quat_identity())
            needle = row.add_link(xform=pose)
            row.add_shape_box(needle, hx=EXTENT[0], hy=EXTENT[1], hz=EXTENT[2])
            # one moment is enough for needles so far away; the default would be 252
            warpmag.add_permanent(
                row, body=needle, magnetization=(MAGNETIZATION, 0.0, 0.0), moment_spacing=2.0 * EXTENT[0]
            )
            hinge = row.add_joint_revolute(
                -1, needle, parent_xform=pose, axis=(0.0, 0.0, 1.0), target_kd=self.damping,
                actuator_mode=newton.JointTargetMode.VELOCITY,
            )  # fmt: skip
            row.add_articulation([hinge])
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.replicate(row, args.rows)

        self.simulation = warpmag.Simulation(builder, dt=5e-4)
        self.magnetics = self.simulation.magnetics
        self.display = warpmag.Display(viewer, self.simulation.model, self.magnetics)
        self.sim_time = 0.0
        self.viewer = viewer
        self.angles = [self.angle()]

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=200)
        parser.add_argument("--rows", type=int, default=10, help="Rows of needles.")
        parser.add_argument("--columns", type=int, default=10, help="Needles in a row.")
        return parser

    def field_angle(self) -> float:
        """Return the angle of the field [rad]."""
        return SPEED * self.sim_time

    def step(self):
        """Advance by a frame of 5 ms."""
        for _ in range(10):
            angle = self.field_angle()
            direction = np.array((math.cos(angle), math.sin(angle), 0.0))
            self.magnetics.set_external_field(self.fields[:, None] * direction)
            self.simulation.step()
            self.sim_time = self.simulation.time
        self.angles.append(self.angle())

    def render(self):
        """Show the needles."""
        self.display.show(self.sim_time, self.simulation.state)

    def angle(self) -> np.ndarray:
        """Return the angle of each needle [rad], modulo 2π, shape [rows, columns]."""
        q = self.simulation.state.body_q.numpy().astype(float)
        return (2.0 * np.arctan2(q[:, 5], q[:, 6])).reshape(len(self.fields), -1)

    def lags_and_speeds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the final lag behind the field [rad] and mean speed [rad/s] of the first needle of each row."""
        times = np.linspace(0.0, self.sim_time, len(self.angles))
        lags = np.unwrap(SPEED * times[:, None] - np.array(self.angles)[:, :, 0], axis=0)
        slips = []
        for lag in lags.T:
            ends = np.flatnonzero(np.diff(np.floor(lag / (2.0 * math.pi))))
            slips.append(np.polyfit(times[ends], np.arange(len(ends)), 1)[0] if len(ends) > 1 else 0.0)
        return np.remainder(lags[-1] + math.pi, 2.0 * math.pi) - math.pi, SPEED - 2.0 * math.pi * np.array(slips)

    def test_final(self):
        """Check the lag of rows in strong fields and the speed of slipping rows against Adler's equation."""
        critical = MU0 * MOMENT * self.fields / self.damping
        lags, speeds = self.lags_and_speeds()
        locked = critical > 1.05 * SPEED
        np.testing.assert_allclose(lags[locked], np.arcsin(SPEED / critical[locked]), atol=0.02)
        np.testing.assert_array_equal(speeds[locked], SPEED)
        slipping = critical < 0.8 * SPEED
        expected = SPEED - np.sqrt(SPEED**2 - critical[slipping] ** 2)
        np.testing.assert_allclose(speeds[slipping], expected, atol=0.05 * SPEED)  # slips are resolved by frames
        order = np.abs(np.exp(1j * np.array(self.angles[-1])).mean(axis=1))
        assert order.min() > 0.999, f"needles of one row point apart, order {order.min():g}"

    def summary(self) -> str:
        """Return the result in one line."""
        lags, speeds = self.lags_and_speeds()
        follows = speeds > 0.9 * SPEED
        angles = ", ".join(f"{angle:.1f}" for angle in np.degrees(lags[follows]))
        ratios = ", ".join(f"{ratio:.2f}" for ratio in speeds[~follows] / SPEED)
        locked = [f"{follows.sum()} rows follow the field, {angles} degrees behind it"] if angles else []
        slipping = [f"{(~follows).sum()} slip and turn at {ratios} of its speed"] if ratios else []
        return ", ".join([*locked, *slipping])


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
