"""The state machine of a step against its rules in Python."""

import math

import newton
import numpy as np
import pytest
import warp as wp

import warpmag
from warpmag.engine.pile_xpbd.contacts import RigidSolver, body_sizes
from warpmag.kernels.rigid import monitor, stepping
from warpmag.kernels.rigid.force_spans import measure_force_spans
from warpmag.kernels.rigid.newton_views import BodyView, view_bodies

TRAVEL, SHARED_TRAVEL, OVERLAP, EASE, FUTILE, FEWEST, CAPACITY = 0.25, 1.0, 0.008, 0.8, 0.8, 2, 100


class Rules:
    """What is to be decided about an attempt, written down once more."""

    def __init__(self):
        self.level = self.done = self.attempts = self.regrown = 0
        self.overlap, self.pressed_before, self.halt = 0.0, np.inf, "no"
        self.motion = 0.0  # in a substep of the first level, over the distance in which forces vary
        self.known = False  # the contacts of the present state

    @property
    def sharing(self):
        """Substeps that share forces: two at least, else what moves no farther than it may meanwhile."""
        fitting = [n for n in (2**k for k in range(self.level + 1)) if self.motion * n / 2**self.level <= SHARED_TRAVEL]
        return min(2**self.level, max([2, *fitting]))

    def judge(self, travel, next_travel, long_travel, force_travel, overlap, lost, fill):
        """Returns what becomes of the attempt, and the record of a step that is done."""
        self.attempts += 1
        motion = force_travel / 2 * 2**self.level
        if fill > CAPACITY:
            self.halt = "overflow"
            return "halted", None
        pressed = overlap > max(OVERLAP, self.overlap)
        helped = overlap < FUTILE * self.pressed_before
        if (travel > TRAVEL or (pressed and helped) or lost) and self.level < stepping.LEVELS - 1:
            self.motion = motion
            needed = 1 + sum(travel > 4**k * TRAVEL for k in range(1, stepping.LEVELS))
            self.level = min(self.level + needed, stepping.LEVELS - 1)
            self.pressed_before = overlap if pressed else self.pressed_before
            return "again", None
        if lost:
            self.halt = "lost"
            return "halted", None
        record = (FEWEST * 2**self.level, self.attempts, travel > TRAVEL, self.regrown)
        self.done, self.attempts, self.regrown = self.done + 1, 0, 0
        self.overlap, self.pressed_before, self.motion = overlap, np.inf, motion
        if next_travel > TRAVEL:
            self.level = min(self.level + 1, stepping.LEVELS - 1)
        elif long_travel < EASE * TRAVEL and (overlap < 0.5 * OVERLAP or (pressed and not helped)) and self.level:
            self.level -= 1
        return "done", record


@pytest.fixture
def machine(device):
    limits = {
        "travel": TRAVEL,
        "shared_travel": SHARED_TRAVEL,
        "overlap": OVERLAP,
        "growth_margin": EASE,
        "futile_ratio": FUTILE,
    }
    machine = stepping.StepMachine(16, 1, device, **limits, first_level_substeps=FEWEST)
    machine.arrays.capacities.fill_(CAPACITY)
    machine.set_state_arrays([wp.zeros(1, dtype=float, device=device)], [wp.zeros(1, dtype=float, device=device)])
    return machine


def report(arrays, travel, next_travel, long_travel, force_travel, overlap, lost, fill):
    """Stand in for the monitor."""
    peaks, counts = arrays.peaks.numpy(), arrays.counts.numpy()
    assert (peaks == 0.0).all() and counts[monitor.COUNT_BAD_BODY] == monitor.NO_BODY
    peaks[[monitor.PEAK_TRAVEL, monitor.PEAK_NEXT_TRAVEL]] = travel, next_travel
    peaks[[monitor.PEAK_LONG_TRAVEL, monitor.PEAK_FORCE_TRAVEL]] = long_travel, force_travel
    peaks[[monitor.PEAK_OVERLAP, monitor.PEAK_ERROR]] = overlap, 0.125
    counts[monitor.COUNT_EVALUATIONS], counts[monitor.COUNT_CAPACITIES] = 7, fill
    if lost:
        counts[monitor.COUNT_BAD_BODY] = 3
    arrays.peaks.assign(peaks)
    arrays.counts.assign(counts)


def run_attempt(machine, rules, shared):
    """Go through the substeps of an attempt, and note the level and how many substeps share forces."""
    pairs = 0
    while machine.remaining[rules.level].numpy()[0]:
        if rules.level:
            assert machine.sharing.numpy()[0] == rules.sharing
            assert machine.forces_due.numpy()[0] == (2 * pairs % rules.sharing == 0)
            shared.add((rules.level, rules.sharing))
        assert machine.arrays.status.numpy()[stepping.STATUS_SUBSTEPS] == 2 * pairs
        assert machine.contacts_due.numpy()[0] == (pairs > 0 or not rules.known)
        machine.end_pair(rules.level)
        pairs += 1
    assert 2 * pairs == FEWEST * 2**rules.level


def test_the_device_follows_the_rules(machine):
    arrays = machine.arrays
    rules, rng = Rules(), np.random.default_rng(7)
    seen, shared = set(), set()
    for _ in range(400):
        machine.begin_step()
        while machine.attempting.numpy()[0]:
            wanted = [machine.remaining[level].numpy()[0] for level in range(stepping.LEVELS)]
            assert wanted == [level == rules.level for level in range(stepping.LEVELS)]
            run_attempt(machine, rules, shared)
            travel = np.float32(rng.choice([0.01, 0.08, 0.3, 2.0, 9.0], p=[0.65, 0.2, 0.11, 0.03, 0.01]))
            next_travel = np.float32(rng.choice([0.01, 0.08, 0.3, 2.0, 9.0], p=[0.65, 0.2, 0.11, 0.03, 0.01]))
            long_travel = np.float32(max(travel, next_travel) * rng.uniform(2.0, 4.0))  # 0.2 is the limit of easing
            force_travel = np.float32(long_travel * rng.choice([0.03, 1.0], p=[0.15, 0.85]))  # of a sheet, of a ball
            overlap = np.float32(rng.choice([0.001, 0.005, 0.01, 0.02], p=[0.6, 0.2, 0.1, 0.1]))
            lost, fill = rng.random() < 0.05, int(rng.choice([50, CAPACITY, 101], p=[0.8, 0.15, 0.05]))
            report(arrays, travel, next_travel, long_travel, force_travel, overlap, lost, fill)
            record_at = rules.done % 16
            motion = (float(travel), float(next_travel), float(long_travel), float(force_travel))
            outcome, record = rules.judge(*motion, float(overlap), lost, fill)
            rules.known = outcome == "done"
            machine.end_attempt()
            assert machine.attempting.numpy()[0] == (outcome == "again")
            assert arrays.flags.numpy()[stepping.FLAG_REJECTED] == (outcome != "done")
            if record:
                logged = arrays.log.numpy()[record_at]
                fields = (stepping.LOG_SUBSTEPS, stepping.LOG_ATTEMPTS, stepping.LOG_CAPPED, stepping.LOG_REGROWN)
                assert tuple(logged[list(fields)]) == record
                assert logged[stepping.LOG_EVALUATIONS] == 7
                assert logged[stepping.LOG_PEAKS + monitor.PEAK_TRAVEL] == travel
                assert logged[stepping.LOG_PEAKS + monitor.PEAK_ERROR] == 0.125
            seen.add((outcome, rules.level))
        status = arrays.status.numpy()
        halts = {"no": stepping.RUNNING, "overflow": stepping.OVERFLOW, "lost": stepping.NOT_FINITE}
        assert status[stepping.STATUS_HALT] == halts[rules.halt]
        assert status[stepping.STATUS_DONE] == rules.done
        if rules.halt != "no":
            machine.begin_step()
            assert not machine.attempting.numpy()[0]  # steps do nothing now
            machine.set_status(stepping.STATUS_HALT, stepping.RUNNING)
            machine.set_status(stepping.STATUS_REGROWN, 1)
            rules.halt, rules.regrown = "no", 1
    assert {level for _, level in seen} == set(range(stepping.LEVELS))
    assert {outcome for outcome, _ in seen} == {"done", "again", "halted"}
    assert shared > {(1, 2), (2, 2), (2, 4), (3, 2), (3, 4), (3, 8), (4, 2), (4, 4), (4, 8)}


def test_time_is_counted_for_the_stage_that_it_was_spent_in(machine):
    arrays = machine.arrays
    watched = machine.make_monitor(np.zeros(0), np.zeros(0), np.zeros(0))
    machine.begin_step()
    work = wp.zeros(1 << 20, dtype=float, device=arrays.ticks.device)
    for _ in range(20):
        wp.copy(work, wp.ones_like(work))
    monitor.watch_forces(watched, BodyView(), wp.zeros(1, dtype=wp.vec3, device=arrays.ticks.device), 1e-3)
    ticks = arrays.ticks.numpy().astype(float)
    assert ticks[monitor.INDUCTION] == 0.0
    assert ticks[monitor.FORCE] > 0.0


@pytest.mark.parametrize("flags", [0, 7])
def test_a_state_of_any_arrays_is_saved_and_restored(machine, device, flags):
    """Arrays of all types and lengths, bytes that fill no word among them where there are ``flags``."""
    rng = np.random.default_rng(1)
    kinds = ((wp.transform, 7, 50), (wp.spatial_vector, 6, 50), (wp.float32, 1, 3), (wp.vec3, 3, 1), (wp.float64, 1, 5))
    values = [rng.normal(size=(count, width)).squeeze() for _, width, count in kinds]
    own = [wp.array(entry, dtype=dtype, device=device) for entry, (dtype, _, _) in zip(values, kinds, strict=True)]
    if flags:
        own.append(wp.array(rng.random(flags) < 0.5, dtype=wp.bool, device=device))
    saved = [wp.zeros_like(entry) for entry in own]
    machine.set_state_arrays(own, saved)
    before = [entry.numpy() for entry in own]

    machine.set_status(stepping.STATUS_HALT, stepping.PAUSED)
    machine.begin_step()
    assert all(not entry.numpy().any() for entry in saved)
    machine.set_status(stepping.STATUS_HALT, stepping.RUNNING)
    machine.begin_step()
    for entry, expected in zip(saved, before, strict=True):
        np.testing.assert_array_equal(entry.numpy(), expected)

    for entry in own:
        entry.zero_()
    machine.restore()  # nothing was rejected yet
    assert all(not entry.numpy().any() for entry in own)
    report(machine.arrays, 2.0 * TRAVEL, 0.0, 0.0, 0.0, 0.0, False, 0)
    machine.end_attempt()
    machine.restore()
    for entry, expected in zip(own, before, strict=True):
        np.testing.assert_array_equal(entry.numpy(), expected)


WEIGHT = monitor.UNCONSTRAINED_WEIGHT
GLIDING = {  # velocities of two balls of radius 1 beside each other along x, their gap, what tells within 0.1, and 0.2
    "together": (
        (0.0, 9.0, 0.0),
        (0.0, 9.0, 0.0),
        0.0,
        0.9 * WEIGHT,
        0.9 * WEIGHT,
    ),
    "gliding, pressed": ((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), -0.001, 0.2, 0.2),
    "gliding, parting": (
        (-0.1, -1.0, 0.0),
        (0.1, 1.0, 0.0),
        0.001,
        0.1005 * WEIGHT,
        0.1005 * WEIGHT,
    ),
    "gliding, touching soon": ((0.2, -1.0, 0.0), (0.0, 1.0, 0.0), 0.01, 0.2, 0.2),
    "gliding, touching later": ((0.2, -1.0, 0.0), (0.0, 1.0, 0.0), 0.03, 0.102 * WEIGHT, 0.2),
    "gliding past": (
        (0.2, -1.0, 0.0),
        (0.0, 1.0, 0.0),
        0.05,
        0.102 * WEIGHT,
        0.102 * WEIGHT,
    ),
    "meeting": (
        (2.0, 0.0, 0.0),
        (-2.0, 0.0, 0.0),
        0.1,
        0.2 * WEIGHT,
        0.2 * WEIGHT,
    ),
}


@pytest.mark.parametrize("case", GLIDING)
@pytest.mark.parametrize("level", [0, 2])
def test_what_tells_is_how_bodies_glide_along_each_other_where_they_touch(case, level, machine, device):
    *velocities, gap, here, later = GLIDING[case]
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for x, velocity in zip((0.0, 2.0 + gap), velocities, strict=True):
        ball = builder.add_body(xform=wp.transform(wp.vec3(x, 0.0, 0.0), wp.quat_identity()))
        builder.add_shape_sphere(ball, radius=1.0)
        builder.body_qd[ball] = (*velocity, 0.0, 0.0, 50.0)  # balls may turn
    model = builder.finalize(device=device)
    sizes = body_sizes(model)
    solver = RigidSolver(model, sizes)
    watched = machine.make_monitor(sizes.thickness, sizes.force_length, sizes.reach)
    watched.fill_counts = wp.array(solver.fills(), dtype=wp.uint64, device=device)
    watched.counts = wp.zeros(monitor.COUNT_CAPACITIES + len(solver.buffers), dtype=wp.int32, device=device)
    machine.set_status(stepping.STATUS_LEVEL, level)
    state = model.state()
    solver.collide(state, 0.4)
    for substep, where in ((1, monitor.PEAK_TRAVEL), (monitor.NEXT_SUBSTEP, monitor.PEAK_NEXT_TRAVEL)):
        watched.peaks.zero_()
        solver.watch(watched, state, substep=substep, longest=0.1 * 2**level, threshold=0.0)
        peaks = watched.peaks.numpy()
        other = monitor.PEAK_TRAVEL + monitor.PEAK_NEXT_TRAVEL - where
        assert peaks[where] == pytest.approx(here, rel=1e-3) and peaks[other] == 0.0
        assert peaks[monitor.PEAK_LONG_TRAVEL] == pytest.approx(2.0 * later, rel=1e-3)
        assert peaks[monitor.PEAK_FORCE_TRAVEL] == peaks[monitor.PEAK_LONG_TRAVEL]  # of balls
        assert peaks[monitor.PEAK_DEPTH] == pytest.approx(max(0.0, -gap), abs=1e-6)
    assert watched.counts.numpy()[monitor.COUNT_CAPACITIES + 1] == 1  # contacts


@pytest.mark.parametrize("level", [0, 2])
def test_what_tells_is_how_far_forces_pull(level, machine, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -3.0))
    ball = builder.add_body()
    builder.add_shape_sphere(ball, radius=0.5)
    builder.add_body(is_kinematic=True)  # which forces do not move
    model = builder.finalize(device=device)
    sizes = body_sizes(model)
    watched = machine.make_monitor(sizes.thickness, sizes.force_length, sizes.reach)
    machine.set_status(stepping.STATUS_LEVEL, level)
    state = model.state()
    forces = np.zeros((2, 6), dtype=np.float32)
    forces[:, 0] = 4.0 * model.body_mass.numpy()[0], 1e6
    state.body_f.assign(forces)
    monitor.watch_forces(watched, view_bodies(model, state), model.gravity, 0.1 * 2**level)
    pulled = 0.5 * 5.0 * 0.1**2 / 0.5  # 5 m/s² in 0.1 s
    peaks = watched.peaks.numpy()
    assert peaks[monitor.PEAK_TRAVEL] == pytest.approx(pulled, rel=1e-5)
    assert peaks[monitor.PEAK_LONG_TRAVEL] == pytest.approx(4.0 * pulled, rel=1e-5)
    assert peaks[monitor.PEAK_FORCE_TRAVEL] == peaks[monitor.PEAK_LONG_TRAVEL]  # of a ball


@pytest.mark.parametrize("moves", ["alone", "along a plate", "by a force"])
def test_a_sheet_may_move_by_more_than_its_thickness_while_forces_are_shared(moves, machine, device):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    plate = builder.add_shape_box(-1, hx=2.0, hy=2.0, hz=0.5, xform=wp.transform((0.0, 0.0, -0.5), wp.quat_identity()))
    sheet = builder.add_body(xform=wp.transform((0.0, 0.0, 0.0095), wp.quat_identity()))
    builder.add_shape_box(sheet, hx=1.0, hy=0.8, hz=0.01)
    builder.shape_flags[plate] = int(newton.ShapeFlags.COLLIDE_SHAPES) if moves == "along a plate" else 0
    if moves != "by a force":
        builder.body_qd[sheet] = (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)
    model = builder.finalize(device=device)
    sizes = body_sizes(model)
    watched = machine.make_monitor(sizes.thickness, sizes.force_length, sizes.reach)
    state = model.state()
    if moves == "by a force":
        forces = np.zeros((1, 6), dtype=np.float32)
        forces[0, 2] = 4.0 * model.body_mass.numpy()[0]
        state.body_f.assign(forces)
        monitor.watch_forces(watched, view_bodies(model, state), model.gravity, 0.1)
        moved = 4.0 * 0.5 * 4.0 * 0.1**2  # 4 m/s² in twice 0.1 s
    else:
        solver = RigidSolver(model, sizes)
        watched.fill_counts = wp.array(solver.fills(), dtype=wp.uint64, device=device)
        watched.counts = wp.zeros(monitor.COUNT_CAPACITIES + len(solver.buffers), dtype=wp.int32, device=device)
        solver.collide(state, 0.1)
        solver.watch(watched, state, substep=1, longest=0.1, threshold=0.0)
        moved = 2.0 * 0.2 * 0.1 * (WEIGHT if moves == "alone" else 1.0)
    peaks = watched.peaks.numpy()
    assert peaks[monitor.PEAK_LONG_TRAVEL] == pytest.approx(moved / 0.01, rel=1e-3)
    assert peaks[monitor.PEAK_FORCE_TRAVEL] == pytest.approx(moved / (1.0 * 0.8 * 0.01) ** (1 / 3), rel=1e-3)


SPANS = {  # speed of one of two balls [m/s], what else there is, and the distance over which forces on it vary [m]
    "slow": (0.9, None, 0.01),
    "fast": (20.0, None, 0.5 * (0.3 - 0.02)),
    "fast beside a coil": (20.0, "coil", 0.5 * (0.1 - 0.01 - 0.021)),
    "fast in a field map": (20.0, "map", 0.5 * 0.05),
    "fast and alone in a world": (20.0, "worlds", math.inf),
}


@pytest.mark.parametrize("case", SPANS)
def test_forces_on_a_fast_body_far_from_magnets_vary_over_a_longer_distance(case, machine, device):
    speed, more, expected = SPANS[case]
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    warpmag.register_custom_attributes(builder)
    for x, velocity in ((0.0, speed), (0.3, 0.0)):
        part = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        warpmag.register_custom_attributes(part)
        ball = part.add_body(xform=wp.transform((x, 0.0, 0.0), wp.quat_identity()))
        part.add_shape_sphere(ball, radius=0.01)
        warpmag.add_inducible(part, body=ball)
        part.body_qd[ball] = (velocity, 0.0, 0.0, 0.0, 0.0, 0.0)
        (builder.add_world if more == "worlds" else builder.add_builder)(part)
    if more == "coil":
        frame = wp.transform((0.0, 0.1, 0.0), wp.quat_identity())
        warpmag.add_coil(builder, radius=0.02, wire_radius=0.001, ampere_turns=1.0, xform=frame)
    if more == "map":
        nodes = np.ones((3, 3, 3, 3))
        warpmag.add_field_map(builder, origin=(0.0, 0.0, 0.0), spacing=(0.05, 0.06, 0.07), values=nodes)
    model = builder.finalize(device=device)
    sizes, magnets = body_sizes(model), warpmag.Magnetics(model).magnetic_shapes()
    watched = machine.make_monitor(sizes.thickness, sizes.force_length, sizes.reach)
    measure_force_spans(watched, view_bodies(model, model.state()), magnets, 0.01)
    np.testing.assert_allclose(watched.force_span.numpy(), [expected, 0.01], rtol=1e-5)  # the other ball is at rest
