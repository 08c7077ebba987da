"""The numeric constants of modules, and what reads them: lines of functions, and compiled kernels."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ("handsim", "poses", "gloves", "train", "track")
"""Packages whose code may read a number."""


class Number(NamedTuple):
    """A numeric constant of a module."""

    file: str
    name: str
    line: int
    value: str  # as the module states it
    part: int | None  # its place in a statement that names several

    @property
    def key(self) -> str:
        """Its module and name."""
        return f"{self.file}:{self.name}"


def numbers(places: tuple[str, ...]) -> Iterator[Number]:
    """The numeric constants of some modules and folders."""
    for place in places:
        for file in sorted((ROOT / place).glob("*.py")) or [ROOT / place]:
            for node in ast.parse(file.read_text("utf-8")).body:
                for name, value, part in _assigned(node):
                    if name.lstrip("_").isupper() and _is_numeric(value):
                        own = file.relative_to(ROOT).as_posix()
                        yield Number(own, name, node.lineno, ast.unparse(value), part)


def _assigned(node: ast.stmt) -> Iterator[tuple[str, ast.expr, int | None]]:
    """Names that a statement assigns, with their values."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
        for part, (one, value) in enumerate(zip(target.elts, node.value.elts, strict=True)):
            yield ast.unparse(one), value, part
    elif isinstance(target, ast.Name):
        yield target.id, node.value, None


def _is_numeric(value: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    inner = list(ast.walk(value))
    plain = [one.value for one in inner if isinstance(one, ast.Constant)]
    words = {one.id for one in inner if isinstance(one, ast.Name)}
    made = all(isinstance(one, int | float) and not isinstance(one, bool) for one in plain)
    return bool(plain) and made and words <= {"np", "float"} and not isinstance(value, ast.Dict | ast.Set)


class Sources:
    """Which lines and kernels of the packages read which names."""

    def __init__(self) -> None:
        self._lines = defaultdict[str, list[tuple[str, int, bool]]](list)
        """By name, file and line of each reading, and whether a function's body has it."""
        self._users = defaultdict[str, list[tuple[str, str]]](list)
        """By name, file and name of each kernel that reads it and each constant derived from it."""
        self._kernels: set[tuple[str, str]] = set()
        for file in (file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))):
            self._read(file.relative_to(ROOT).as_posix(), ast.parse(file.read_text("utf-8")))

    def _read(self, file: str, tree: ast.Module) -> None:
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                bodies = [one.body for one in ast.walk(node) if isinstance(one, ast.FunctionDef)]
                inside = {id(one) for body in bodies for part in body for one in ast.walk(part)}
                for word, line, key in _words(node):
                    self._lines[word].append((file, line, key in inside))
                if any("kernel" in ast.unparse(one) for one in node.decorator_list):
                    self._kernels.add((file, node.name))
                    self._use(file, node.name, node)
            for name, value, _ in _assigned(node):
                self._use(file, name, value)

    def _use(self, file: str, name: str, node: ast.AST) -> None:
        for word in {word for word, *_ in _words(node)}:
            self._users[word].append((file, name))

    def kernels_of(self, number: Number) -> set[tuple[str, str]]:
        """Kernels that read a number or what is derived from it, and their callers: file and name."""
        return self._readers(number)[1]

    def is_plain(self, number: Number) -> bool:
        """Whether only bodies of functions of its own module read a number, at each call."""
        file, name = number.file, number.name
        is_alone = self._readers(number)[0] == {(file, name)} and not file.startswith(
            "train/"
        )  # has labelers
        return is_alone and all(is_body for where, _, is_body in self._lines[name] if where == file)

    def is_read(self, number: Number, ran: set[tuple[str, int]]) -> bool:
        """Whether a line that ran, or a kernel, reads a number or what is derived from it."""
        known, kernels = self._readers(number)
        return bool(kernels) or any(
            (file, line) in ran and where in ("", file)
            for where, word in known
            for file, line, _ in self._lines[word]
        )

    def _readers(self, number: Number) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
        """Names derived from a number, with their file if they are private; and the kernels."""
        known, kernels = {_scoped(number.file, number.name)}, set[tuple[str, str]]()
        todo = list(known)
        while todo:
            where, word = todo.pop()
            for file, name in self._users[word]:
                if where in ("", file) and _scoped(file, name) not in known:
                    known.add(_scoped(file, name))
                    todo.append(_scoped(file, name))
                    kernels |= {(file, name)} & self._kernels
        return known, kernels


def _scoped(file: str, name: str) -> tuple[str, str]:
    return (file if name.startswith("_") else ""), name


def _words(node: ast.AST) -> Iterator[tuple[str, int, int]]:
    """Names and attributes in a node, with their lines and the identities of their nodes."""
    for one in ast.walk(node):
        if isinstance(one, ast.Name | ast.Attribute):
            yield one.id if isinstance(one, ast.Name) else one.attr, one.end_lineno or one.lineno, id(one)
