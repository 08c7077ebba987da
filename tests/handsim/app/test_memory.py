"""handsim.app.memory: refusing what the machine cannot hold."""

import os

import pytest

from handsim.app.memory import available_bytes, check_memory
from handsim.errors import ArgumentError


def test_free_memory_is_less_than_what_is_built_in():
    built_in = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < available_bytes() <= built_in


def test_what_does_not_fit_is_refused_with_both_sizes():
    check_memory(1000, "1 frames", "ask for fewer frames")
    with pytest.raises(ArgumentError, match=r"^5 frames need 1e\+03 EB of memory, but .* are free; ask for"):
        check_memory(10**21, "5 frames", "ask for fewer frames")
