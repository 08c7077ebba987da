"""The structure of the tree: rooms, one-way imports, one type per thing."""

from __future__ import annotations

import ast
import functools
import re
from collections import defaultdict
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("handsim", "poses", "gloves", "render", "train", "track", "film")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MOST_LEVELS = 11
LOADERS = {"handsim/cli/main.py", "handsim/_imports.py", "handsim/pages.py"}


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@functools.cache
def nodes_of(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text("utf-8"))))


@pytest.fixture(scope="module")
def graph() -> grimp.ImportGraph:
    return grimp.build_graph(*PACKAGES, cache_dir=None)


def room_of(module: str) -> str:
    """The room of a module: the child of its package, a file or a folder."""
    return ".".join(module.split(".")[:2])


def test_no_circle_among_modules(graph):
    seen: dict[str, int] = {}

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert seen.get(module) != 1, " -> ".join((*trail, module))
        if module in seen:
            return
        seen[module] = 1
        for imported in sorted(graph.find_modules_directly_imported_by(module)):
            if imported not in PACKAGES:
                visit(imported, (*trail, module))
        seen[module] = 2

    for module in sorted(graph.modules):
        if module not in PACKAGES:  # a package's door imports its rooms for type checkers only
            visit(module, ())


@pytest.mark.parametrize("package", PACKAGES)
def test_rooms_stand_on_few_levels(package, graph):
    """The rooms of a package (its direct children) import each other one way, over at most eleven levels."""
    imports: dict[str, set[str]] = defaultdict(set)
    for module in graph.modules:
        if not module.startswith(f"{package}."):
            continue
        imports[room_of(module)] |= {
            room_of(imported)
            for imported in graph.find_modules_directly_imported_by(module)
            if imported.startswith(f"{package}.") and room_of(imported) != room_of(module)
        }
    levels: dict[str, int] = {}

    def level(room: str, trail: tuple[str, ...]) -> int:
        assert room not in trail, f"rooms import each other: {' -> '.join((*trail, room))}"
        if room not in levels:
            levels[room] = 1 + max((level(below, (*trail, room)) for below in imports[room]), default=0)
        return levels[room]

    assert max(level(room, ()) for room in list(imports)) <= MOST_LEVELS


def test_modules_are_named_by_strings_in_the_command_table_the_pages_and_the_doors_alone():
    modules = re.compile(rf"^({'|'.join(PACKAGES)})(\.\w+)+(:\w+)?$")
    for path in SOURCES:
        if relative(path) in LOADERS or (path.name == "__init__.py" and path.parent.parent == ROOT):
            continue
        strings = [
            node.value
            for node in nodes_of(path)
            if isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and modules.match(node.value)
            and (ROOT / node.value.split(":")[0].replace(".", "/")).with_suffix(".py").is_file()
        ]
        assert strings == [], relative(path)


def test_one_type_holds_a_model_and_an_attachment():
    holders = []
    for path, node in classes():
        types = {ast.unparse(field.annotation) for field in node.body if isinstance(field, ast.AnnAssign)}
        if {"HandModel", "Attachment"} <= types:
            holders.append(f"{relative(path)}:{node.name}")
    assert holders == ["gloves/fit.py:GloveFit"]


def classes():
    for path in SOURCES:
        for node in nodes_of(path):
            if isinstance(node, ast.ClassDef):
                yield path, node


def test_a_bad_argument_is_never_control_flow():
    """A handler of `ArgumentError` adds words and raises again; it never goes on."""
    for path in SOURCES:
        for node in nodes_of(path):
            if (
                isinstance(node, ast.ExceptHandler)
                and node.type
                and "ArgumentError" in ast.unparse(node.type)
            ):
                assert isinstance(node.body[-1], ast.Raise), f"{relative(path)}:{node.lineno}"
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("suppress"):
                assert "ArgumentError" not in ast.unparse(node), f"{relative(path)}:{node.lineno}"
