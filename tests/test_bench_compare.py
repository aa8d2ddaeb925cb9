"""The comparison with peers and its report: lines that agree with the oracle, peers that are missing, pictures."""

import json

import pytest

from bench import compare, report
from bench.peers import Peer


@pytest.fixture
def lines(tmp_path, device, monkeypatch, capsys):
    """Lines of two peers at two sizes, and of one that is not there, twice in the file."""
    monkeypatch.setattr(compare, "PEERS", (*compare.PEERS, Peer("nothing", "with_nothing", "", ("cpu", "cuda"))))
    arguments = ["--device", device, "--sizes", "70", "130", "--seconds", "0.01", "-o", str(tmp_path / "lines.jsonl")]
    for _ in range(2):
        compare.main([*arguments, "--peers", "warpmag", "warp_plain", "nothing"])
    printed = capsys.readouterr().out
    assert (tmp_path / "lines.jsonl").read_text() == printed
    return [json.loads(line) for line in printed.splitlines()]


def test_peers_agree_with_the_oracle(lines):
    measured = [line for line in lines if "failed" not in line]
    assert {(line["peer"], line["count"]) for line in measured} == {
        (peer, count) for peer in ("warpmag", "warp_plain") for count in (70, 130)
    }
    # sums of 130 terms in float32 carry less than 130·2⁻²⁴
    assert all(line["error"] < 8e-6 and line["seconds"] > 0.0 for line in measured)


def test_a_missing_peer_says_so_and_is_not_asked_again(lines):
    missing = [line for line in lines if line["peer"] == "nothing"]
    assert [line["count"] for line in missing] == [70, 70]
    assert all("with_nothing" in line["failed"] for line in missing)


def test_report(lines, tmp_path):
    report.main([str(tmp_path / "lines.jsonl"), "-o", str(tmp_path / "report")])
    text = (tmp_path / "report" / "report.md").read_text()
    assert text.count("| warpmag | 130 |") == 1  # the later of two runs
    assert "| nothing | 70 | ModuleNotFoundError" in text
    pictures = ["pareto", "roofline"] if report.limit_of(lines[0]) else ["pareto"]
    assert [path.stem.rpartition("_")[2] for path in sorted((tmp_path / "report").glob("*.png"))] == pictures
    assert all(path.stat().st_size > 10_000 for path in (tmp_path / "report").glob("*.png"))
