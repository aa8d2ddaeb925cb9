"""Collective response of bodies of few cells: fewer evaluations, and the same solution."""

import numpy as np
import pytest
import warp as wp
from cell_bodies import pair_corrections
from scipy.spatial.transform import Rotation

from bench.reference import oracle
from bench.systems import moment_system
from warpmag.kernels.induction import body_response
from warpmag.kernels.shared import team
from warpmag.shapes import demagnetization, lattice

MS = 1.7e6
SPACING = 0.002
NEEDLE = lattice.fill(lattice.box([0.001, 0.001, 0.016]), SPACING)
BAR = lattice.fill(lattice.box([0.002, 0.002, 0.01]), SPACING)
PLATE = lattice.fill(lattice.box([0.007, 0.007, 0.001]), SPACING)
COUPLINGS = {id(body): demagnetization.coupling(body, body.radii) for body in (NEEDLE, BAR, PLATE)}
STILL = Rotation.identity()


class Scene:
    """Inducible bodies of cells, and inducible balls."""

    def __init__(self, bodies, balls=(), **settings):
        self.bodies, self.balls = bodies, np.reshape(balls, (-1, 3))
        counts = [len(body.volumes) for body in bodies]
        self.first = np.cumsum(counts) - counts
        self.radii = np.concatenate([*(body.radii for body in bodies), np.full(len(self.balls), 0.003)])
        self.couplings = [(int(k), COUPLINGS[id(body)]) for k, body in zip(self.first, bodies, strict=True)]
        labels = np.append(np.repeat(np.arange(len(bodies)), counts), len(bodies) + np.arange(len(self.balls)))
        self.settings = {"bodies": labels, "radii": self.radii, "saturation": MS, "couplings": self.couplings}
        self.settings["curve"] = "tanh-applied"  # the oracle's
        self.settings |= settings

    def system(self, **settings):
        return moment_system(**self.settings | settings)

    def places(self, poses):
        parts = [turn.apply(body.positions) + place for body, (turn, place) in zip(self.bodies, poses, strict=True)]
        return np.concatenate([*parts, self.balls])

    def put(self, system, poses):
        system.positions.assign(self.places(poses))
        system.rotations.assign(np.array([turn.as_quat() for turn, _ in poses]))

    def solve(self, system, poses):
        self.put(system, poses)
        system.solve()
        assert system.converged.numpy().all()
        return int(system.evaluations.numpy()[0])

    def magnetizations(self, poses, field):
        """Return magnetizations by Newton's method with the dense matrix of all cells and balls, in float64."""
        x, n = self.places(poses), len(self.radii)
        volumes = 4.0 / 3.0 * np.pi * self.radii**3
        extra = np.zeros((n, 3, n, 3))
        for (turn, _), (first, body) in zip(poses, self.couplings, strict=True):
            xx, yy, zz, xy, xz, yz = body.tensor.T
            tensors = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
            i = first + np.repeat(np.arange(len(body.start) - 1), np.diff(body.start))
            extra[i, :, first + body.other] += turn.as_matrix() @ tensors @ turn.as_matrix().T
        couplings = [coupling for _, coupling in self.couplings]
        cells = sum(len(coupling.radii) for coupling in couplings)
        extra[:cells, :, :cells] += pair_corrections(self.bodies, couplings, poses)
        extra *= volumes[:, None]
        results = oracle.equilibrium(
            x, self.radii, field, saturation=MS, extra_coupling=extra.reshape(3 * n, 3 * n), tolerance=1e-12
        )
        return results.magnetizations

    def error(self, system, poses, field):
        truth = self.magnetizations(poses, field)
        return np.linalg.norm(system.magnetizations().numpy() - truth) / np.linalg.norm(truth)


def test_a_lone_body_takes_its_response_at_once(device):
    """A needle on the linear part of its curve; without collective response it takes 7 evaluations, and 26 in all."""
    assert len(NEEDLE.volumes) <= body_response.MOST_CELLS
    scene = Scene([NEEDLE], external_field=(1e3, 0.0, 2e3), device=device)
    turns = Rotation.from_rotvec([[0.02 * step, 0.01 * step, 0.0] for step in range(8)])
    system = scene.system()
    taken = [scene.solve(system, [(turn, np.zeros(3))]) for turn in turns]
    # conjugate gradients leave part of the residual; starts are extrapolated from the third solution on
    assert taken[0] <= 3
    assert sum(taken) <= 16
    assert scene.error(system, [(turns[-1], np.zeros(3))], (1e3, 0.0, 2e3)) < 1e-3


@pytest.mark.parametrize("strength", [1e3, 2e5, 3e6])
def test_bodies_and_balls_take_the_one_solution(strength, device):
    """Touching needles, a bar, a plate and balls converge to the one solution, from linear to saturated."""
    field = strength * np.array([0.6, -0.2, 0.8])
    balls = [[0.006, 0.0, 0.0], [0.006, 0.006, 0.001], [0.0, -0.005, 0.02]]
    scene = Scene([NEEDLE, BAR, NEEDLE, PLATE], balls, external_field=field, dtype="float64", rtol=1e-9, device=device)
    poses = [
        (Rotation.from_rotvec([0.3, 0.0, 0.2]), np.zeros(3)), (STILL, np.array([0.0, 0.012, 0.002])),
        (Rotation.from_rotvec([1.2, 0.0, 0.0]), np.array([0.002, 0.0, 0.016])),
        (Rotation.from_rotvec([0.0, 0.7, 0.1]), np.array([0.014, 0.0, 0.0])),
    ]  # fmt: skip
    system = scene.system()
    scene.solve(system, poses)
    assert scene.error(system, poses, field) < 1e-8  # twice rtol
    shown = system.h.numpy()
    system.evaluate()  # field of all moments, without any response
    np.testing.assert_allclose(system.h.numpy(), shown, rtol=0, atol=1e-7 * np.linalg.norm(shown))


def moving(step):
    """Return poses of four needles and a bar that pass, turn and touch."""
    t = 0.04 * step
    return [
        (Rotation.from_rotvec([0.3 + t, 0.0, 0.2]), np.array([0.0, 0.0, 0.2 * t])),
        (Rotation.from_rotvec([0.3, t, 0.2]), np.array([0.004, 0.0005, -0.1 * t])),
        (Rotation.from_rotvec([1.4, 0.0, t]), np.array([0.0, 0.003, 0.018])),
        (Rotation.from_rotvec([-1.0, 0.3, -t]), np.array([0.003, -0.001, -0.02])),
        (Rotation.from_rotvec([0.0, 0.5 * t, 0.0]), np.array([-0.005, 0.002, 0.05 * t])),
    ]


def test_moving_bodies_take_few_evaluations_and_keep_their_error(device):
    field = (2e4, 1e4, 6e4)
    scene = Scene([NEEDLE] * 4 + [BAR], external_field=field, device=device)
    system = scene.system()
    taken = []
    for step in range(12):
        taken.append(scene.solve(system, moving(step)))
        if step % 3 == 2:  # without collective response the estimate is wrong by up to 2.3 times
            assert scene.error(system, moving(step), field) <= 1e-3  # rtol
    assert sum(taken) <= 80  # 106 without collective response


@pytest.mark.parametrize("apart", [0.0, 0.002])
def test_poles_at_one_place_do_not_keep_a_solve_from_its_end(apart, device):
    """Twelve needles that point to one place couple far more strongly than balls; every start converges."""
    away = Rotation.random(12, random_state=5)
    poses = [(turn, turn.apply([0.0, 0.0, 0.016 + apart])) for turn in away]
    scene = Scene([NEEDLE] * 12, external_field=(0.0, 0.0, 3e4), dtype="float64", rtol=1e-8, device=device)
    results = []
    for seed in (0, 1):
        system = scene.system()
        start = np.random.default_rng(seed).normal(size=(len(scene.radii), 3)) * 3e5 * seed
        system.start_from(wp.array(np.clip(start, -9e5, 9e5), dtype=wp.vec3d, device=device))
        assert scene.solve(system, poses) < 300
        results.append(system.moments.numpy())
    assert np.linalg.norm(results[1] - results[0]) < 1e-7 * np.linalg.norm(
        results[0]
    )  # rtol, amplified by slow convergence


def test_threads_never_show(monkeypatch, device):
    """Results do not depend on threads: bodies for several threads in two worlds, and a resumed system."""
    rng = np.random.default_rng(2)
    turns, at = Rotation.random(24, random_state=1), rng.uniform(-0.06, 0.06, (24, 3))
    n = len(BAR.volumes)
    scene = Scene([BAR] * 24, external_field=(0.0, 1e4, 6e4), worlds=np.repeat([0, 1], [16 * n, 8 * n]), device=device)
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(team, "cores", lambda threads=threads: threads)
        system = scene.system()
        for step in range(4):
            if step == 3 and threads == 3:  # a resumed run
                before, system = system, scene.system()
                for name, array in system.persistent_arrays().items():
                    array.assign(before.persistent_arrays()[name])
            scene.solve(system, [(turn, x * (1.0 + 0.01 * step)) for turn, x in zip(turns, at, strict=True)])
            results.append([a.numpy().tobytes() for a in (system.moments, system.error, system.evaluations)])
    assert results[:4] == results[4:]
