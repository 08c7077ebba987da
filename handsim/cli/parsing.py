"""Parsing of the command line by tyro: rules for types, help texts, presets and shell completion."""

from __future__ import annotations

import argparse
import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import sys
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
    UnsupportedTypeAnnotationError,
)

from handsim.errors import choices, shortened
from handsim.settings import UNIONS, Spelled

Command = Callable[..., Any]
_SPECIFICATION: Final = "COMPLETION_SPEC = "  # begins the line of a completion script with all help texts


@dataclass(frozen=True, slots=True)
class PresetCommand:
    """A command whose defaults depend on an option, which is read before the arguments are parsed.

    After parsing, an option with the usual default would look like one that was not given.
    """

    choose: Callable[[Sequence[str], str], Command]
    """Returns the function to parse for, from the arguments and the program's name."""


def given_option(args: Sequence[str], option: str) -> str | None:
    """The value of one option among arguments; None if it is not given."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(option, dest="value", nargs="?")
    known, _ = parser.parse_known_args(list(args))
    value: str | None = known.value
    return value


def run_command(
    command: Command | PresetCommand | dict[str, Command],
    *,
    prog: str,
    help_line: str = "",
    args: Sequence[str] | None = None,
) -> Any:
    """Parse arguments for a function, or for one of several by name, and call it; help and mistakes exit."""
    if isinstance(command, PresetCommand):
        command = command.choose(args or (), prog)
    if isinstance(command, dict):
        table = {name: _with_hints(one) for name, one in command.items()}
        return tyro.extras.subcommand_cli_from_dict(
            table, prog=prog, description=help_line, args=args, registry=registry()
        )()
    call, unknown = tyro.cli(
        _with_hints(command), prog=prog, args=args, registry=registry(), return_unknown_args=True
    )
    if unknown:
        print(f"{prog}: {_refusal(command, unknown, list(args or ()))}; see {prog} --help", file=sys.stderr)
        raise SystemExit(2)
    return call()


def _refusal(command: Command, unknown: Sequence[str], args: list[str]) -> str:
    """A sentence on an unknown option, or on a value too many."""
    script = completion_script({"it": command}, "bash")
    table = next(line for line in script.splitlines() if line.startswith(_SPECIFICATION))
    (own,) = ast.literal_eval(table.removeprefix(_SPECIFICATION))["subcommands"].values()
    valid = [flag for option in own["options"] for flag in option["flags"] if flag.startswith("--")]
    word = next((one for one in unknown if one.startswith("-")), unknown[0])
    if word.startswith("-"):
        return choices(word, valid, noun="option")
    before = args[: args.index(word)]
    after = f" after '{before[-1]}'" if before else ""
    return f"'{shortened(word)}'{after} is one value too many; valid options: {', '.join(valid)}"


def outline(table: Mapping[str, tuple[Any, str]]) -> dict[str, Command]:
    """Functions that stand for the sub-commands of a table in its help, so that no module is loaded."""

    def named(help_line: str) -> Command:
        def stand_in() -> None:
            pass

        stand_in.__doc__ = help_line
        return stand_in

    return {name: named(help_line) for name, (_, help_line) in table.items()}


def completion_script(
    commands: Mapping[str, Command | PresetCommand | dict[str, Command]], shell: str
) -> str:
    """The script by tyro that completes commands and options in a shell."""
    table = {name: _completed(command) for name, command in commands.items()}
    script, args = io.StringIO(), ["--tyro-print-completion", shell]
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(table, prog="handsim", args=args, registry=registry())
    lines = script.getvalue().splitlines()
    # A line break in a help text would end the proposal of the shell.
    return "\n".join(line.replace(r"\n", " ") if line.startswith(_SPECIFICATION) else line for line in lines)


def _completed(command: Command | PresetCommand | dict[str, Command]) -> Command:
    """A command as one function."""
    if isinstance(command, PresetCommand):
        command = command.choose((), "handsim")
    if not isinstance(command, dict):
        return _with_hints(command)
    words = [tyro.conf.subcommand(name=name, constructor=_with_hints(one)) for name, one in command.items()]

    def chosen(word: Any) -> Any:
        return word

    union: Any = Union[tuple(Annotated[Any, word] for word in words)]  # noqa: UP007  # made from a list
    chosen.__annotations__ = {"word": Annotated[union, tyro.conf.arg(name="")], "return": Any}
    return chosen


def registry() -> ConstructorRegistry:
    """Rules for the types of commands' parameters."""
    rules = ConstructorRegistry()
    rules.primitive_rule(_name_or_nothing)
    rules.struct_rule(_settings)
    return rules


def _name_or_nothing(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    """Parse `X | None` as an X, and a union of an object with str or Path as the latter."""
    if get_origin(info.type) not in UNIONS:
        return None
    given = [one for one in get_args(info.type) if one is not types.NoneType]
    named = next((one for one in (str, Path) if one in given), None)
    chosen = given[0] if len(given) == 1 else named
    if chosen is None:
        return None
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(chosen, info.markers))
    if isinstance(inner, UnsupportedTypeAnnotationError):
        return None if named is None else inner

    def text_of(value: Any) -> list[str]:
        if value is None:
            return []
        return inner.str_from_instance(value) if inner.is_instance(value) else [str(value)]

    return dataclasses.replace(inner, is_instance=lambda _: True, str_from_instance=text_of)


def _settings(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Parse a dataclass of settings by its fields, with their docstrings as help.

    A field whose metadata say what it `follows` is no option.
    """
    if not dataclasses.is_dataclass(info.type) or info.type.__module__.startswith("tyro"):
        return None
    hints, docstrings = get_type_hints(info.type, include_extras=True), dict[str, str]()
    for kind in reversed(info.type.__mro__[:-1]):
        docstrings |= _field_docstrings(kind)
    fields = []
    for one in dataclasses.fields(info.type):
        if "follows" in one.metadata:
            continue
        default: Any = tyro.MISSING
        if dataclasses.is_dataclass(info.default):
            default = getattr(info.default, one.name)
        elif one.default is not dataclasses.MISSING:
            default = one.default
        elif one.default_factory is not dataclasses.MISSING:
            default = one.default_factory()
        kind, name = hints[one.name], None
        for spelled in getattr(kind, "__metadata__", ()):
            if isinstance(spelled, Spelled):
                name = spelled.name
                if spelled.kind is not None:
                    kind, default = spelled.kind, spelled.default
        is_count = one.name == "num_frames" and "frames" not in hints
        kind = _hinted(kind, aliases=["--frames"] if is_count else None, name=name)
        fields.append(StructFieldSpec(one.name, kind, default, docstrings.get(one.name)))
    return StructConstructorSpec(instantiate=info.type, fields=tuple(fields))


@functools.lru_cache(maxsize=256)
def _field_docstrings(kind: type) -> dict[str, str]:
    """The docstring below each field of a class."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    docstrings = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            value = text.value
            if isinstance(value, ast.Constant) and isinstance(field.target, ast.Name):
                docstrings[field.target.id] = " ".join(inspect.cleandoc(str(value.value)).split())
    return docstrings


def _hint(default: str) -> str:
    return "" if default in ("", "None") else f"(default: {default})"


def _hinted(annotation: Any, aliases: list[str] | None = None, name: str | None = None) -> Any:
    """A type whose help shows the default, unless that is None or empty."""
    return Annotated[annotation, tyro.conf.arg(name=name, help_behavior_hint=_hint, aliases=aliases)]


def _with_hints(command: Command) -> Command:
    """A command with the help of `_hinted` for all parameters; it returns the call instead of making it."""
    function: Any = command.func if isinstance(command, functools.partial) else command
    hints = get_type_hints(function, include_extras=True)
    signature = inspect.signature(command)
    parameters = [
        one.replace(annotation=_hinted(hints.get(name, Any))) for name, one in signature.parameters.items()
    ]

    @functools.wraps(function)
    def wrapped(*args: Any, **options: Any) -> Callable[[], Any]:
        return functools.partial(command, *args, **options)

    del wrapped.__wrapped__  # tyro would take the types from there
    wrapped.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": Any}
    wrapped.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return wrapped
