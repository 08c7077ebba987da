"""How the signatures of commands become options: one reading of types, and of what help says of defaults.

The same options stand in the script that completes commands in bash.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
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

from handsim.cli.command_table import PresetCommand, load

Command = Callable[..., Any]
_UNIONS: Final = (Union, types.UnionType)
_SCRIPT: Final = """\
# Completion of handsim in bash; in zsh, after `autoload -U bashcompinit && bashcompinit`.
_handsim() {{
    local words
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{commands} --help --version"
    else
        case "${{COMP_WORDS[1]}}" in
{cases}
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _handsim handsim
"""


def run_command(
    command: Command | dict[str, Command],
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
    if isinstance(command, dict):
        table = {name: _with_hints(one) for name, one in command.items()}
        return tyro.extras.subcommand_cli_from_dict(
            table, prog=prog, description=help_line, args=args, registry=registry()
        )
    return tyro.cli(
        _with_hints(command), prog=prog, args=args, registry=registry(), console_outputs=not is_silent
    )


def options_of(command: Command) -> list[str]:
    """The options of a command, as they are written."""
    with registry():
        parser: Any = tyro.extras.get_parser(_with_hints(command))
    return [
        option
        for action in parser._actions  # argparse has no other way to list them
        for option in action.option_strings
        if option.startswith("--")
    ]


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
        fields.append(StructFieldSpec(one.name, _hinted(hints[one.name]), default, told.get(one.name)))
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


def _hinted(annotation: Any) -> Any:
    """A type whose help tells a default that is one, and nothing where an option may be left out."""
    return Annotated[annotation, tyro.conf.arg(help_behavior_hint=_hint)]


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


def bash_completion(commands: Mapping[str, tuple[str, str]]) -> str:
    """The script for a table of commands; loads all of them, which takes some seconds."""
    cases = [
        f'            {name}) words="{" ".join(_words(target))}" ;;' for name, (target, _) in commands.items()
    ]
    return _SCRIPT.format(commands=" ".join(commands), cases="\n".join(cases))


def _words(target: str) -> list[str]:
    """The options of a command, and its sub-commands."""
    command: Any = load(target)
    if isinstance(command, PresetCommand):
        command = command.choose((), "handsim")
    functions = list(command.values()) if isinstance(command, dict) else [command]
    found = list(command) if isinstance(command, dict) else []
    for function in functions:
        found += [word for word in options_of(function) if word not in found]
    return found
