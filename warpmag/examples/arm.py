"""A MuJoCo arm with an electromagnet picks up a steel ball and puts it down elsewhere.

Two links turn about vertical axes, and a slide carries the coil. The slide carries the whole weight of a held ball,
since the forces of coil and ball on each other are opposite.

Runs: ``python -m warpmag.examples arm``
"""

import math

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

LINK, HEIGHT = 0.12, 0.1  # m, length of a link, height of the arm
RADIUS = 0.005  # m, of the ball
COIL = {"shape": "solenoid", "radius": 0.015, "length": 0.01, "label": "gripper"}
AMPERE_TURNS = 2500.0
STIFFNESS = 2000.0  # N/m, of the slide's drive
START, END = (0.15, 0.1), (0.12, -0.12)  # m, positions where the ball is picked up and put down
PAD, LIFT = 0.014, 0.03  # m, height of the pad above the ground, and of the lift
TIMES = (0.0, 0.3, 0.5, 1.2, 1.4, 1.6)  # s: start, picked up, lifted, turned, lowered, released
# MuJoCo's contacts are springs: with Newton's 2500 N/m the pulled ball sinks 0.9 mm into the pad, with this stiffness
# a hundredth of that. Steps must not exceed 2/sqrt(ke), 4 ms.
HARD = {"ke": 2.5e5, "kd": 1e3}

ROLLING = {"mujoco:condim": 6}  # rolling friction, else a rolling ball never stops


def joints_at(x: float, y: float) -> tuple[float, float]:
    """Return the angles of both links [rad] for the coil at (x, y)."""
    elbow = math.acos((x * x + y * y) / (2.0 * LINK**2) - 1.0)
    return math.atan2(y, x) - 0.5 * elbow, elbow


class Example:
    """The arm, the ball and the ground."""

    def __init__(self, viewer, args):
        """Build the scene."""
        builder = newton.ModelBuilder()
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
        warpmag.register_custom_attributes(builder)
        hard = newton.ModelBuilder.ShapeConfig(density=7870.0, mu=0.5, mu_rolling=5e-4, **HARD)
        builder.add_ground_plane(cfg=hard)
        self.gripper = self.add_arm(builder)
        self.ball = builder.add_body(xform=wp.transform((*START, RADIUS), wp.quat_identity()))
        builder.add_shape_sphere(self.ball, radius=RADIUS, cfg=hard, custom_attributes=ROLLING)
        warpmag.add_inducible(builder, body=self.ball, material="1010-steel")

        self.model = builder.finalize()
        self.magnetics = warpmag.Magnetics(self.model)
        on_gpu = self.model.device.is_cuda
        self.solver = newton.solvers.SolverMuJoCo(self.model, use_mujoco_cpu=not on_gpu, nconmax=64, njmax=128)
        self.state_0, self.state_1, self.control = self.model.state(), self.model.state(), self.model.control()
        newton.eval_fk(self.model, self.model.joint_q, self.model.joint_qd, self.state_0)
        self.display = warpmag.Display(viewer, self.model, self.magnetics)
        self.frame_dt, self.sim_time = 0.012, 0.0  # s
        self.viewer, self.loads, self.graph = viewer, [], None
        self.targets = self.control.joint_target_q.numpy()
        self.magnetics.set_current("gripper", 0.0)
        if on_gpu:
            with wp.ScopedCapture() as capture:
                self.simulate()
            self.graph = capture.graph

    def add_arm(self, builder) -> int:
        """Add two links and the slide with the coil; return the body of the slide."""
        light = newton.ModelBuilder.ShapeConfig(density=500.0, has_shape_collision=False)
        upright, parent, joints = (0.0, 0.0, 1.0), -1, []
        angles = joints_at(*START)
        for angle in angles:
            link = builder.add_link()
            center = wp.transform((0.5 * LINK, 0.0, 0.0), wp.quat_identity())
            builder.add_shape_box(link, xform=center, hx=0.5 * LINK, hy=0.01, hz=0.005, cfg=light)
            end = wp.transform((0.0, 0.0, HEIGHT) if parent < 0 else (LINK, 0.0, 0.0), wp.quat_identity())
            drive = {"target_ke": 20.0, "target_kd": 0.5, "target_q": angle}
            joints.append(builder.add_joint_revolute(parent, link, parent_xform=end, axis=upright, **drive))
            builder.joint_q[-1] = angle
            parent = link
        slide = builder.add_link()
        pad = newton.ModelBuilder.ShapeConfig(density=2000.0, mu=0.5, **HARD)
        builder.add_shape_cylinder(slide, radius=0.012, half_height=0.0005, cfg=pad)
        coil = wp.transform((0.0, 0.0, 0.0065), wp.quat_identity())
        winding = newton.ModelBuilder.ShapeConfig(density=2000.0, has_shape_collision=False)
        builder.add_shape_cylinder(slide, xform=coil, radius=COIL["radius"], half_height=0.005, cfg=winding)
        warpmag.add_coil(builder, body=slide, xform=coil, **COIL)
        end = wp.transform((LINK, 0.0, PAD + 0.0005 - HEIGHT), wp.quat_identity())
        drive = {"target_ke": STIFFNESS, "target_kd": 20.0}
        joints.append(builder.add_joint_prismatic(parent, slide, parent_xform=end, axis=upright, **drive))
        builder.add_articulation(joints)
        return slide

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        return warpmag.examples.create_parser(frames=160)

    def simulate(self):
        """Run four steps of 3 ms."""
        for _ in range(4):
            self.state_0.clear_forces()
            self.magnetics.apply(self.state_0)
            self.solver.step(self.state_0, self.state_1, self.control, None, 3e-3)
            self.state_0, self.state_1 = self.state_1, self.state_0

    def step(self):
        """Advance by a frame of 12 ms."""
        start, end = joints_at(*START), joints_at(*END)
        height = np.interp(self.sim_time, TIMES, (0.0, 0.0, LIFT, LIFT, 0.0, 0.0))
        fraction = 0.5 - 0.5 * math.cos(math.pi * np.interp(self.sim_time, TIMES, (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)))
        self.targets[:3] = *((1.0 - fraction) * np.array(start) + fraction * np.array(end)), height
        self.control.joint_target_q.assign(self.targets)
        self.magnetics.set_current("gripper", AMPERE_TURNS if 0.2 <= self.sim_time < TIMES[-1] else 0.0)
        if self.graph:
            wp.capture_launch(self.graph)
        else:
            self.simulate()
        self.sim_time += self.frame_dt
        load = STIFFNESS * (height - self.state_0.joint_q.numpy()[2])
        self.loads.append((self.sim_time, load, self.ball_position()[2]))

    def render(self):
        """Show the arm and the ball."""
        self.display.show(self.sim_time, self.state_0)

    def ball_position(self) -> np.ndarray:
        """Return the position of the ball [m]."""
        return self.state_0.body_q.numpy()[self.ball, :3].astype(float)

    def held_weight(self) -> float:
        """Return the increase of the slide's load by the ball [N]."""
        times, forces, _ = np.array(self.loads).T
        return float(forces[(times > 0.27) & (times < TIMES[1])].mean() - forces[(times > 0.1) & (times < 0.2)].mean())

    def test_final(self):
        """Check that the ball was lifted, loaded the arm with its weight, lies at the end, and penetrated nothing."""
        assert max(height for *_, height in self.loads) > LIFT
        weight = 9.81 * float(self.model.body_mass.numpy()[self.ball])
        np.testing.assert_allclose(self.held_weight(), weight, rtol=0.02)
        position = self.ball_position()
        np.testing.assert_allclose(position[:2], END, atol=1e-3)
        np.testing.assert_allclose(position[2], RADIUS, atol=5e-5)
        assert min(height for *_, height in self.loads) > 0.98 * RADIUS

    def summary(self) -> str:
        """Return the result in one line."""
        error = 1e3 * np.linalg.norm(self.ball_position()[:2] - END)
        weight = 9.81 * float(self.model.body_mass.numpy()[self.ball])
        held = 1e3 * self.held_weight()
        return f"put down {error:.2g} mm off; the arm carried {held:.2f} mN, the ball weighs {1e3 * weight:.2f} mN"


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
