"""Space is asked for before the work."""

from __future__ import annotations

import pytest

from handsim.errors import DatasetError
from handsim.files.disk import check_free, shown_bytes


def test_what_does_not_fit_is_refused(tmp_path):
    check_free(tmp_path / "new" / "set", 10, "2 frames", "ask for fewer", error=DatasetError)
    with pytest.raises(
        DatasetError, match=r"2 frames need 1 EB, but the disk of .*set has .* free; ask for fewer or"
    ):
        check_free(tmp_path / "new" / "set", 10**18, "2 frames", "ask for fewer", error=DatasetError)


@pytest.mark.parametrize(("count", "text"), [(0, "0 bytes"), (1234, "1.23 kB"), (7.01e11, "701 GB")])
def test_bytes_with_units(count, text):
    assert shown_bytes(count) == text
