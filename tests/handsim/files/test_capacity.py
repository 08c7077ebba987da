"""Space and memory are asked for before the work."""

from __future__ import annotations

import os

import pytest

from handsim.errors import ArgumentError, DatasetError
from handsim.files.capacity import available_bytes, check_free, check_memory, shown_bytes


def test_what_does_not_fit_is_refused(tmp_path):
    check_free(tmp_path / "new" / "set", 10, "2 frames", "ask for fewer", error=DatasetError)
    with pytest.raises(
        DatasetError, match=r"2 frames need 1 EB, but the disk of .*set has .* free; ask for fewer or"
    ):
        check_free(tmp_path / "new" / "set", 10**18, "2 frames", "ask for fewer", error=DatasetError)


@pytest.mark.parametrize(("count", "text"), [(0, "0 bytes"), (1234, "1.23 kB"), (7.01e11, "701 GB")])
def test_bytes_with_units(count, text):
    assert shown_bytes(count) == text


def test_free_memory_is_less_than_what_is_built_in():
    built_in = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < available_bytes() <= built_in


def test_memory_that_is_not_there_is_refused_with_both_sizes():
    check_memory(1000, "1 frames", "ask for fewer frames")
    with pytest.raises(ArgumentError, match=r"^5 frames need 1e\+03 EB of memory, but .* are free; ask for"):
        check_memory(10**21, "5 frames", "ask for fewer frames")
