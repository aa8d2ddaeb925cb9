"""The state machine of a step against its rules in Python."""

import numpy as np
import pytest
import warp as wp

from warpmag.kernels.rigid import monitor, stepping

TRAVEL, SHARED_TRAVEL, OVERLAP, EASE, FUTILE, FEWEST, CAPACITY = 0.25, 1.0, 0.008, 0.8, 0.8, 2, 100


class Rules:
    """What is to be decided about an attempt, written down once more."""

    def __init__(self):
        self.level = self.done = self.attempts = self.regrown = 0
        self.overlap, self.pressed_before, self.halt = 0.0, np.inf, "no"
        self.motion = 0.0  # in a substep of the first level

    @property
    def sharing(self):
        """Substeps that share forces: two at least, else what moves no farther than it may meanwhile."""
        fitting = [n for n in (2**k for k in range(self.level + 1)) if self.motion * n / 2**self.level <= SHARED_TRAVEL]
        return min(2**self.level, max([2, *fitting]))

    def judge(self, travel, long_travel, overlap, lost, fill):
        """Returns what becomes of the attempt, and the record of a step that is done."""
        self.attempts += 1
        motion = long_travel / 2 * 2**self.level
        if fill > CAPACITY:
            self.halt = "overflow"
            return "halted", None
        pressed = overlap > max(OVERLAP, self.overlap)
        helped = overlap < FUTILE * self.pressed_before
        if (travel > TRAVEL or (pressed and helped) or lost) and self.level < stepping.LEVELS - 1:
            self.motion = motion
            self.level += 1
            self.pressed_before = overlap if pressed else self.pressed_before
            return "again", None
        if lost:
            self.halt = "lost"
            return "halted", None
        record = (FEWEST * 2**self.level, self.attempts, travel > TRAVEL, self.regrown)
        self.done, self.attempts, self.regrown = self.done + 1, 0, 0
        self.overlap, self.pressed_before, self.motion = overlap, np.inf, motion
        if long_travel < EASE * TRAVEL and (overlap < 0.5 * OVERLAP or (pressed and not helped)) and self.level:
            self.level -= 1
        return "done", record


@pytest.fixture
def machine(device):
    limits = {"travel": TRAVEL, "shared_travel": SHARED_TRAVEL, "overlap": OVERLAP, "ease": EASE, "futile": FUTILE}
    machine = stepping.StepMachine(16, 1, device, **limits, fewest=FEWEST)
    machine.arrays.capacities.fill_(CAPACITY)
    return machine


def report(arrays, travel, long_travel, overlap, lost, fill):
    """Stand in for the monitor."""
    peaks, counts = arrays.peaks.numpy(), arrays.counts.numpy()
    assert (peaks == 0.0).all() and counts[monitor.COUNT_BAD_BODY] == monitor.NO_BODY
    peaks[[monitor.PEAK_TRAVEL, monitor.PEAK_LONG_TRAVEL]] = travel, long_travel
    peaks[[monitor.PEAK_OVERLAP, monitor.PEAK_ERROR]] = overlap, 0.125
    counts[monitor.COUNT_EVALUATIONS], counts[monitor.COUNT_CAPACITIES] = 7, fill
    if lost:
        counts[monitor.COUNT_BAD_BODY] = 3
    arrays.peaks.assign(peaks)
    arrays.counts.assign(counts)


def test_the_device_follows_the_rules(machine):
    arrays = machine.arrays
    rules, rng = Rules(), np.random.default_rng(7)
    seen, shared = set(), set()
    for _ in range(300):
        machine.begin_step()
        while machine.attempting.numpy()[0]:
            machine.begin_attempt()
            wanted = [machine.remaining[level].numpy()[0] for level in range(stepping.LEVELS)]
            assert wanted == [level == rules.level for level in range(stepping.LEVELS)]
            pairs = 0
            while machine.remaining[rules.level].numpy()[0]:
                if rules.level:
                    assert machine.sharing.numpy()[0] == rules.sharing
                    assert machine.forces_due.numpy()[0] == (2 * pairs % rules.sharing == 0)
                    shared.add((rules.level, rules.sharing))
                machine.end_pair(rules.level)
                pairs += 1
            assert 2 * pairs == FEWEST * 2**rules.level
            travel = np.float32(rng.choice([0.01, 0.08, 0.3]))
            long_travel = np.float32(travel * rng.uniform(2.0, 4.0))  # 0.2 is the limit of easing
            overlap = np.float32(rng.choice([0.001, 0.005, 0.01, 0.02], p=[0.6, 0.2, 0.1, 0.1]))
            lost, fill = rng.random() < 0.05, int(rng.choice([50, CAPACITY, 101], p=[0.8, 0.15, 0.05]))
            report(arrays, travel, long_travel, overlap, lost, fill)
            record_at = rules.done % 16
            outcome, record = rules.judge(float(travel), float(long_travel), float(overlap), lost, fill)
            machine.judge()
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
    machine.begin_attempt()
    work = wp.zeros(1 << 20, dtype=float, device=arrays.ticks.device)
    for _ in range(20):
        wp.copy(work, wp.ones_like(work))
    machine.mark(1)
    machine.mark(2)
    ticks = arrays.ticks.numpy().astype(float)
    assert ticks[0] == 0.0
    assert ticks[1] > 0.0


def test_arrays_of_any_type_are_copied_where_a_flag_stands(machine):
    arrays = machine.arrays
    rng = np.random.default_rng(1)
    for dtype, width in ((wp.transform, 7), (wp.spatial_vector, 6), (wp.float32, 1), (wp.vec3, 3)):
        values = rng.normal(size=(50, width)).astype(np.float32).squeeze()
        source = wp.array(values, dtype=dtype, device=arrays.flags.device)
        target = wp.zeros_like(source)
        for flag, expected in ((0, np.zeros_like(values)), (1, values)):
            arrays.flags.fill_(flag)
            machine.copy_where(stepping.FLAG_REJECTED, source, target)
            np.testing.assert_array_equal(target.numpy(), expected)
