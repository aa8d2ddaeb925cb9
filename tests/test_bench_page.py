"""The pages show the figures of the benchmark's data files, and these are of one commit for each machine."""

import re

from bench import page
from bench.report import read

TIME = re.compile(r"\d (?:µs|ms|s)\b")
OTHER = {"benchmarks.md", "report.md"}
"""The page of benchmarks itself, and the paper's figures beside a rerun."""


def test_tables_and_quoted_figures_follow_from_the_data():
    """``python -m bench.page`` writes them."""
    data = page.machines()
    for path in page.PAGES:
        text = path.read_text(encoding="utf-8")
        assert text == page.filled(text, data), f"{path}: run python -m bench.page"
        broken = re.search(r"^<!-- benchmark: \w+ -->.", text, re.MULTILINE)
        assert not broken, f"{path}: a comment at the start of a line ends the paragraph"


def test_times_of_benchmarked_sizes_are_quoted_from_the_data():
    """A time at a size that the page of benchmarks has for the GPU stands between the comments of ``bench.page``."""
    lines = page.machines()["NVIDIA H200"]
    sizes = {f"{line['count']:,}" for line in lines if line["case"] in ("compare", "many")}
    assert len(sizes) >= 3
    for path in [*page.PAGES, page.ROOT / "bench" / "README.md"]:
        own = "" if path.name in OTHER else page.QUOTED.sub("", path.read_text(encoding="utf-8"))
        wrong = [line for line in own.splitlines() if TIME.search(line) and any(size in line for size in sizes)]
        assert wrong == [], f"{path}: times that bench.page does not write"


def test_figures_of_a_machine_are_of_one_commit_and_in_the_history():
    known = {(line["commit"], line["device"]) for line in read([page.HISTORY])}
    for name, lines in page.machines().items():
        (commit,) = {line["commit"] for line in lines}
        assert (commit, name) in known
