"""Threads of a CPU: results do not depend on their number, on forks or signals, and limits on cores are respected."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from arrangements import as_float32, overlapping, pile

import warpmag
from bench.systems import moment_system
from warpmag.engine.stepping.simulation import Simulation
from warpmag.kernels.induction import theta_flow
from warpmag.kernels.near_contact import near_pairs
from warpmag.kernels.pairs import evaluate, neighbors
from warpmag.kernels.shared import cores, team
from warpmag.scenes_usd import balls_up

COUNTS = (1, 2, 3, 8, 64)
MS = 1.7e6


@pytest.fixture
def assert_same_bits(monkeypatch):
    """Return a function that checks that results do not depend on the number of threads, even for little work."""
    for module in (neighbors, theta_flow):
        monkeypatch.setattr(module, "MOMENTS_PER_THREAD", 100)
    monkeypatch.setattr(evaluate, "PAIRS_PER_THREAD", 10_000)
    monkeypatch.setattr(near_pairs, "_BALLS_PER_THREAD", 100)

    def check(work, counts=COUNTS):
        results = []
        for count in counts:
            monkeypatch.setattr(team, "cores", lambda count=count: count)
            results.append([np.ascontiguousarray(array).tobytes() for array in work()])
        assert results[0] and all(arrays == results[0] for arrays in results)

    return check


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("count", [1000, 2197])
def test_fields_and_wrenches(count, dtype, device, assert_same_bits):
    """Fields of balls of one and of several radii, at other targets, at few targets, and where lists overflow."""
    x, several, m = pile(count=count)
    targets = as_float32(x[: count // 2] + 0.001)[0]
    many = np.tile(x, (40, 1)) + 0.1 * np.arange(40).repeat(count)[:, None]
    crowd, crowd_radii, crowd_m = overlapping(count=1000, extent=0.08)

    def work():
        options = {"dtype": dtype, "device": device}
        return [
            warpmag.h_field(x, m, radii=0.005, **options),
            warpmag.h_field(x, m, radii=several, **options),
            warpmag.h_field(x, m, targets, radii=several, **options),
            warpmag.h_field(many, np.tile(m, (40, 1)), targets[:20], **options),
            warpmag.h_field(crowd, crowd_m, radii=crowd_radii, **options),
            *warpmag.wrench(x, m, radii=0.005, **options),
            *warpmag.wrench(x, m, radii=several, **options),
        ]

    assert_same_bits(work)


@pytest.mark.parametrize("contact_model", ["dipole", "multipole"])
def test_solves_over_time(contact_model, device, assert_same_bits):
    """Balls that touch, overlap and move, in two worlds; one world has a rotating magnet of several moments."""
    x = 0.00995 * np.stack(np.meshgrid(*[np.arange(11.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    lattice = 0.004 * np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), -1).reshape(-1, 3) - [0.0, 0.0, 0.05]
    positions = np.concatenate([x, lattice, x[:900]])
    magnet = np.zeros(len(positions), bool)
    magnet[len(x) : len(x) + len(lattice)] = True
    bodies = np.arange(len(positions))
    bodies[magnet] = len(x)
    velocities = np.where(magnet[:, None], 0.0, 2e-4 * np.random.default_rng(5).normal(size=positions.shape))

    def work():
        system = moment_system(
            radii=np.where(magnet, 0.0025, 0.005), worlds=np.repeat([0, 1], [len(x) + len(lattice), 900]),
            permanent=magnet, bodies=bodies, saturation=MS, external_field=[0.0, 0.0, 1e5],
            contact_model=contact_model, rtol=1e-4, device=device,
        )  # fmt: skip
        system.moments.assign(np.where(magnet[:, None], [0.0, 0.1, 0.2], 0.0))
        results = []
        for step in range(3):
            system.positions.assign(positions + step * velocities)
            system.solve()
            results += [a.numpy().copy() for a in (system.moments, system.error, system.evaluations)]
            for law in ("kelvin", "zeeman")[: 1 + (contact_model == "dipole")]:
                system.apply_forces(law)
                results += [a.numpy().copy() for a in (system.forces, system.torques)]
        return results

    assert_same_bits(work)


def test_a_world_keeps_its_bits_in_company(device):
    """On a CPU the order of a world's sums depends on that world alone."""
    if device != "cpu":
        pytest.skip("a GPU shares out the sources of a target by how many targets there are in all")
    x, radii, _ = pile(count=1500)
    results = []
    for companions in (0, 1300):
        n = len(x) + companions
        system = moment_system(
            radii=np.concatenate([radii, np.full(companions, 0.005)]), worlds=(np.arange(n) >= len(x)).astype(int),
            saturation=MS, external_field=[0.0, 0.0, 1e5], device=device,
        )  # fmt: skip
        system.positions.assign(np.concatenate([x, x[:companions]]))
        system.solve()
        system.apply_forces()
        results.append([a.numpy()[: len(x)].tobytes() for a in (system.moments, system.forces)])
    assert results[0] == results[1]


def test_a_simulation(device, assert_same_bits, tmp_path):
    """Balls Up with enough balls for several threads."""
    stage = tmp_path / "pile.usda"
    balls_up.author(stage, columns=15, rows=15, layers=4, height=0.0611)

    def work():
        simulation = Simulation(stage, device=device)
        for _ in range(2):
            simulation.step()
        system = simulation.magnetics.system
        return [a.numpy() for a in (simulation.state.body_q, simulation.state.body_qd, system.moments)]

    assert_same_bits(work, (1, 8))


def test_threads_forks_and_signals_at_once(device):
    """A few rounds of ``stress_threads``, in a separate process."""
    if device != "cpu":
        pytest.skip("about threads of a CPU")
    stress = Path(__file__).with_name("stress_threads.py")
    ran = subprocess.run([sys.executable, stress, "2"], capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


MOUNTS = {
    "version 2": "31 22 0:26 / /sys/fs/cgroup rw,nosuid shared:9 - cgroup2 cgroup2 rw,nsdelegate",
    "version 1": "33 32 0:29 / /sys/fs/cgroup/cpu,cpuacct rw shared:10 - cgroup cgroup rw,cpu,cpuacct",
    "a container's": r"33 32 0:29 /docker/a\040b /sys/fs/cgroup/cpu ro - cgroup cgroup rw,cpu",
}


@pytest.mark.parametrize(
    "mount, group, files, expected",
    [
        ("version 2", "0::/", {"cpu.max": "150000 100000"}, 1.5),
        ("version 2", "0::/", {"cpu.max": "max 100000"}, np.inf),
        ("version 2", "0::/", {}, np.inf),
        ("version 2", "0::/a/b.scope", {"a/b.scope/cpu.max": "400000 100000", "a/cpu.max": "200000 100000"}, 2.0),
        ("version 2", "0::/a/b.scope", {"a/b.scope/cpu.max": "50000 100000", "a/cpu.max": "max 100000"}, 0.5),
        ("version 2", "0::/../other", {"cpu.max": "300000 100000"}, 3.0),
        ("version 2", "0::/a", {"a/cpu.max": "nonsense"}, np.inf),
        ("version 1", "4:cpu,cpuacct:/a", {"a/cpu.cfs_quota_us": "250000", "a/cpu.cfs_period_us": "100000"}, 2.5),
        ("version 1", "4:cpu,cpuacct:/a", {"a/cpu.cfs_quota_us": "-1", "a/cpu.cfs_period_us": "100000"}, np.inf),
        ("version 1", "5:memory:/a", {"a/cpu.cfs_quota_us": "100000", "a/cpu.cfs_period_us": "100000"}, np.inf),
        ("a container's", "4:cpu:/docker/a b", {"cpu.cfs_quota_us": "80000", "cpu.cfs_period_us": "40000"}, 2.0),
    ],
)
def test_quota_of_cgroups(mount, group, files, expected, tmp_path):
    process = tmp_path / "proc/self"
    process.mkdir(parents=True)
    (process / "cgroup").write_text(f"9:name=systemd:/\n{group}\n")
    (process / "mountinfo").write_text(f"24 1 0:6 / /dev rw - devtmpfs devtmpfs rw\n{MOUNTS[mount]}\n")
    for name, text in files.items():
        file = tmp_path / MOUNTS[mount].split()[4].lstrip("/") / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")
    assert cores.cpu_quota(tmp_path) == expected


def test_quota_without_cgroups(tmp_path):
    assert cores.cpu_quota(tmp_path) == np.inf


@pytest.mark.parametrize(
    "quota, allowed, expected", [(np.inf, 8, 8), (2.5, 8, 3), (0.3, 8, 1), (4.0, 2, 2), (2.0, 8, 2)]
)
def test_cores_of_quota_and_affinity(quota, allowed, expected, monkeypatch):
    monkeypatch.setattr(cores, "_own_quota", lambda: quota)
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda _: set(range(allowed)), raising=False)
    assert cores.cores() == expected
    assert team.threads_for(10**9, 1) == expected
