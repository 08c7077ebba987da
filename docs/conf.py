"""Sphinx: the pages of this folder are the guide; the API and the commands are read from the code."""

from __future__ import annotations

import importlib
import inspect
import io
import os
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from unittest.mock import patch

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS: Final = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

from handsim import __version__  # noqa: E402
from handsim.cli.main import (  # noqa: E402
    COMMANDS,
    load,
    main,
)

PACKAGES: Final = ("handsim", "poses", "gloves", "render", "train", "track", "film")
COLUMNS: Final = 126  # of the help: lines of docstrings are not wrapped once more
ESCAPE: Final = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")  # colors of terminals

project = "handsim"
author = project_copyright = "The handsim authors"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"handsim {__version__}"
html_show_sourcelink = html_copy_source = False
myst_heading_anchors = 3
suppress_warnings = ["ref.python"]  # several types have a field `qpos`; napoleon links the word to each
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "undoc-members": True}
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # attributes of a dataclass are described once, beside the field


def write_reference() -> None:
    """Write one page per package, api/PACKAGE.md, with its public names; unchanged pages are not touched."""
    folder = DOCS / "api"
    folder.mkdir(exist_ok=True)
    for name in PACKAGES:
        package = importlib.import_module(name)
        lines = [f"# {name}", "", "```{eval-rst}", f".. automodule:: {name}", "   :no-members:", ""]
        for public in package.__all__:
            value = getattr(package, public)
            owner = getattr(value, "__module__", name).partition(".")[0]
            if not public.startswith("__") and owner == name:  # a name of two packages stands with its owner
                lines += [f".. {_directive(value)}:: {name}.{public}", ""]
        _write(folder / f"{name}.md", [*lines, "```", ""])


def write_help() -> None:
    """Write one page per command, help/COMMAND.md, with what `--help` prints; sub-commands are sections."""
    folder = DOCS / "help"
    folder.mkdir(exist_ok=True)
    for name, (target, what) in COMMANDS.items():
        lines = [f"# handsim {name}", "", what, "", "```text", help_text(name), "```", ""]
        command = load(target)
        for part in command if isinstance(command, dict) else ():
            lines += [f"## handsim {name} {part}", "", "```text", help_text(name, part), "```", ""]
        _write(folder / f"{name}.md", lines)
    for page in folder.glob("*.md"):
        if page.stem not in COMMANDS:
            page.unlink()


def help_text(*command: str) -> str:
    """What `handsim COMMAND --help` prints on a terminal without colors."""
    plain = {"COLUMNS": str(COLUMNS), "NO_COLOR": "1", "TERM": "dumb"}
    with patch.dict(os.environ, plain), redirect_stdout(io.StringIO()) as out, redirect_stderr(out):
        try:
            main([*command, "--help"])
        except SystemExit as end:
            if end.code:
                raise RuntimeError(out.getvalue()) from end
    return ESCAPE.sub("", out.getvalue()).strip()


def _write(path: Path, lines: list[str]) -> None:
    text = "\n".join(lines)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _directive(thing: object) -> str:
    if inspect.isclass(thing):
        return "autoexception" if issubclass(thing, BaseException) else "autoclass"
    return "autofunction" if callable(thing) else "autodata"


def plain_to_rst(_app: Sphinx, _what: str, _name: str, _thing: Any, _options: Any, lines: list[str]) -> None:
    """Docstrings are plain text with `code`: make code literal, and signs that RST reads as markup plain."""
    for number, line in enumerate(lines):
        parts = re.split(r"(`+[^`]+`+)", line)
        parts[1::2] = [f"``{part.strip('`')}``" for part in parts[1::2]]
        parts[::2] = [re.sub(r"([*|\\])|(?<=\w)(_)(?!\w)", r"\\\1\2", part) for part in parts[::2]]
        lines[number] = "".join(parts)


def setup(app: Sphinx) -> None:
    """Write the reference and the help, and read docstrings as plain text before napoleon does."""
    write_reference()
    write_help()
    app.connect("autodoc-process-docstring", plain_to_rst, priority=400)
