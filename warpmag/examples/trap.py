"""An optimizer turns two magnets by gradients until they trap an iron ball in a plane in front of them.

Müller et al. (arXiv 2511.19201, 2025) turn the magnets of an array so that they hold a millirobot in a plane, 89 mm
from two magnets. Spacing and strength of the magnets here are not those of the paper. As in Newton's ``diffsim``
examples each frame is one step of the optimizer, Adam: a tape records the force on the ball, and its gradient by the
poses of the magnets turns them.

Runs: ``python -m warpmag.examples trap``
"""

import math

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

HALF_DISTANCE = 0.065  # m, between the magnets
RADIUS, HALF_LENGTH = 0.018, 0.02  # m, of the magnets
BALL_RADIUS = 0.003  # m
START = np.array([2.4, math.pi - 2.4])  # rad, from the direction toward the ball to each magnet's axis
RATE, DECAY, MEAN, SQUARE = 0.02, 0.98, 0.9, 0.9  # step [rad] of Adam, its decay, and that of its two means
OFFSET = 0.003  # m, at which the trap must push the ball back


class Example:
    """Two magnets side by side, and a ball in front of them."""

    def __init__(self, viewer, args):
        """Build the scene; the magnets are on the x axis, the ball on the y axis."""
        self.center = np.array([0.0, args.distance, 0.0])
        builder = newton.ModelBuilder()
        warpmag.register_custom_attributes(builder)
        for side in (-1.0, 1.0):
            magnet = builder.add_body(xform=wp.transform((side * HALF_DISTANCE, 0.0, 0.0), wp.quat_identity()))
            builder.add_shape_cylinder(magnet, radius=RADIUS, half_height=HALF_LENGTH)
            warpmag.add_permanent(builder, body=magnet, remanence=1.3, direction=(0.0, 0.0, 1.0))
        ball = builder.add_body(xform=wp.transform(self.center, wp.quat_identity()))
        builder.add_shape_sphere(ball, radius=BALL_RADIUS)
        warpmag.add_inducible(builder, body=ball, material="1010-steel")
        model = builder.finalize(requires_grad=True)
        self.magnetics, self.state = warpmag.Magnetics(model, rtol=1e-5), model.state()
        self.angles, self.mean, self.square = START.copy(), np.zeros(2), np.zeros(2)
        self.frame, self.sim_time, self.first_force = 0, 0.0, self.force(self.center)
        self.display, self.viewer = warpmag.Display(viewer, model, self.magnetics), viewer

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=150)
        parser.add_argument("--distance", type=float, default=0.089, help="Distance of the ball [m], 0.06 to 0.12.")
        return parser

    def place(self, ball) -> None:
        """Write the poses of the magnets at their angles, and that of the ball."""
        poses = self.state.body_q.numpy().copy()
        for k, angle in enumerate(self.angles):
            poses[k, 3:] = _rotation(angle)
        poses[2, :3] = ball
        self.state.body_q.assign(poses)

    def force(self, ball) -> np.ndarray:
        """Return the force on the ball [N] at a position."""
        self.place(ball)
        self.state.clear_forces()
        self.magnetics.apply(self.state)
        return self.state.body_f.numpy()[2, :3].astype(float)

    def gradient(self) -> np.ndarray:
        """Return the gradient of the squared force on the ball, over that of the start, by the angles."""
        self.place(self.center)
        self.state.clear_forces()
        with wp.Tape() as tape:
            self.magnetics.apply(self.state)
        seed = np.zeros((3, 6), np.float32)
        seed[2, :3] = 2.0 * self.state.body_f.numpy()[2, :3] / np.sum(self.first_force**2)
        self.state.body_f.grad.assign(seed)
        tape.backward()
        by_rotations = self.state.body_q.grad.numpy()[:2, 3:].astype(float)
        tape.zero()
        return np.sum(by_rotations * [0.5 * _rotation(angle + math.pi) for angle in self.angles], axis=1)

    def step(self):
        """Turn the magnets by one step of Adam, which becomes smaller."""
        gradient, self.frame = self.gradient(), self.frame + 1
        self.mean += (1.0 - MEAN) * (gradient - self.mean)
        self.square += (1.0 - SQUARE) * (gradient**2 - self.square)
        mean, square = self.mean / (1.0 - MEAN**self.frame), self.square / (1.0 - SQUARE**self.frame)
        self.angles -= RATE * DECAY**self.frame * mean / np.maximum(np.sqrt(square), 1e-12)
        self.place(self.center)
        self.sim_time = self.frame / 30.0

    def render(self):
        """Show the magnets."""
        self.display.show(self.sim_time, self.state)

    def test_final(self):
        """Check that the force vanishes at the target, and pushes the ball back in the plane between the magnets."""
        assert np.linalg.norm(self.force(self.center)) < 0.01 * np.linalg.norm(self.first_force)
        across, y, z = (
            (self.force(self.center - offset) - self.force(self.center + offset)) @ offset
            for offset in OFFSET * np.eye(3)
        )
        assert min(y, z) > 0.0 > across, (across, y, z)  # no static field traps iron in all three directions

    def summary(self) -> str:
        """Return the result in one line."""
        share = np.linalg.norm(self.force(self.center)) / np.linalg.norm(self.first_force)
        angles = " and ".join(f"{math.degrees(angle):.1f}°" for angle in self.angles)
        return f"the force fell to {share:.1e} of that at the start, with the magnets at {angles}"


def _rotation(angle: float) -> np.ndarray:
    """Return the quaternion that turns the z axis to an angle from the y toward the x axis.

    Its derivative by the angle is half that at ``angle + π``.
    """
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return math.sqrt(0.5) * np.array([-c, s, -s, c])


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
