"""Buffers that calls on arrays keep for the next call of the same shape do not affect results."""

import subprocess
import sys
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import warp as wp
from arrangements import overlapping

import warpmag
from warpmag.moments import pair_sums


def _call(device, seed, *, radii=True, targets=False, moved=0.0):
    """Arguments of a field of 600 overlapping balls; the largest radius is fixed."""
    x, _, m = overlapping(count=600, extent=0.07, seed=seed)
    x = x + moved * np.random.default_rng(0).normal(size=x.shape)
    radius = np.random.default_rng(seed).uniform(0.003, 0.01, len(x))
    radius[seed] = 0.01
    options = {"device": device, "radii": radius if radii else None}
    if targets:
        options |= {"targets": x[:200] + 0.002, "target_radii": 0.003}
    return (x, m), options


@pytest.mark.parametrize("targets", [False, True])
def test_a_call_is_as_if_it_were_the_first(targets, device):
    """Positions, moments, radii and overlaps of earlier calls do not affect results."""
    calls = [_call(device, seed, radii=seed != 2, targets=targets) for seed in (1, 2, 3)]
    calls.append(_call(device, 3, targets=targets, moved=5e-4))  # other neighbors overlap
    alone = []
    for arguments, options in calls:
        pair_sums._cache.clear()
        alone.append(warpmag.h_field(*arguments, **options))
    pair_sums._cache.clear()
    for k in (0, 2, 3, 1, 0, 1, 3, 2):
        arguments, options = calls[k]
        assert warpmag.h_field(*arguments, **options).tobytes() == alone[k].tobytes()
    assert len(pair_sums._cache) == (2 if device == "cpu" else 0)


def test_wrenches_of_calls_that_follow_each_other(device):
    """Calls with different external fields."""
    (x, m), options = _call(device, 1)
    results = []
    for field in ((0.0, 0.0, 1e4), None):
        pair_sums._cache.clear()
        results.append(warpmag.wrench(x, m, external_field=field, **options))
    again = warpmag.wrench(x, m, external_field=(0.0, 0.0, 1e4), **options)
    assert [a.tobytes() for a in again] == [a.tobytes() for a in results[0]]
    assert not np.allclose(results[0][1], results[1][1], rtol=1e-3, atol=0.0)


def test_results_are_the_callers_own(device):
    """Results, NumPy or Warp, belong to the caller: later calls neither change nor read them."""
    (x, m), options = _call(device, 1)
    first = warpmag.h_field(x, m, **options)
    kept = first.copy()
    places = wp.array(x, dtype=wp.vec3, device=device)
    vectors = warpmag.h_field(places, m, **options)
    warpmag.h_field(x, 2.0 * m, **options)
    assert first.tobytes() == vectors.numpy().tobytes() == kept.tobytes()
    first[:], vectors = np.nan, vectors.fill_(np.nan)
    assert warpmag.h_field(x, m, **options).tobytes() == kept.tobytes()


def test_a_call_that_fails(device):
    """A call that raises an error does not affect later calls."""
    (x, m), options = _call(device, 1)
    expected = warpmag.h_field(x, m, **options)
    with pytest.raises(warpmag.InputError, match="not finite"):
        warpmag.h_field(1e-6 * x, 1e35 * m, device=device)
    with pytest.raises(warpmag.InputError, match="radii"):
        warpmag.h_field(x, m, radii=np.full(599, options["radii"].max()), device=device)
    assert warpmag.h_field(x, m, **options).tobytes() == expected.tobytes()


def test_calls_of_several_threads(device):
    """Threads do not share buffers. On a GPU in a separate process: Warp 1.19 cannot capture graphs afterwards."""
    if device == "cpu":
        call_from_threads(device)
        return
    program = f"import test_pair_sums; test_pair_sums.call_from_threads({str(device)!r})"
    done = subprocess.run([sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def call_from_threads(device):
    calls = [_call(device, seed, radii=False) for seed in range(4)]
    alone = [warpmag.h_field(*arguments, **options).tobytes() for arguments, options in calls]
    wrong = []

    def repeat(k):
        arguments, options = calls[k]
        wrong.extend(k for _ in range(20) if warpmag.h_field(*arguments, **options).tobytes() != alone[k])

    threads = [Thread(target=repeat, args=[k]) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_large_sums_are_not_kept(device, monkeypatch):
    """Few buffers are kept."""
    monkeypatch.setattr(pair_sums, "_MOST_CACHED_MOMENTS", 100)
    pair_sums._cache.clear()
    for count in (80, 81, 82, 83, 84, 85, 101, 150):
        warpmag.h_field(np.random.default_rng(1).normal(size=(count, 3)), np.ones((count, 3)), device=device)
    assert [shape.count for shape in pair_sums._cache] == ([82, 83, 84, 85] if device == "cpu" else [])
