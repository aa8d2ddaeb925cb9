"""Times and errors over the number of moments: lines of both ways and of peers, and their picture."""

import json
import sys

import numpy as np
import pytest

from bench import many
from bench.peers import Evaluation, Peer
from bench.timing import measure


def exact(positions, charges, device):
    """A peer that is exact."""
    return Evaluation(lambda: None, lambda: None, lambda: many.field_of_charges(positions, charges, range(729)))


def test_both_ways_and_peers(tmp_path, device, monkeypatch, capsys):
    monkeypatch.setattr(many, "RTOLS", (None, 1e-3))
    monkeypatch.setattr(many, "measure", lambda work, device: measure(work, device, seconds=0.01))
    kinds = "cpu", "cuda"
    peers = [Peer(name, f"with_{name}", "", kinds, charges=True) for name in ("nothing", "exact")]
    monkeypatch.setattr(many, "PEERS", peers)
    monkeypatch.setitem(sys.modules, "bench.peers.with_exact", sys.modules[__name__])
    many.main(["--device", device, "--sizes", "729", "--peers", "nothing", "exact", "-o", str(tmp_path / "lines")])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    own, (missing, single) = lines[:4], lines[4:]
    expected = [(q, m) for q in ("field", "wrench") for m in ("direct", "fmm")]
    assert [(line["quantity"], line["method"]) for line in own] == expected
    for line in own:
        assert line["seconds"] > 0.0
        # sums of 729 terms in float32, and what multipoles are allowed
        assert line["error"] < (4e-5 if line["method"] == "direct" else 1e-3)
        assert line["error"] <= line["largest_error"]
    assert "with_nothing" in missing["failed"]
    assert single["error"] == 0.0
    many.main(["--draw", str(tmp_path / "lines"), "-o", str(tmp_path / "lines.png")])
    assert (tmp_path / "lines.png").stat().st_size > 10_000


def test_field_of_charges():
    """Of two of them by hand: 1/4πr² along the line between them."""
    field = many.field_of_charges(np.array([[0.0, 0, 0], [0, 0, 2.0]]), np.array([3.0, 5.0]), [0, 1])
    assert field == pytest.approx(np.array([[0, 0, -5.0], [0, 0, 3.0]]) / (16.0 * np.pi))
