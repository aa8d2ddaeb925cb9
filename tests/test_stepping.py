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
    buffers = stepping.allocate(16, 1, device)
    capacities = wp.array([CAPACITY], dtype=wp.int32, device=device)
    return buffers, stepping.Limits(TRAVEL, SHARED_TRAVEL, OVERLAP, EASE, FUTILE, FEWEST, capacities)


def report(buffers, travel, long_travel, overlap, lost, fill):
    """Stand in for the monitor."""
    peaks, counts = buffers.peaks.numpy(), buffers.counts.numpy()
    assert (peaks == 0.0).all() and counts[monitor.COUNT_BAD_BODY] == monitor.NO_BODY
    peaks[[monitor.PEAK_TRAVEL, monitor.PEAK_LONG_TRAVEL]] = travel, long_travel
    peaks[[monitor.PEAK_OVERLAP, monitor.PEAK_ERROR]] = overlap, 0.125
    counts[monitor.COUNT_EVALUATIONS], counts[monitor.COUNT_CAPACITIES] = 7, fill
    if lost:
        counts[monitor.COUNT_BAD_BODY] = 3
    buffers.peaks.assign(peaks)
    buffers.counts.assign(counts)


def test_the_device_follows_the_rules(machine):
    buffers, limits = machine
    rules, rng = Rules(), np.random.default_rng(7)
    seen, shared = set(), set()
    for _ in range(300):
        stepping.launch_begin_step(buffers)
        while buffers.attempting.numpy()[0]:
            stepping.launch_begin_attempt(limits, buffers)
            wanted = [buffers.remaining(level).numpy()[0] for level in range(stepping.LEVELS)]
            assert wanted == [level == rules.level for level in range(stepping.LEVELS)]
            pairs = 0
            while buffers.remaining(rules.level).numpy()[0]:
                if rules.level:
                    assert buffers.sharing.numpy()[0] == rules.sharing
                    assert buffers.forces_due.numpy()[0] == (2 * pairs % rules.sharing == 0)
                    shared.add((rules.level, rules.sharing))
                stepping.launch_end_pair(rules.level, buffers)
                pairs += 1
            assert 2 * pairs == FEWEST * 2**rules.level
            travel = np.float32(rng.choice([0.01, 0.08, 0.3]))
            long_travel = np.float32(travel * rng.uniform(2.0, 4.0))  # 0.2 is the limit of easing
            overlap = np.float32(rng.choice([0.001, 0.005, 0.01, 0.02], p=[0.6, 0.2, 0.1, 0.1]))
            lost, fill = rng.random() < 0.05, int(rng.choice([50, CAPACITY, 101], p=[0.8, 0.15, 0.05]))
            report(buffers, travel, long_travel, overlap, lost, fill)
            record_at = rules.done % 16
            outcome, record = rules.judge(float(travel), float(long_travel), float(overlap), lost, fill)
            stepping.launch_judge(limits, buffers)
            assert buffers.attempting.numpy()[0] == (outcome == "again")
            assert buffers.flags.numpy()[stepping.FLAG_REJECTED] == (outcome != "done")
            if record:
                logged = buffers.log.numpy()[record_at]
                fields = (stepping.LOG_SUBSTEPS, stepping.LOG_ATTEMPTS, stepping.LOG_CAPPED, stepping.LOG_REGROWN)
                assert tuple(logged[list(fields)]) == record
                assert logged[stepping.LOG_EVALUATIONS] == 7
                assert logged[int(stepping.LOG_PEAKS) + int(monitor.PEAK_TRAVEL)] == travel
                assert logged[int(stepping.LOG_PEAKS) + int(monitor.PEAK_ERROR)] == 0.125
            seen.add((outcome, rules.level))
        status = buffers.status.numpy()
        halts = {"no": stepping.RUNNING, "overflow": stepping.OVERFLOW, "lost": stepping.NOT_FINITE}
        assert status[stepping.STATUS_HALT] == halts[rules.halt]
        assert status[stepping.STATUS_DONE] == rules.done
        if rules.halt != "no":
            stepping.launch_begin_step(buffers)
            assert not buffers.attempting.numpy()[0]  # steps do nothing now
            stepping.launch_set_status(stepping.STATUS_HALT, stepping.RUNNING, buffers)
            stepping.launch_set_status(stepping.STATUS_REGROWN, 1, buffers)
            rules.halt, rules.regrown = "no", 1
    assert {level for _, level in seen} == set(range(stepping.LEVELS))
    assert {outcome for outcome, _ in seen} == {"done", "again", "halted"}
    assert shared > {(1, 2), (2, 2), (2, 4), (3, 2), (3, 4), (3, 8), (4, 2), (4, 4), (4, 8)}


def test_time_is_counted_for_the_stage_that_it_was_spent_in(machine):
    buffers, limits = machine
    stepping.launch_begin_attempt(limits, buffers)
    work = wp.zeros(1 << 20, dtype=float, device=buffers.ticks.device)
    for _ in range(20):
        wp.copy(work, wp.ones_like(work))
    stepping.launch_mark(1, buffers)
    stepping.launch_mark(2, buffers)
    ticks = buffers.ticks.numpy().astype(float)
    assert ticks[0] == 0.0
    assert ticks[1] > 0.0


def test_arrays_of_any_type_are_copied_where_a_flag_stands(machine):
    buffers, _ = machine
    rng = np.random.default_rng(1)
    for dtype, width in ((wp.transform, 7), (wp.spatial_vector, 6), (wp.float32, 1), (wp.vec3, 3)):
        values = rng.normal(size=(50, width)).astype(np.float32).squeeze()
        source = wp.array(values, dtype=dtype, device=buffers.flags.device)
        target = wp.zeros_like(source)
        for flag, expected in ((0, np.zeros_like(values)), (1, values)):
            buffers.flags.fill_(flag)
            stepping.launch_copy_where(stepping.FLAG_REJECTED, source, target, buffers)
            np.testing.assert_array_equal(target.numpy(), expected)
