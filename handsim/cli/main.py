"""The one command, `handsim`: a table of names, each loaded when it is called.

Exit codes: 0; 1 for a mistake of the user, explained in one line; 2 for usage; 128 and more after a signal
(130 after Ctrl-C).
"""

from __future__ import annotations

import errno
import io
import os
import re
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pkgutil import resolve_name
from typing import Any, Final

from handsim import callbacks
from handsim._version import full_version
from handsim.app.messages import warnings_as_lines
from handsim.callbacks import before_compiling
from handsim.cli.kept_help import print_help
from handsim.errors import MAX_MESSAGE_LENGTH, HandSimError, choices, shortened
from handsim.files.signals import Stopped, signals_raise

_BROKEN_PIPE: Final = 141  # 128 and the number of SIGPIPE, as other tools end
Table = Mapping[str, tuple[Any, str]]
"""For each command "module:function", or a table of its sub-commands, and a line of help."""
_HELP: Final = {
    "demo": "Run the whole chain on a built-in example; ends with a page of pictures.",
    "hand": "Write a hand as a MuJoCo or OpenSim model, a URDF or a rigged mesh.",
    "glove": "List, show, start, learn and check marker layouts; score and improve one before it is worn.",
    "glove list": "List the marker layouts that come with handsim: markers, labeler and source of each.",
    "glove show": "Show a layout's markers.",
    "glove new": "Write a commented layout file as a start for a glove of your own.",
    "glove learn": "Learn a layout from labeled captures, whatever their columns are called.",
    "glove check": "Check a layout on hands of all five sizes, and draw it from all sides with its slips on "
    "100 people.",
    "glove score": "Say how well a layout can be labeled and what it tells of each joint; nothing is "
    "trained.",
    "glove improve": "Look for a better layout near a given one: move, add or drop markers.",
    "rig": "List, start, check and import camera rigs; forecast what one will miss, and plan a better one.",
    "rig list": "List the camera rigs that come with handsim: how many cameras, their pictures, and what "
    "they are.",
    "rig new": "Write a commented rig file as a start for a rig of your own.",
    "rig check": "Check a rig's file: where its cameras stand and look, and what is suspicious.",
    "rig import": "Write a rig's file of the calibration of a camera system: all its cameras, pictures and "
    "lenses.",
    "rig score": "Forecast what a rig will miss: gaps, ghosts, error, the worth of each camera; nothing is "
    "recorded.",
    "rig plan": "Look for the best places of a number of cameras, for hands at work in a volume.",
    "generate": "Make a training set; goes on where it was stopped.",
    "train": "Train a labeler on a training set; goes on where it was stopped.",
    "label": "Label every frame of a marker capture.",
    "export": "Write a take's motion for other programs (.glb, .bvh, .usdc, .csv, ...), or a labeler as "
    ".onnx.",
    "evaluate": "Measure a labeler on a labeled capture.",
    "simulate": "Simulate a capture of hands, with its truth.",
    "calibrate": "Fit hands and gloves to a user, from a capture or a stream.",
    "track": "Follow hands through a marker capture or a live stream.",
    "report": "Write a page on a take: joint angles, range of motion, gaps, residuals, doubtful frames.",
    "replay": "Play a capture as a NatNet server, to try a live set-up.",
    "view": "Show a file or a live tracker in the browser.",
    "body": "Write a rigid body's markers as a file, to track it with.",
    "render": "Draw the hands of a take, with the truth of each picture.",
    "film": "Register an ordinary video to a tracked take; its frames become labeled photographs.",
    "detect": "Find hands, gloved or bare, in photographs or a video, as COCO keypoints.",
    "doctor": "Say what is missing on this machine, and how to get it.",
}
"""Every command with its line of help; `handsim glove list` is `list_glove` in the module `glove`."""
_EMPTY_ARGUMENT: Final = re.compile(r"(--[\w-]+=)?")
_SHELLS: Final = ("bash", "fish", "zsh")
_SYSTEM_SENTENCES: Final = {
    errno.ENOSPC: "the disk is full; free some space and run the same command again",
    errno.ENOENT: "no such file or folder",
    errno.EACCES: "permission denied",
    errno.EISDIR: "this is a folder, expected a file",
    errno.ENOTDIR: "this is a file, expected a folder",
    errno.EEXIST: "exists already",
}


def _target_of(command: str) -> str | Table:
    """The "module:function" of a command, or the table of its sub-commands."""
    inner = [name for name in _HELP if name.startswith(f"{command} ")]
    if inner:
        return {name.split()[1]: (_target_of(name), _HELP[name]) for name in inner}
    words = command.split()
    return f"handsim.cli.{words[0]}:{'_'.join(reversed(words))}"


# Modules are imported when their command runs, and not for the help of a table.
COMMANDS: Final[Table] = {name: (_target_of(name), text) for name, text in _HELP.items() if " " not in name}


def main(args: Sequence[str] | None = None) -> int:
    """Run `handsim ARGS` (those of the process by default) and return its exit code; `help X` is `X --help`.

    Raises:
        SystemExit: After a command's help (code 0) or a mistake in its options (code 2).
    """
    given = sys.argv[1:] if args is None else args
    given = [*given[1:], "--help"] if given and given[0] == "help" else given
    # A process that prints help alone needs no compiler, whose import takes long.
    callbacks.is_command = True
    callbacks.runs_kernels = args is not None or given[-1:] not in (["--help"], ["-h"])
    return run(COMMANDS, given)


def run(commands: Table, args: Sequence[str]) -> int:
    """Run a command of a table and return its exit code."""
    args = list(map(_with_home, args))
    _, program, _ = _chosen(commands, args)
    _prepare_streams()
    if not os.environ.get("COLUMNS", "").strip("0"):  # rich would print nothing into a width of 0
        os.environ.pop("COLUMNS", None)
    # One core solves our small systems faster than several, and each worker has one core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with warnings_as_lines(program), signals_raise():
            code = _dispatch(commands, args)
        sys.stdout.flush()  # a full disk or a closed pipe must fail here, not while Python shuts down
        return code
    except BrokenPipeError:  # `handsim ... | head` ends early
        _abandon_stdout()
        return _BROKEN_PIPE
    except SystemExit as end:
        return _exit_with_help(end)
    except KeyboardInterrupt as stop:
        number, kept = (stop.number, stop.kept) if isinstance(stop, Stopped) else (signal.SIGINT, "")
        how = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
        _print_error(f"{program}: {'; '.join(filter(None, (how, kept)))}")
        return 128 + number
    except Exception as error:
        expected = isinstance(error, HandSimError | OSError | MemoryError | ImportError)
        _print_error(f"{program}: {_error_sentence(error) if expected else _bug_sentence(program, error)}")
        return 1


def _with_home(arg: str) -> str:
    """Replace ~ in an argument by the home folder, as shells do not in quotes and after `=`."""
    option, equals, value = arg.partition("=") if arg.startswith("--") else ("", "", arg)
    return f"{option}{equals}{os.path.expanduser(value)}"


def load(target: str | Table) -> Any:
    """Import the object that "module:name" stands for, or those of a table as a dict."""
    if not isinstance(target, str):
        return {name: load(inner) for name, (inner, _) in target.items()}
    return resolve_name(target)


def _chosen(commands: Table, args: Sequence[str]) -> tuple[tuple[Any, str], str, Sequence[str]]:
    """The entry of the command in the first arguments, the name of the program, and the other arguments."""
    entry: tuple[Any, str] = (commands, "")
    prog = "handsim"
    while isinstance(entry[0], Mapping) and args and args[0] in entry[0]:
        entry, prog, args = entry[0][args[0]], f"{prog} {args[0]}", args[1:]
    return entry, prog, args


def _prepare_streams() -> None:
    """Make the standard streams accept any text, and open closed ones to /dev/null."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # the next file to be opened would get its descriptor
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")  # names of files may be invalid text


def _exit_with_help(end: SystemExit) -> int:
    """Flush the output of help or usage, and exit; after a closed pipe rich would exit with code 1."""
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


def _print_error(line: str) -> None:
    """Print a line on standard error, which may be closed."""
    try:
        print(line, file=sys.stderr, flush=True)
        sys.stdout.flush()
    except OSError:
        _abandon_stdout()


def _bug_sentence(program: str, error: Exception) -> str:
    """A sentence on an unexpected error, with the file of its traceback."""
    what = f"unexpected {type(error).__name__}: {shortened(_one_line(error), 200)}"
    trace = traceback.format_exc()
    try:
        prefix = program.replace(" ", "-") + "-"
        with tempfile.NamedTemporaryFile(
            "w", prefix=prefix, suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as log:
            log.write(f"handsim {full_version()}, Python {sys.version}\n{sys.argv}\n\n{trace}")
    except OSError:
        return f"{what}; this is a bug in handsim; please report it and attach this:\n{trace}"
    return f"{what}; this is a bug in handsim; please report it and attach {log.name}"


def _error_sentence(error: Exception) -> str:
    """A sentence on an error that the user can correct."""
    if isinstance(error, MemoryError):
        return "out of memory; ask for fewer frames, a smaller batch or fewer workers"
    if isinstance(error, ImportError):
        return f"{_one_line(error)}; `handsim doctor` says what is missing"
    if isinstance(error, OSError) and error.errno is not None:
        what = _SYSTEM_SENTENCES.get(error.errno, (error.strerror or "system error").lower())
        return what if error.filename is None else f"{os.fsdecode(error.filename)}: {what}"
    return _one_line(error)


def _one_line(error: Exception) -> str:
    return shortened(" ".join(str(error).splitlines()), MAX_MESSAGE_LENGTH) or type(error).__name__


def _abandon_stdout() -> None:
    """Point stdout at /dev/null, so that Python's flush at exit cannot fail."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # a stream without a file
        return


def _dispatch(commands: Table, args: Sequence[str]) -> int:
    """Print the overview or the version, or call the command that the first argument names."""
    name = args[0] if args else "--help"
    if name in ("-h", "--help"):
        _print_overview(commands)
    elif name == "--version":
        print(f"handsim {full_version()}")
    elif name == "--print-completion":
        from handsim.cli.parsing import completion_script

        if len(args) != 2 or args[1] not in _SHELLS:
            shells = ", ".join(_SHELLS)
            print(f"handsim: --print-completion takes one shell; valid names: {shells}", file=sys.stderr)
            return 2
        print(completion_script({name: load(target) for name, (target, _) in commands.items()}, args[1]))
    elif name in commands:
        (target, help_line), prog, args = _chosen(commands, args)
        if any(map(_EMPTY_ARGUMENT.fullmatch, args)):  # the path "" would be the current folder
            print(
                f"{prog}: an argument is empty, expected a value; is a shell's variable unset?",
                file=sys.stderr,
            )
            return 2

        def work() -> Any:
            from handsim.cli.parsing import outline, run_command

            command = load(target) if isinstance(target, str) else outline(target)
            return run_command(command, prog=prog, help_line=help_line, args=args)

        if list(args) in (["--help"], ["-h"]):
            print_help(prog, work)
            return 0
        with _compiled_ahead("-".join(prog.split()[1:])):
            result = work()
        return result if isinstance(result, int) else 0
    else:
        noun = "option" if name.startswith("-") else "command"
        valid = ("--help", "--version", "--print-completion") if noun == "option" else commands
        print(f"handsim: {choices(name, valid, noun=noun)}", file=sys.stderr)
        return 2
    return 0


@contextmanager
def _compiled_ahead(command: str) -> Iterator[None]:
    """Compile all kernels of a command when the first one is missing within the block."""

    def compile_them() -> None:
        from handsim.app.compiling import compile_kernels

        compile_kernels(command)

    before_compiling.append(compile_them)
    try:
        yield
    finally:
        before_compiling.clear()


def _print_overview(commands: Table) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for name, (_, help_line) in commands.items():
        table.add_row(f"  [bold]{name}[/bold]", help_line)
    console = Console()
    console.print("usage: handsim COMMAND [OPTIONS]\n", markup=False)
    console.print(table)
    console.print("\nhandsim COMMAND --help tells a command's options; handsim --version, the version.")
