"""JSON files, written whole or not at all, and output folders that a settings file claims for one job."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, Final

from handsim.errors import DatasetError, HandSimError
from handsim.files.atomic import atomic_write
from handsim.files.inputs import read_bytes

_MOST_JSON: Final = 1 << 26  # bytes


def save_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        DatasetError: The file does not hold a JSON object.
    """
    try:
        content = json.loads(read_bytes(path, error=DatasetError, most=_MOST_JSON))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is damaged: it does not hold JSON") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} is damaged: it does not hold a JSON object")
    return content


def claim(path: Path, settings: dict[str, Any], *, noun: str, error: type[HandSimError]) -> None:
    """Claim a folder by a settings file, or check that its settings are equal; clear what a killed run left.

    Raises:
        HandSimError: Of class `error`: the `noun` there has other settings, or something else is there.
    """
    out = path.parent
    if path.is_file():
        found, expected = load_json(path), json.loads(json.dumps(settings))
        differing = sorted(
            key for key in found.keys() | expected.keys() if found.get(key) != expected.get(key)
        )
        if differing:
            begun = f"{noun} begun with other settings ({', '.join(differing)})"
            raise error(f"{out} holds a {begun}; use them or another folder")
        for leftover in out.glob(".*.tmp-*"):
            if leftover.is_dir():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)
    elif out.exists() and not out.is_dir():
        raise error(f"{out} is a file, expected a folder")
    elif out.is_dir() and any(out.iterdir()):
        raise error(f"{out} is not empty and holds no {noun}; name another folder")
    else:
        save_json(path, settings)
