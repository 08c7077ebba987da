"""How the signatures of commands become options: one reading of types, and of what help says of defaults."""

from __future__ import annotations

import argparse
import ast
import contextlib
import dataclasses
import functools
import inspect
import io
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

Command = Callable[..., Any]
_UNIONS: Final = (Union, types.UnionType)
_SPECIFICATION: Final = "COMPLETION_SPEC = "  # in scripts for completion, of commands and options


@dataclass(frozen=True, slots=True)
class PresetCommand:
    """A command that reads its arguments once before they are parsed.

    A preset must become the default of the other options: compared afterwards, an option that was given and
    equals the usual default cannot be distinguished from one that was not given.
    """

    choose: Callable[[Sequence[str], str], Command]
    """From the arguments and the program's name for messages to the function that they are parsed for."""


def given_option(args: Sequence[str], option: str) -> str | None:
    """The value of one option among arguments, None where it is not given; nothing else is checked."""
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
    is_silent: bool = False,
) -> Any:
    """Parse arguments for a function, or for one of several by its name, and call it.

    Raises:
        SystemExit: After help (code 0) or a mistake in the options (code 2).
    """
    if isinstance(command, PresetCommand):
        command = command.choose(args or (), prog)
    if isinstance(command, dict):
        table = {name: _with_hints(one) for name, one in command.items()}
        return tyro.extras.subcommand_cli_from_dict(
            table, prog=prog, description=help_line, args=args, registry=registry()
        )
    return tyro.cli(
        _with_hints(command), prog=prog, args=args, registry=registry(), console_outputs=not is_silent
    )


def completion_script(
    commands: Mapping[str, Command | PresetCommand | dict[str, Command]], shell: str
) -> str:
    """The script that completes commands and options in a shell, as tyro makes it."""
    table = {name: _completed(command) for name, command in commands.items()}
    script, args = io.StringIO(), ["--tyro-print-completion", shell]
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(table, prog="handsim", args=args, registry=registry())
    lines = script.getvalue().splitlines()  # a line break in a help text would end a proposal
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
    """Rules for the types that commands have."""
    rules = ConstructorRegistry()
    rules.primitive_rule(_name_or_nothing)
    rules.struct_rule(_settings)
    return rules


def _name_or_nothing(
    info: PrimitiveTypeInfo,
) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    """`X | None` is given as an X; an object that has a name or a path, by these."""
    if get_origin(info.type) not in _UNIONS:
        return None
    given = [one for one in get_args(info.type) if one is not types.NoneType]
    named = next((one for one in (str, Path) if one in given), None)
    chosen = given[0] if len(given) == 1 else named
    if chosen is None:
        return None
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(chosen, info.markers))
    if isinstance(inner, UnsupportedTypeAnnotationError):
        return None if named is None else inner
    return dataclasses.replace(
        inner,
        is_instance=lambda _: True,
        str_from_instance=lambda value: [] if value is None else _text_of(inner, value),
    )


def _text_of(spec: PrimitiveConstructorSpec[Any], value: Any) -> list[str]:
    return spec.str_from_instance(value) if spec.is_instance(value) else [str(value)]


def _settings(info: StructTypeInfo) -> StructConstructorSpec | None:
    """The fields of a dataclass of settings, with their docstrings as help."""
    if not dataclasses.is_dataclass(info.type) or info.type.__module__.startswith("tyro"):
        return None
    hints, told = get_type_hints(info.type, include_extras=True), dict[str, str]()
    for kind in reversed(info.type.__mro__[:-1]):  # fields of a base have their docstrings there
        told |= _field_docstrings(kind)
    fields = []
    for one in dataclasses.fields(info.type):
        if not one.init:
            continue
        default: Any = tyro.MISSING
        if dataclasses.is_dataclass(info.default):
            default = getattr(info.default, one.name)
        elif one.default is not dataclasses.MISSING:
            default = one.default
        elif one.default_factory is not dataclasses.MISSING:
            default = one.default_factory()
        kind = _hinted(hints[one.name], aliases=["--frames"] if one.name == "num_frames" else None)
        fields.append(StructFieldSpec(one.name, kind, default, told.get(one.name)))
    return StructConstructorSpec(instantiate=info.type, fields=tuple(fields))


@functools.lru_cache(maxsize=256)
def _field_docstrings(kind: type) -> dict[str, str]:
    """What stands below each field of a class."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    told = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            value = text.value
            if isinstance(value, ast.Constant) and isinstance(field.target, ast.Name):
                told[field.target.id] = " ".join(inspect.cleandoc(str(value.value)).split())
    return told


def _hint(default: str) -> str:
    return "" if default in ("", "None") else f"(default: {default})"


def _hinted(annotation: Any, aliases: list[str] | None = None) -> Any:
    """A type whose help tells a default that is one, and nothing where an option may be left out."""
    return Annotated[annotation, tyro.conf.arg(help_behavior_hint=_hint, aliases=aliases)]


def _with_hints(command: Command) -> Command:
    """The same command, with help as `_hinted`."""
    function: Any = command.func if isinstance(command, functools.partial) else command
    hints = get_type_hints(function, include_extras=True)
    signature = inspect.signature(command)
    parameters = [
        one.replace(annotation=_hinted(hints.get(name, Any))) for name, one in signature.parameters.items()
    ]

    @functools.wraps(function)
    def wrapped(*args: Any, **options: Any) -> Any:
        return command(*args, **options)

    del wrapped.__wrapped__  # where tyro would read the types again
    wrapped.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": Any}
    wrapped.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return wrapped
