"""JSON files, written whole or not at all, and output folders that a settings file claims for one job."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Collection, Iterator
from importlib import resources
from pathlib import Path
from typing import Any, Final

from handsim.errors import DatasetError, HandSimError, shortened
from handsim.files.inputs import read_bytes
from handsim.files.outputs import atomic_write, remove_leftovers

_MOST_SHOWN: Final = 4  # settings that a message lists
_MISSING: Final = "nothing"
_MOST_JSON: Final = 1 << 26  # bytes


def save_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file, whole or not at all; JSON knows no NaN and no infinity, which become null."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """The same, with None for what is not finite."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def load_json(path: Path) -> dict[str, Any]:
    """Read a JSON object."""
    try:
        content = json.loads(read_bytes(path, error=DatasetError, most=_MOST_JSON))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is damaged: it does not hold JSON") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} is damaged: it does not hold a JSON object")
    return content


@functools.cache
def package_data(package: str, name: str) -> dict[str, Any]:
    """A JSON file of a package's own data."""
    text = resources.files(package).joinpath(f"data/{name}.json").read_text(encoding="utf-8")
    data: dict[str, Any] = json.loads(text)
    return data


def claim(
    path: Path,
    settings: dict[str, Any],
    *,
    noun: str,
    error: type[HandSimError],
    grows: str = "",
    free: Collection[str] = (),
    result: Path | None = None,
    shown: str = "",
) -> None:
    """Claim a folder by a settings file, or check that its settings are equal; clear what a killed run left.

    Args:
        path: The settings file; its folder is claimed.
        settings: What decides the content of the folder.
        noun: What the folder holds, for messages.
        grows: A setting, written like `train.samples`, that may be larger than in the file; the file then
            takes the new settings.
        free: Settings that may differ or be missing, because the content does not depend on them.
        result: A file that is true for the old settings only; it is removed before they change.
        shown: The folder's name in messages, where it stands for another.

    Raises:
        HandSimError: Of class `error`: the `noun` there has other settings, or something else is there.
    """
    out, shown = path.parent, shown or str(path.parent)
    if path.is_file():
        found, expected = _flat(load_json(path)), _flat(json.loads(json.dumps(settings)))
        keys = sorted((found.keys() | expected) - set(free))
        differing = [key for key in keys if not _same(found, expected, key)]
        grown = differing == [grows] and _is_larger(expected.get(grows), found.get(grows))
        if differing and not grown:
            raise error(
                f"{shown} holds a {noun} begun with other settings ({_told(differing, found, expected)}); "
                f"use them or another folder{_hint(grows, differing)}"
            )
        remove_leftovers(out)
        if grown:
            if result is not None:
                result.unlink(missing_ok=True)
            save_json(path, settings)
    elif out.exists() and not out.is_dir():
        raise error(f"{out} is a file, expected a folder")
    elif out.is_dir() and any(entry.name not in _begun(path) for entry in out.iterdir()):
        raise error(f"{out} is not empty and holds no {noun}; name another folder")
    else:
        if out.is_dir():
            remove_leftovers(out)
        save_json(path, settings)


def _begun(path: Path) -> set[str]:
    """What a run leaves that was killed while it wrote its settings file."""
    return {entry.name for entry in path.parent.glob(f".{path.stem}.tmp-*")}


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Settings by their path of names, `train.network.width`; lists are values."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict) and value:
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _same(found: dict[str, Any], expected: dict[str, Any], key: str) -> bool:
    return key in found and key in expected and bool(found[key] == expected[key])


def _is_larger(new: object, old: object) -> bool:
    return isinstance(new, int) and isinstance(old, int) and new > old


def _told(differing: Collection[str], found: dict[str, Any], expected: dict[str, Any]) -> str:
    """The settings that differ, with both values."""

    def pairs() -> Iterator[str]:
        for key in list(differing)[:_MOST_SHOWN]:
            yield f"{key}: {_shown(found, key)} there, {_shown(expected, key)} here"

    more = len(differing) - _MOST_SHOWN
    return "; ".join(pairs()) + (f"; and {more} more" if more > 0 else "")


def _shown(settings: dict[str, Any], key: str) -> str:
    return shortened(json.dumps(settings[key], ensure_ascii=False)) if key in settings else _MISSING


def _hint(grows: str, differing: Collection[str]) -> str:
    """A word about the one setting that may grow, where that is what differs."""
    return f" ({grows} may only grow)" if grows and list(differing) == [grows] else ""
