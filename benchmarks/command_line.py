"""A table of functions as one command line, for the folders of benchmarks."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from handsim import HandSimError
from handsim.app.messages import warnings_as_lines
from handsim.cli.parsing import run_command


def run(
    module: str,
    description: str | None,
    commands: Mapping[str, Callable[..., Any]],
    args: Sequence[str] | None = None,
) -> int:
    """Run one function of a table and return the exit code: 1, and one sentence, for a user's mistake.

    Args:
        module: What the table is started as, `python -m MODULE`.
        description: What its help begins with.
        commands: Functions by name.
        args: Words of the command line; those of the process when not given.

    Raises:
        SystemExit: After the help (code 0) or a mistake in options (code 2).
    """
    program = f"python -m {module}"
    try:
        with warnings_as_lines(program):
            run_command(dict(commands), prog=program, help_line=description or "", args=args)
    except HandSimError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 1
    return 0
