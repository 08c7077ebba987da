"""A short form of `make fuzz`: 200 damaged files for every reader, and all that failed before."""

from __future__ import annotations

import pytest

from tests.fuzzing.engine import CORPUS, run, run_corpus
from tests.fuzzing.targets import TARGETS

CASES = 200


@pytest.mark.parametrize("name", TARGETS)
def test_a_damaged_file_ends_in_a_sentence(name, tmp_path):
    failures = [failure for failure in run(TARGETS[name], tmp_path, cases=CASES, seed=1) if failure]
    assert not failures, failures[0].what


@pytest.mark.parametrize("name", TARGETS)
def test_what_failed_before_is_told(name, tmp_path):
    failures = [failure for failure in run_corpus(TARGETS[name], tmp_path) if failure]
    assert not failures, failures[0].what


def test_the_corpus_is_of_targets():
    assert {path.name for path in CORPUS.iterdir() if path.is_dir()} <= set(TARGETS)
