"""A bash script that completes `handsim`: its commands and their options; else names of files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from handsim.cli.command_table import load
from handsim.cli.parsing import options_of
from handsim.cli.presets import PresetCommand

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
