"""The one command, `handsim`: a table of names, each loaded when it is called.

Exit codes: 0; 1 for a mistake of the user, explained in one line; 2 for usage; 128 and more after a signal
(130 after Ctrl-C).
"""

from __future__ import annotations

import errno
import io
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from handsim import __version__
from handsim.app.messages import told_warnings
from handsim.cli.command_table import COMMANDS, PresetCommand, load
from handsim.errors import SENTENCE, HandSimError, choices, shortened
from handsim.files.signals import Stopped, signals_raise

_BROKEN_PIPE: Final = 141  # 128 and the number of SIGPIPE, as other tools end


def main(args: Sequence[str] | None = None) -> int:
    """Run `handsim ARGS` (those of the process by default) and return its exit code.

    Raises:
        SystemExit: After a command's help (code 0) or a mistake in its options (code 2).
    """
    return run(COMMANDS, sys.argv[1:] if args is None else args)


def run(commands: Mapping[str, tuple[str, str]], args: Sequence[str]) -> int:
    """Run one command of a table; `main` is this with the table of the release."""
    program = f"handsim {args[0]}" if args and args[0] in commands else "handsim"
    _prepare_streams()
    # One core solves its small systems faster than several do; a worker has a core of its own.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with told_warnings(program), signals_raise():
            code = _dispatch(commands, args)
        sys.stdout.flush()  # a full disk or a closed pipe must show here, not while Python shuts down
        return code
    except BrokenPipeError:  # `handsim ... | head` has seen enough
        _abandon_stdout()
        return _BROKEN_PIPE
    except SystemExit as end:
        return _leave(end)
    except KeyboardInterrupt as stop:
        return _say_stopped(program, stop)
    except Exception as error:
        return _say_failed(program, error)


def _prepare_streams() -> None:
    """Make the standard streams take any text, and nothing where they are closed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed; the next file that is opened would else take its place
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")  # names of files need not be text


def _leave(end: SystemExit) -> int:
    """Write out what help or usage printed, and leave; rich leaves a closed pipe with code 1."""
    pipe: BaseException | None = end
    while pipe is not None and not isinstance(pipe, BrokenPipeError):
        pipe = pipe.__context__
    try:
        sys.stdout.flush()
    except BrokenPipeError as error:
        pipe = error
    if pipe is None:
        raise end
    _abandon_stdout()
    return _BROKEN_PIPE


def _say_failed(program: str, error: Exception) -> int:
    """Say in one line what went wrong; the exit code."""
    expected = isinstance(error, HandSimError | OSError | MemoryError | ImportError)
    _complain(f"{program}: {sentence(error) if expected else _unexpected(program, error)}")
    return 1


def _say_stopped(program: str, stop: KeyboardInterrupt) -> int:
    """Say what is kept after a signal; the exit code says which signal it was."""
    number, kept = (stop.number, stop.kept) if isinstance(stop, Stopped) else (2, "")
    how = "interrupted" if number == 2 else f"ended by {signal_name(number)}"
    _complain(f"{program}: {how}{'; ' if kept else ''}{kept}")
    return 128 + number


def signal_name(number: int) -> str:
    """The name of a signal, such as SIGTERM."""
    import signal

    return signal.Signals(number).name


def _complain(line: str) -> None:
    """Print a line for the user; nobody may be there to read it."""
    try:
        print(line, file=sys.stderr, flush=True)
        sys.stdout.flush()
    except OSError:
        _abandon_stdout()


def _unexpected(program: str, error: Exception) -> str:
    """The sentence of the last resort, with the file that the traceback is in."""
    what = f"unexpected {type(error).__name__}: {shortened(_one_line(error), 200)}"
    trace = traceback.format_exc()
    try:
        prefix = program.replace(" ", "-") + "-"
        with tempfile.NamedTemporaryFile(
            "w", prefix=prefix, suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as log:
            log.write(f"handsim {__version__}, Python {sys.version}\n{sys.argv}\n\n{trace}")
    except OSError:
        return f"{what}; this is a mistake in handsim, please report it with this:\n{trace}"
    return f"{what}; this is a mistake in handsim, please report it with {log.name}"


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
    return shortened(" ".join(str(error).splitlines()), SENTENCE) or type(error).__name__


def _abandon_stdout() -> None:
    """Give up what could not be written, or Python tries once more at its end and exits with 120."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # a stream without a file
        return


def _dispatch(commands: Mapping[str, tuple[str, str]], args: Sequence[str]) -> int:
    """Print the overview or the version, or call the command that the first argument names."""
    if not args or args[0] in ("-h", "--help"):
        _print_overview(commands)
        return 0
    if args[0] == "--version":
        print(f"handsim {__version__}")
        return 0
    if args[0] == "--print-completion":
        return _print_completion(commands, args[1:])
    name = args[0]
    if name not in commands:
        noun = "option" if name.startswith("-") else "command"
        valid = ("--help", "--version", "--print-completion") if noun == "option" else commands
        print(f"handsim: {choices(name, valid, noun=noun)}", file=sys.stderr)
        return 2
    target, help_line = commands[name]
    return _call(target, prog=f"handsim {name}", help_line=help_line, args=args[1:])


def _print_completion(commands: Mapping[str, tuple[str, str]], shells: Sequence[str]) -> int:
    """Print the script that completes commands and options in a shell."""
    if list(shells) != ["bash"]:
        print("handsim: --print-completion takes one shell; valid names: bash", file=sys.stderr)
        return 2
    from handsim.cli.parsing import bash_completion

    print(bash_completion(commands), end="")
    return 0


def _call(target: str, *, prog: str, help_line: str, args: Sequence[str]) -> int:
    """Load "module:name", hand it the arguments through tyro, and return its exit code."""
    from handsim.cli.parsing import run_command

    command: Callable[..., Any] | PresetCommand | dict[str, Callable[..., Any]] = load(target)
    if isinstance(command, PresetCommand):
        command = command.choose(args, prog)
    result = run_command(command, prog=prog, help_line=help_line, args=args)
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
