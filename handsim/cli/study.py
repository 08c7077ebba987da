"""Studies: a command over several files, folders or a table of files; finished files are skipped.

`study.json` in the folder of the outputs records the settings of each output, and checksums of its input
files. Dates of files are ignored. The entries of the table on a person are recorded for the next command of
the study.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from gloves.captures.formats import READABLE, find_captures
from handsim._checks import check_choice
from handsim._version import provenance
from handsim.app.messages import print_line, show_state
from handsim.errors import ArgumentError, CaptureError, HandSimError, errors_of
from handsim.files.inputs import check_regular, checksum, load_json, read_bytes, text_encoding
from handsim.files.outputs import check_outputs, save_json
from handsim.hand.shape import SIDES

RECORD: Final = "study.json"
COLUMNS: Final = ("capture", "person", "session", "side", "glove", "neutral", "shape")
"""Columns of a study's table; all but the first may be missing or blank."""
_PATH_COLUMNS: Final = ("capture", "glove", "neutral", "shape")
_TABLE_ENDINGS: Final = (".csv", ".tsv")
_MAX_HEADER_BYTES: Final = 4096  # bytes
_MAX_TABLE_BYTES: Final = 1 << 24  # largest size of a study's table [bytes]


@dataclass(frozen=True, slots=True)
class StudyFile:
    """A capture or take of a study."""

    source: Path
    name: Path
    """The name of its outputs in their folder, but for the ending."""
    cells: Mapping[str, str]
    """Cells of its row in the table by `COLUMNS`, without blank ones; paths are absolute."""

    def options(self, **given: Any) -> dict[str, Any]:
        """Options of a command (`glove`, `hands`, `shape`), replaced by the entries of the table."""
        own: dict[str, Any] = dict(self.cells)
        if "side" in own:
            own["hands"] = (own["side"],)
        if "shape" in own:
            own["shape"] = Path(own["shape"])
        return {name: own.get(name, value) for name, value in given.items()}


class Step(NamedTuple):
    """The outputs, inputs and options of a command on one file of a study."""

    outputs: tuple[Path, ...]
    inputs: tuple[object, ...]
    """Files that it reads beside its source; entries that are not files are ignored."""
    options: dict[str, Any]
    """Keyword arguments of the command beside `out`, the first output."""


def is_study(sources: Sequence[Path], out: Path | None) -> bool:
    """Whether a command has anything but one file to read and one file to write."""
    folder = out is not None and out.is_dir()
    return len(sources) != 1 or folder or sources[0].is_dir() or _is_table(sources[0])


def study_files(
    sources: Sequence[Path], out: Path | None, written: Sequence[str], endings: Sequence[str] = READABLE
) -> list[StudyFile]:
    """The files of a study, whose outputs have the endings `written`, from files, folders and tables."""
    if out is None or (sources and out.suffix.lower() in written and not out.is_dir()):
        meant = f"; did you mean --out {sources[-1]}?" if out is None and not sources[-1].exists() else ""
        raise ArgumentError(f"--out is {out} for several captures, expected a folder{meant}")
    files = list[StudyFile]()
    for given in sources:
        if given.is_dir():
            # A folder may hold what an earlier command wrote.
            earlier = out.resolve() if given.resolve() in out.resolve().parents else None
            found = [*_recorded_files(given, endings)] or [
                StudyFile(file, file.relative_to(given), {}) for file in find_captures([given], endings)
            ]
            files += [file for file in found if earlier not in file.source.resolve().parents]
        else:
            files += _table_files(given) if _is_table(given) else [StudyFile(given, Path(given.name), {})]
    if not files:
        raise ArgumentError(f"no capture outside of {out} is given, expected files or folders")
    counts = Counter(file.name for file in files)
    return [_named_by_side(file) if counts[file.name] > 1 else file for file in files]


def run_study(
    files: Sequence[StudyFile],
    out: Path,
    make: Callable[..., object],
    plan: Callable[[StudyFile], Step],
    done: str,
    on_end: Callable[[list[Step]], object] | None = None,
) -> None:
    """Make the outputs of each file, unless they exist and were made with the same inputs and settings.

    Args:
        files: The files of the study.
        out: The folder of their outputs.
        make: The command for one file, `make((source,), out=..., **options)`.
        plan: The work on a file.
        done: The participle of the command, such as "tracked".
        on_end: Called with the steps whose outputs are there.

    Raises:
        CaptureError: Files were not read or used; the message names them, and the others are done.
    """
    steps = [plan(file) for file in files]
    inputs = [[file.source, *step.inputs] for file, step in zip(files, steps, strict=True)]
    outputs = [out / RECORD, *(one for step in steps for one in step.outputs)]
    check_outputs([one for read in inputs for one in read], outputs)
    record = load_json(out / RECORD) if (out / RECORD).is_file() else {"outputs": {}}
    entries: dict[str, Any] = record["outputs"]
    own = {file.source.resolve(): _step_key(out, step) for file, step in zip(files, steps, strict=True)}
    record["study"] = [_step_key(out, step) for step in steps]
    there, bad, made = list[Step](), list[str](), 0
    for file, step, read in zip(files, steps, inputs, strict=True):
        cells = {**file.cells}
        if "neutral" in cells:
            cells["neutral"] = own.get(Path(cells["neutral"]).resolve(), cells["neutral"])
        key = _step_key(out, step)
        old = entry = entries.pop(key, {})
        settings = json.loads(json.dumps(step.options, default=_plain_option))
        made_of = {"settings": settings, "inputs": _checksums(read)}
        try:
            if {**entry, **made_of} != entry or entry["sums"] != _checksums(step.outputs):
                show_state(str(file.source))  # whose the next warnings are
                make((file.source,), out=step.outputs[0], **step.options)
                made += 1
                names = [one.relative_to(out).as_posix() for one in step.outputs]
                entry = {**made_of, **provenance(), "names": names, "sums": _checksums(step.outputs)}
            entries[key] = {**entry, "cells": cells}
            there.append(step)
        except HandSimError as error:
            bad.append(str(file.source))
            show_state(f"{file.source}: not {done}: {str(error).removeprefix(f'{file.source}: ')}")
        if entries.get(key, {}) != old:
            save_json(out / RECORD, record)
    if there or (out / RECORD).is_file():
        save_json(out / RECORD, record)
    if on_end is not None:
        on_end(there)
    print_line(f"{out}: {made} files {done} now, {len(there) - made} before")
    if bad:
        raise CaptureError(f"{len(bad)} of {len(files)} files were not {done}: {', '.join(bad)}")


def _step_key(out: Path, step: Step) -> str:
    """The name of a step in the record."""
    return step.outputs[0].relative_to(out).as_posix()


def _plain_option(value: Any) -> Any:
    """Options as JSON."""
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)  # type: ignore[arg-type]


def _checksums(files: Sequence[object]) -> list[str]:
    """The checksums of files, and of the files in folders and below these."""
    paths = [Path(one) for one in files if isinstance(one, str | Path)]
    inside = [one for path in paths for one in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    return [checksum(one) for one in inside if one.is_file() and os.access(one, os.R_OK)]


def _named_by_side(file: StudyFile) -> StudyFile:
    """A file with the side in the names of its outputs, because the table has its capture more than once."""
    side = file.cells.get("side")
    name = file.name.with_stem(f"{file.name.stem}-{side}") if side else file.name
    return dataclasses.replace(file, name=name)


def _recorded_files(folder: Path, endings: Sequence[str]) -> Iterator[StudyFile]:
    """The outputs of the last command of a study in a folder."""
    record = load_json(folder / RECORD) if (folder / RECORD).is_file() else {"study": []}
    for key in record["study"]:
        entry = record["outputs"].get(key, {"names": [], "cells": {}})
        cells = {**entry["cells"]}
        if "neutral" in cells:
            cells["neutral"] = str(folder / cells["neutral"])
        for name in entry["names"]:
            if Path(name).suffix in endings:
                yield StudyFile(folder / name, Path(name), cells)


def _is_table(path: Path) -> bool:
    """Whether a file is the table of a study, whose first line names a column `capture`."""
    if path.suffix.lower() not in _TABLE_ENDINGS or not path.is_file():
        return False
    check_regular(path, error=CaptureError)
    with path.open("rb") as file:
        line = file.readline(_MAX_HEADER_BYTES)
    return COLUMNS[0] in _header(line.decode(text_encoding(line), "ignore"))


def _header(line: str) -> list[str]:
    """The columns of a table's first line."""
    return [cell.strip().strip('"').lower() for cell in line.split(_separator(line))]


def _separator(line: str) -> str:
    """The separator of a table's cells: comma, semicolon as in Europe, or tab."""
    return max(",;\t", key=line.count)


def _table_files(table: Path) -> Iterator[StudyFile]:
    """The files in a study's table; paths start at its folder."""
    data = read_bytes(table, error=CaptureError, max_bytes=_MAX_TABLE_BYTES)
    lines = data.decode(text_encoding(data), "replace").splitlines()
    header = _header(lines[0])
    for name in filter(None, header):
        with errors_of(table, ArgumentError):
            check_choice(name, COLUMNS, noun="column")
    for number, row in enumerate(csv.reader(lines[1:], delimiter=_separator(lines[0])), 2):
        given = dict(zip(header, map(str.strip, row), strict=False))
        cells = {name: given[name] for name in COLUMNS if given.get(name)}
        if not cells:
            continue
        with errors_of(f"{table}: line {number}", ArgumentError):
            if "capture" not in cells:
                raise ArgumentError("there is no capture, expected the name of its file")
            if "side" in cells:
                check_choice(cells["side"], SIDES, noun="side")
        own = Path(cells["capture"])
        inside = not own.is_absolute() and ".." not in own.parts
        for column in _PATH_COLUMNS:
            beside = table.parent.resolve() / cells.get(column, "")
            if column in cells and (column != "glove" or beside.is_file()):  # or it is a shipped one
                cells[column] = str(beside)
        yield StudyFile(Path(cells.pop("capture")), own if inside else Path(own.name), cells)
