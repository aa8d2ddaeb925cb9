"""Gradients of forces by coils, against central differences of systems in float64; the same on bodies of a model."""

import numpy as np
import pytest
import warp as wp
from test_applied import LOOP, POLYLINE, SOLENOID, A, R, source_of

from bench.systems import moment_system, solve_cold

newton = pytest.importorskip("newton")
from small_builders import add_ball, new_builder  # noqa: E402

import warpmag  # noqa: E402
from warpmag.declarations.coils import FieldMap  # noqa: E402

EXACT = 1e-6
"""Relative error: of second derivatives by differences 1e-7, of the differences below 1e-8, with a margin."""
NODES = np.random.default_rng(8).normal(size=(3, 3, 3, 3)) * 1e4
MAP = source_of(FieldMap(values=NODES, origin=(-0.13, -0.12, -0.11), spacing=(0.1, 0.1, 0.1)).record())


def rotated(q, turn):
    """Quaternion q (x, y, z, w) after a small rotation, to second order."""
    u, w, half = q[:3], q[3], 0.5 * turn
    turned = np.append(q[:3] + half * w + np.cross(half, u), w - half @ u)
    return turned / np.linalg.norm(turned)


class Arrangement:
    """Two iron balls, a magnet of two balls, and sources; the second source is on the body of the magnet."""

    def __init__(self, device):
        sources = [
            LOOP,
            SOLENOID._replace(world=0, body=2, movable=True),
            POLYLINE._replace(world=0, body=7, movable=True),
            MAP,
        ]
        self.system = moment_system(
            radii=np.full(4, R), permanent=[False, False, True, True], bodies=[0, 1, 2, 2], saturation=1.7e6,
            sources=sources, external_field=(1e3, 2e3, 3e4), single_torque=True, rtol=1e-12, dtype="float64",
            device=device,
        )  # fmt: skip
        rng = np.random.default_rng(3)
        turns = rng.normal(size=(4, 4))
        self.state = {
            "positions": np.array([[0.0, 0.004, 0.011], [0.0, 0.016, 0.005], [0.03, 0.01, 0.0], [0.03, 0.021, 0.0]]),
            "moments": np.concatenate([np.zeros((2, 3)), rng.normal(size=(2, 3))]),
            "origins": np.array([[0, 0, 0], [0.03, 0.015, 0.05], [-0.05, 0.0, 0.0], [0.0, 0.0, 0.0]], float),
            "rotations": turns / np.linalg.norm(turns, axis=1)[:, None],
            "strengths": np.array([900.0, 700.0, -800.0, 1.3]),
            "external_field": np.broadcast_to([1e3, 2e3, 3e4], (4, 3)),
        }
        # cotangents of forces, torques and reactions; maps and the first source do not move
        moves = np.array([[0.0], [1.0], [1.0], [0.0]])
        self.seeds = [rng.normal(size=(4, 3)), 30.0 * rng.normal(size=(4, 3))]
        self.reactions = [moves * rng.normal(size=(4, 3)), 30.0 * moves * rng.normal(size=(4, 3))]

    def solve(self, **changes):
        """Solve at the state with changes; return the value of the function."""
        system, state = self.system, self.state | changes
        system.positions.assign(state["positions"])
        system.moments.assign(state["moments"])
        system.external_field.assign(state["external_field"])
        system.sources.frames.assign(np.concatenate([state["origins"], state["rotations"]], axis=1))
        system.sources.strengths.assign(state["strengths"][:, None] * [1.0, 0.0, 0.0])
        solve_cold(system)
        system.apply_forces()
        wrenches = system.source_interaction.wrenches.numpy()
        results = system.forces.numpy(), system.torques.numpy(), wrenches[:, :3], wrenches[:, 3:6]
        return sum(float(np.sum(s * r)) for s, r in zip([*self.seeds, *self.reactions], results, strict=True))

    def gradients(self):
        """Gradients by the names of the state; those of rotations by small turns."""
        self.solve()
        system, gradients = self.system, self.system.gradients
        gradients.load(system.positions, system.moments, system.h, system.external_field)
        coils = gradients.coils
        coils.frames.assign(system.sources.frames)
        coils.strengths.assign(system.sources.strengths)
        coils.source_force_cotangents.assign(self.reactions[0])
        coils.source_torque_cotangents.assign(self.reactions[1])
        coils.centers.assign(self.state["origins"])
        sums = gradients.wrench(*(wp.array(s, dtype=wp.vec3d, device=system.device) for s in self.seeds))
        gradients.solve(sums.by_moments)
        by_sources = coils.by_sources.numpy()
        fixed = np.array([[0], [0], [1], [1]])  # moments that no solve changes
        return {
            "positions": sums.by_positions.numpy() + gradients.by_positions.numpy(),
            "moments": fixed * (sums.by_moments.numpy() + gradients.by_moments.numpy()),
            "external_field": sums.by_external_field.numpy() + gradients.by_field.numpy(),
            "strengths": by_sources[:, 0],
            "origins": by_sources[:, 1:4] + by_sources[:, 7:10],  # torques are about the origins here
            "rotations": by_sources[:, 4:7],
        }


def test_gradients_by_coils(device):
    arrangement = Arrangement(device)
    gradients, rng = arrangement.gradients(), np.random.default_rng(9)
    for name, gradient in gradients.items():
        value = arrangement.state[name]
        direction = rng.normal(size=gradient.shape) * (gradient != 0.0)
        size = {"positions": R, "origins": A, "rotations": 1.0}.get(name, np.abs(value).max())

        def moved(step, name=name, value=value, direction=direction):
            if name == "rotations":
                return {name: np.array([rotated(q, step * turn) for q, turn in zip(value, direction, strict=True)])}
            return {name: value + step * direction}

        def slope(step, moved=moved):
            return (arrangement.solve(**moved(step)) - arrangement.solve(**moved(-step))) / (2.0 * step)

        step = 2e-5 * size
        expected = (4.0 * slope(step) - slope(2.0 * step)) / 3.0
        typical = np.linalg.norm(gradient) * np.linalg.norm(direction) / np.sqrt(max(np.count_nonzero(gradient), 1))
        assert abs(np.sum(gradient * direction) - expected) < EXACT * typical, name


def test_gradients_of_a_model_with_coils():
    builder = new_builder()
    tilted = [wp.quat_from_axis_angle(wp.normalize(wp.vec3(*axis)), 0.6) for axis in ((1, 2, 0), (0, 1, 2), (2, 0, 1))]
    body = builder.add_body(
        xform=wp.transform((0.0, 0.0, 0.04), tilted[0]),
        mass=0.1,
        com=(0.01, 0.0, 0.0),
        inertia=wp.mat33(*(1e-4 * np.eye(3)).ravel().tolist()),
    )
    frame = wp.transform((0.005, 0.0, 0.0), tilted[1])
    moving = warpmag.add_coil(builder, body=body, radius=A, ampere_turns=800.0, xform=frame)
    static = warpmag.add_coil(
        builder, radius=2.0 * A, ampere_turns=2e3, xform=wp.transform((0.0, 0.01, -0.03), tilted[2])
    )
    add_ball(builder, (0.003, 0.0, 0.005))
    add_ball(builder, (-0.02, 0.01, 0.01), (0.0, 3e5, 4e5), rotation=tilted[1])
    model = builder.finalize(device="cpu", requires_grad=True)
    magnetics, state = warpmag.Magnetics(model, external_field=(0.0, 0.0, 2e4), rtol=5e-6), model.state()
    strength = model.warpmag.strength
    arrays = {"poses": state.body_q, "frames": model.shape_transform, "strengths": strength}
    strength.requires_grad = model.shape_transform.requires_grad = True
    rng = np.random.default_rng(4)
    seed = rng.normal(size=(3, 6)) * ([1.0] * 3 + [30.0] * 3)
    start = {name: array.numpy().copy() for name, array in arrays.items()}

    def value(name, values):
        arrays[name].assign(values)
        state.clear_forces()
        magnetics.apply(state)
        arrays[name].assign(start[name])
        return float(np.sum(seed * state.body_f.numpy()))

    state.clear_forces()
    with wp.Tape() as tape:
        magnetics.apply(state)
    state.body_f.grad.assign(seed)
    tape.backward()
    for name, array in arrays.items():
        gradient, rows = (
            array.grad.numpy(),
            {"poses": slice(None), "frames": [static], "strengths": [moving, static]}[name],
        )
        change = np.zeros_like(gradient)
        change[rows] = rng.normal(size=change[rows].shape) * (1e3 if name == "strengths" else 0.01)
        if name != "strengths":  # quaternions keep their length
            q = start[name][:, 3:]
            change[:, 3:] = 100.0 * (change[:, 3:] - np.sum(change[:, 3:] * q, axis=1, keepdims=True) * q)
        slope = (value(name, start[name] + 0.01 * change) - value(name, start[name] - 0.01 * change)) / 0.02
        # steps of 1 % in float32
        assert abs(np.sum(gradient * change) - slope) < 5e-3 * np.linalg.norm(gradient) * np.linalg.norm(change), name
