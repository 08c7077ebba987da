from __future__ import annotations

import pytest

from gloves.attach import Attachment, attach
from gloves.layout import load_layout
from handsim.errors import HandSimError
from handsim.model import HandModel


@pytest.fixture(scope="session")
def drawing() -> None:
    """Skips where nothing can be drawn."""
    from render._gl import offscreen_renderer

    try:
        offscreen_renderer(16, 16)
    except HandSimError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def model() -> HandModel:
    return HandModel.named("M")


@pytest.fixture(scope="session")
def attachment(model: HandModel) -> Attachment:
    return attach(load_layout("dense19"), model)
