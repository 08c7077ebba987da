"""The one command, `handsim`: a table of names, each loaded when it is called.

Exit codes: 0; 1 for a mistake of the user, explained in one line; 2 for usage; 130 when interrupted.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from handsim._version import __version__
from handsim.app.command_table import COMMANDS, load
from handsim.app.messages import told_warnings
from handsim.app.presets import PresetCommand
from handsim.errors import HandSimError, choices


def main(args: Sequence[str] | None = None) -> int:
    """Run `handsim ARGS` (those of the process by default) and return its exit code.

    Raises:
        SystemExit: After a command's help (code 0) or a mistake in its options (code 2).
    """
    return run(COMMANDS, sys.argv[1:] if args is None else args)


def run(commands: Mapping[str, tuple[str, str]], args: Sequence[str]) -> int:
    """Run one command of a table; `main` is this with the table of the release."""
    program = f"handsim {args[0]}" if args and args[0] in commands else "handsim"
    try:
        with told_warnings(program):
            code = _dispatch(commands, args)
        sys.stdout.flush()  # a full disk or a closed pipe must show here, not while Python shuts down
        return code
    except BrokenPipeError:  # `handsim ... | head` has seen enough
        _abandon_stdout()
        return 141
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    except (HandSimError, OSError, MemoryError, ImportError) as error:
        print(f"{program}: {sentence(error)}", file=sys.stderr)
        try:
            sys.stdout.flush()
        except OSError:
            _abandon_stdout()
        return 1


def sentence(error: Exception) -> str:
    """One line for a user, out of an error that the user can do something about."""
    if isinstance(error, MemoryError):
        return "out of memory; ask for fewer frames, a smaller batch or fewer workers"
    if isinstance(error, ImportError):
        return f"{_one_line(error)}; `handsim doctor` says what is missing"
    if isinstance(error, OSError) and error.errno is not None:
        what = _SYSTEM_SENTENCES.get(error.errno, (error.strerror or "system error").lower())
        return what if error.filename is None else f"{os.fsdecode(error.filename)}: {what}"
    return _one_line(error)


_SYSTEM_SENTENCES: Final = {
    errno.ENOSPC: "the disk is full; free some space and run the same command again",
    errno.ENOENT: "no such file or folder",
    errno.EACCES: "permission denied",
    errno.EISDIR: "this is a folder, expected a file",
    errno.ENOTDIR: "this is a file, expected a folder",
    errno.EEXIST: "exists already",
}


def _one_line(error: Exception) -> str:
    return " ".join(str(error).splitlines()) or type(error).__name__


def _abandon_stdout() -> None:
    """Give up what could not be written, or Python tries once more at its end and exits with 120."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(commands: Mapping[str, tuple[str, str]], args: Sequence[str]) -> int:
    """Print the overview or the version, or call the command that the first argument names."""
    if not args or args[0] in ("-h", "--help"):
        _print_overview(commands)
        return 0
    if args[0] == "--version":
        print(f"handsim {__version__}")
        return 0
    name = args[0]
    if name not in commands:
        noun = "option" if name.startswith("-") else "command"
        valid = ("--help", "--version") if noun == "option" else commands
        print(f"handsim: {choices(name, valid, noun=noun)}", file=sys.stderr)
        return 2
    target, help_line = commands[name]
    return _call(target, prog=f"handsim {name}", help_line=help_line, args=args[1:])


def _call(target: str, *, prog: str, help_line: str, args: Sequence[str]) -> int:
    """Load "module:name", hand it the arguments through tyro, and return its exit code."""
    import tyro

    command: Callable[..., Any] | PresetCommand | dict[str, Callable[..., Any]] = load(target)
    if isinstance(command, PresetCommand):
        command = command.choose(args, prog)
    if isinstance(command, dict):
        result = tyro.extras.subcommand_cli_from_dict(command, prog=prog, description=help_line, args=args)
    else:
        result = tyro.cli(command, prog=prog, args=args)
    return result if isinstance(result, int) else 0


def _print_overview(commands: Mapping[str, tuple[str, str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for name, (_, help_line) in commands.items():
        table.add_row(f"  [bold]{name}[/bold]", help_line)
    console = Console()
    console.print("usage: handsim COMMAND [OPTIONS]\n", markup=False)
    console.print(table)
    console.print("\nhandsim COMMAND --help tells a command's options; handsim --version, the version.")
