"""The pages show the figures of the benchmark's data files, and these are of one commit for each machine."""

import pytest

from bench import page
from bench.report import read


@pytest.mark.parametrize("path", page.PAGES, ids=lambda path: path.name)
def test_tables_follow_from_the_data(path):
    """``python -m bench.page`` writes them."""
    text = path.read_text(encoding="utf-8")
    assert text == page.filled(text, page.machines())


def test_figures_of_a_machine_are_of_one_commit_and_in_the_history():
    known = {(line["commit"], line["device"]) for line in read([page.HISTORY])}
    for name, lines in page.machines().items():
        (commit,) = {line["commit"] for line in lines}
        assert (commit, name) in known
