"""The file of a sweep: what is varied, and the settings of everything else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from handsim.errors import FileError, HandSimError
from handsim.files.atomic import read_toml
from handsim.files.toml_values import check_keys, shown

TABLES: Final[tuple[str, ...]] = ("generate", "train", "simulate", "track")
"""Tables of settings, named after the commands that have them."""
_LISTED: Final = {"glove": "gloves", "seed": "seeds and people"}
"""Settings that have a list of their own, in all tables."""
_LISTS: Final = ("gloves", "rigs", "people", "seeds")
_MOST: Final = 1000  # values of a list


class SweepError(FileError):
    """A file that describes no sweep, or a folder that holds something else than its results."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """What a sweep varies, and the settings that all its cells share."""

    gloves: tuple[str, ...] = ("dense19",)
    """Marker layouts: shipped names or paths of .toml files."""
    rigs: tuple[str, ...] = ("figure5",)
    """Camera rigs likewise, for training sets and captures."""
    people: tuple[int, ...] = (0,)
    """Seeds of the captures: each is another person in motion."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of training sets and trainings."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Settings by table, see `TABLES`; a labeler is trained if there is one for `train`, and captures are
    tracked if there is one for `track`."""
    vary: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    """Values of any other setting, by its path of names: `train.rig_share`."""


def load_sweep(path: Path) -> Sweep:
    """Read the file of a sweep; gloves and rigs that are files are looked for beside it.

    Raises:
        SweepError: The file cannot be read, or describes no sweep.
    """
    table = read_toml(path, error=SweepError)
    try:
        check_keys(table, "the sweep", (*_LISTS, *TABLES, "vary"), optional=(*_LISTS, *TABLES, "vary"))
        settings = {key: _settings(table, key) for key in TABLES if key in table}
        if "generate" in settings and "train" not in settings:
            raise HandSimError("[generate] has no use without [train], which trains on it")
        seeds = _integers(table, "seeds")
        if len(seeds) > 1 and "train" not in settings:
            raise HandSimError("seeds are of trainings, and there is no [train]; people varies captures")
        vary = {key: _values(key, value) for key, value in _table(table, "vary").items()}
        for key in vary:
            _check_varied(key, settings)
        return Sweep(
            gloves=_files(table, "gloves", path.parent, ("dense19",)),
            rigs=_files(table, "rigs", path.parent, ("figure5",)),
            people=_integers(table, "people"),
            seeds=seeds,
            settings=settings,
            vary=vary,
        )
    except HandSimError as error:
        raise SweepError(f"{path}: {error}") from error


def _table(table: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = table.get(key, {})
    if not isinstance(value, dict):
        raise HandSimError(f"{key} is {shown(value)}, expected a table [{key}]")
    return value


def _settings(table: Mapping[str, Any], key: str) -> dict[str, Any]:
    """A table of settings, without those that have a list of their own."""
    settings = _table(table, key)
    for name in settings:
        _check_unlisted(name, f"[{key}] {name}")
    return settings


def _check_unlisted(name: str, shown_name: str) -> None:
    if name in _LISTED:
        raise HandSimError(f"{shown_name} is given, expected the list {_LISTED[name]} at the top")


def _check_varied(key: str, settings: Mapping[str, Any]) -> None:
    """Refuse a setting of no table."""
    first, _, rest = key.partition(".")
    if first not in TABLES or not rest:
        raise HandSimError(
            f"[vary] has the key '{key[:200]}', expected a setting's name after its table's, in quotes: "
            '"train.rig_share"'
        )
    if first not in settings and first != "simulate":
        raise HandSimError(f"[vary] has the key '{key[:200]}', but there is no table [{first}]")
    _check_unlisted(rest, f"[vary] {key}")


def _values(owner: str, value: object) -> tuple[Any, ...]:
    """A list with something in it, nothing twice."""
    if not isinstance(value, list) or not 1 <= len(value) <= _MOST:
        raise HandSimError(f"{owner} is {shown(value)}, expected a list of one value or more")
    twice = [one for number, one in enumerate(value) if one in value[:number]]
    if twice:
        raise HandSimError(f"{owner} has {shown(twice[0])} twice")
    return tuple(value)


def _integers(table: Mapping[str, Any], key: str) -> tuple[int, ...]:
    """A list of seeds."""
    values = _values(key, table.get(key, [0]))
    for value in values:
        if type(value) is not int or not 0 <= value < 1 << 31:
            raise HandSimError(f"{key} has {shown(value)}, expected whole numbers, 0 or more")
    return values


def _files(table: Mapping[str, Any], key: str, folder: Path, default: tuple[str, ...]) -> tuple[str, ...]:
    """A list of shipped names and files; paths of files begin at a folder."""
    values = _values(key, table.get(key, list(default)))
    for value in values:
        if not isinstance(value, str):
            raise HandSimError(f"{key} has {shown(value)}, expected names in quotes")
    return tuple(str(folder / value) if value.endswith(".toml") else value for value in values)
