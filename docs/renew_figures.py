"""Measured figures: quoted by the pages, kept in figures.toml, renewed by the commands that are noted there.

    python docs/renew_figures.py                   # write the file's values into README.md and docs/*.md
    python docs/renew_figures.py --only table5     # run this command, store all its figures, then write
    python docs/renew_figures.py --only all        # every command of at most ten minutes that needs no data

A page quotes a figure between two HTML comments, `<!--fig:RUN.FIGURE-->98.11<!--/-->`, which no reader sees.
`<!--fig:RUN.FIGURE#2-->` quotes the second number of a figure alone. Placeholders in a command, such as
{sig18}, are taken from the environment (HANDSIM_SIG18); {out} is a temporary folder.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[1]
FILE: Final = ROOT / "docs" / "figures.toml"
TAG: Final = re.compile(r"(<!--fig:([\w-]+\.[\w-]+)(?:#(\d+))?-->)(.*?)(<!--/-->)")
NUMBER: Final = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?(?:e-?\d+)?")
UNITS: Final = (
    r"%|mm|ms|us|deg|frames/s|frames per second|pictures/s|pictures per second|minutes?|hours?|MB|GB"
)
RESULT: Final = re.compile(
    rf"(?<![\w.#-])\d[\d,.]*(?:e-?\d+)?\s?(?:{UNITS})(?!\w)|(?<![\w.#-])\d+\.\d+(?![\w.])"
)
PLACEHOLDER: Final = re.compile(r"\{(\w+)\}")
DEFAULTS: Final = {"sig18": ROOT.parent / "shared" / "sig18"}
LONG: Final = 10  # minutes; longer commands are only run when they are named


class Quote(NamedTuple):
    """A figure quoted by a page: `part` counts its numbers from 1, and is None where all of it is quoted."""

    key: str
    part: int | None
    text: str


class _Printed(str):
    """A matched text that can also be formatted as a number: "{0}" as printed, "{0:.1f}" rounded."""

    def __format__(self, spec: str) -> str:
        return format(float(self.replace(",", "")), spec) if spec else str(self)


def load_figures(path: Path = FILE) -> dict[str, Any]:
    """The file: `runs`, each with its command, commit, machine, date and figures, and `checks` by page."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def values(figures: dict[str, Any]) -> dict[str, str]:
    """Value of every figure by its key, RUN.FIGURE."""
    return {
        f"{run}.{name}": figure["value"]
        for run, content in figures["runs"].items()
        for name, figure in content["figures"].items()
    }


def pages() -> list[Path]:
    """The pages that may quote figures."""
    made = {ROOT / "docs" / "api", ROOT / "docs" / "help"}  # by the build of the site
    pages = sorted((ROOT / "docs").rglob("*.md"))
    return [ROOT / "README.md", *(page for page in pages if page.parent not in made)]


def quotes(text: str) -> Iterator[Quote]:
    """The figures that a page quotes, in order."""
    for _, key, part, quoted, _ in TAG.findall(text):
        yield Quote(key, int(part) if part else None, quoted)


def expected(known: dict[str, str], key: str, part: int | None) -> str:
    """The text that belongs between the tags.

    Raises:
        KeyError: No such figure.
        IndexError: The figure has fewer numbers.
    """
    return known[key] if part is None else NUMBER.findall(known[key])[part - 1]


def rewrite(text: str, known: dict[str, str]) -> str:
    """A page with every tagged figure set to its value."""

    def renewed(match: re.Match[str]) -> str:
        start, key, part, _, end = match.groups()
        return f"{start}{expected(known, key, int(part) if part else None)}{end}"

    return TAG.sub(renewed, text)


def untagged(text: str, sections: list[str] | None, allowed: list[str]) -> list[str]:
    """Lines of a page with a number that looks measured but has no tag.

    Args:
        text: The page. Blocks of code, inline code and link targets are left out.
        sections: Headings whose sections are checked; None for the whole page.
        allowed: Regular expressions of texts that are no measured figures.
    """
    for pattern in (r"```.*?```", r"<!--.*?-->(?=\n)"):
        text = re.sub(pattern, "", text, flags=re.S)
    if sections is not None:
        text = "\n".join(_sections(text, sections))
    found = []
    for line in text.splitlines():
        rest = re.sub(r"`[^`]*`|\]\([^)]*\)", " ", TAG.sub(" ", line))
        for pattern in allowed:
            rest = re.sub(pattern, " ", rest)
        if RESULT.search(rest):
            found.append(line.strip())
    return found


def _sections(text: str, headings: list[str]) -> Iterator[str]:
    """The parts of a page under these headings, sub-headings included."""
    inside = 0
    for line in text.splitlines():
        if match := re.match(r"(#+) (.*)", line):
            if inside and len(match[1]) <= inside:
                inside = 0
            if not inside and match[2] in headings:
                inside = len(match[1])
        if inside:
            yield line


def parse(output: str, figure: dict[str, Any]) -> str:
    """The value of a figure in what its command printed.

    Lines are compared after their spaces and the frames of tables have been reduced to single signs:
    `│ handsim │  99.15 │` becomes `handsim | 99.15`.

    Args:
        output: What the command printed.
        figure: `pattern`, a regular expression; its groups are the value, joined by " | " or put into the
            template `form`. `fold` says what becomes of several matches: `first` (default), `join`, `least`,
            `most`, `mean`, or `range` (least "to" most), each group on its own.

    Raises:
        ValueError: The pattern matches nothing.
    """
    lines = (re.sub(r"\s+", " ", re.sub(r"[│┃]", "|", line)).strip(" |") for line in output.splitlines())
    matches = [match.groups() for match in re.finditer(figure["pattern"], "\n".join(lines), re.M)]
    if not matches:
        raise ValueError(f"nothing in the output matches {figure['pattern']!r}")
    columns = [[cell for cell in column if cell] for column in zip(*matches, strict=True)]
    fold = FOLDS[figure.get("fold", "first")]
    groups = [_Printed(fold(column)) for column in columns]
    form = figure.get("form")
    return form.format(*groups) if form else " | ".join(groups)


def _number(text: str) -> float:
    return float(text.replace(",", ""))


def _range(column: list[str]) -> str:
    return f"{min(column, key=_number)} to {max(column, key=_number)}"


FOLDS: Final[dict[str, Callable[[list[str]], str]]] = {
    "first": lambda column: column[0] if column else "-",
    "join": " | ".join,
    "least": lambda column: min(column, key=_number),
    "most": lambda column: max(column, key=_number),
    "mean": lambda column: str(sum(map(_number, column)) / len(column)),
    "range": _range,
}


def measure(name: str, run: dict[str, Any]) -> dict[str, str]:
    """Run a command and return its figures by name."""
    with tempfile.TemporaryDirectory() as out:
        places = {"out": out} | {
            key: os.environ.get(f"HANDSIM_{key.upper()}", str(path)) for key, path in DEFAULTS.items()
        }
        for key in PLACEHOLDER.findall(run["command"]):
            if key not in places and f"HANDSIM_{key.upper()}" not in os.environ:
                sys.exit(f"{name}: its command needs {{{key}}}; set HANDSIM_{key.upper()}")
            places.setdefault(key, os.environ.get(f"HANDSIM_{key.upper()}", ""))
        command = PLACEHOLDER.sub(lambda match: places[match[1]], run["command"])
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        environment = os.environ | {"COLUMNS": "200", "PATH": path, "PYTHONPATH": str(ROOT)}
        print(f"{name}: {command}", file=sys.stderr, flush=True)
        done = subprocess.run(
            command, shell=True, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=False
        )
    if done.returncode != 0:
        sys.exit(f"{name}: the command ended with exit code {done.returncode}")
    return {key: parse(done.stdout, figure) for key, figure in run["figures"].items()}


def stored(text: str, name: str, measured: dict[str, str]) -> str:
    """The text of figures.toml with a run's new values, the present commit, this machine and today's date."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short=7", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    start = text.index(f"[runs.{name}]\n")
    end = text.find("\n[", text.index(f"[runs.{name}.figures]\n") + 1)
    end = len(text) if end < 0 else end
    section = re.sub(r'^commit = ".*"$', f'commit = "{commit}"', text[start:end], flags=re.M)
    gpu = "GPU" if shutil.which("nvidia-smi") else "no GPU"
    section = re.sub(r'^machine = ".*"$', f'machine = "{os.cpu_count()} cores, {gpu}"', section, flags=re.M)
    section = re.sub(r'^date = ".*"$', f'date = "{date.today().isoformat()}"', section, flags=re.M)
    for key, value in measured.items():
        line = re.compile(rf'^({re.escape(key)} = {{ value = )"[^"]*"', re.M)
        section = line.sub(rf'\g<1>"{value}"', section)
    return text[:start] + section + text[end:]


def main() -> None:
    """Renew what was asked for, then write the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", help="a run, one of its figures (RUN.FIGURE), or 'all'")
    only = parser.parse_args().only
    runs = load_figures()["runs"]
    if only == "all":
        names = [
            name
            for name, run in runs.items()
            if "command" in run and set(PLACEHOLDER.findall(run["command"])) <= {"out"}
        ]
        names = [name for name in names if runs[name]["minutes"] <= LONG]
    else:
        names = [only.split(".")[0]] if only else []
    for name in names:
        if "command" not in runs.get(name, {}):
            sys.exit(f"no run '{name}' with a command; there are {', '.join(runs)}")
        FILE.write_text(
            stored(FILE.read_text(encoding="utf-8"), name, measure(name, runs[name])), encoding="utf-8"
        )
    known = values(load_figures())
    for page in pages():
        page.write_text(rewrite(page.read_text(encoding="utf-8"), known), encoding="utf-8")


if __name__ == "__main__":
    main()
