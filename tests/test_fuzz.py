"""Stages spoiled at random: each ends in one line, or in a run that says what the stage says."""

import pytest
from fuzz.campaign import BAD_INPUT, in_process, judge, make
from fuzz.sources import author

COUNT, SEED = 60, 20


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    return author(tmp_path_factory.mktemp("sources"))


def test_mutants_repeat(sources, tmp_path):
    for number in range(0, COUNT, 13):
        made = []
        for name in ("once", "again"):
            folder = tmp_path / f"{name}{number}"
            folder.mkdir()
            path, _, done = make(number, SEED, folder, sources)
            made.append((done, path.read_bytes()))
        assert made[0] == made[1]


def test_spoiled_stages_are_refused_or_run(device, sources, tmp_path):
    verdicts = [judge(number, SEED, tmp_path, sources, in_process, device) for number in range(COUNT)]
    assert [(one.number, one.done, one.problems) for one in verdicts if one.problems] == []
    refused = sum(one.run == BAD_INPUT for one in verdicts)
    assert COUNT // 5 < refused < COUNT  # the mutator does neither too little nor too much
