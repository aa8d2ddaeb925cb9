"""Kernels of a step by their time."""

from types import SimpleNamespace

import pytest

from bench import kernels


def test_names_counts_and_times():
    names = "forward kernel add_0f9a8b7c", "forward kernel warpmag.rigid.bodies.move", "forward kernel add_00000000"
    results = [SimpleNamespace(name=name, elapsed=time) for name, time in zip(names, (1.0, 3.0, 4.0), strict=True)]
    line = kernels.by_kernel(results, 2)
    assert line["kernels"] == {"add": [1.0, 2.5], "warpmag.rigid.bodies.move": [0.5, 1.5]}
    assert (line["launches"], line["sum_ms"]) == (1.5, pytest.approx(4.0))
