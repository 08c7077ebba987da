"""Golden error sentences: `HANDSIM_RENEW_GOLDEN=1 pytest tests/gloves` writes them anew; read the diff."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent.parent / "golden"


@pytest.fixture
def golden() -> Callable[[str, dict[str, str]], None]:
    def check(name: str, actual: dict[str, str]) -> None:
        path = GOLDEN / f"{name}.json"
        if os.environ.get("HANDSIM_RENEW_GOLDEN") == "1":
            path.write_text(json.dumps(actual, indent=2, ensure_ascii=False) + "\n", "utf-8")
        assert actual == json.loads(path.read_text("utf-8"))

    return check
