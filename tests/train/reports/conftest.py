"""Pages as they are."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def pages_without_pictures() -> None:
    """Here they have them."""
