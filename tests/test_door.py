"""The public names of the seven packages: documented, typed, lazily imported, in an example that runs."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from typing import get_args, get_origin, get_type_hints

import pytest

from tests.documents import PAGES
from tests.programs import ROOT, run_python

PACKAGES = ("handsim", "poses", "gloves", "render", "train", "track", "film")
BOOKKEEPING = {"__version__", "ShadowedPackageWarning"}
UNIT = re.compile(r"\[(m|m\^2|rad|s|min|Hz|deg|px|pixels|mm|1/s)(?=[ ,;/\]])")
ARRAY = re.compile(r"\b(Float|Int|Bool)(32|64)?\[[^,\]]+, *\"")
NO_QUANTITY = {
    "Alternative", "Backgrounds", "CalibrateSettings", "CameraLoss", "EvaluateSettings", "HandSimError",
    "FrameConfig", "HandSimWarning", "ImprovedGlove", "LabelSettings", "Labeler", "LiveHeader", "PoseFile",
    "PoseMix", "SceneMix", "ScoreGloveSettings", "SinkGroup", "Status", "SuspectSpan", "find_suspect_spans",
    "load_labeler",
}  # fmt: skip
"""Public names without a physical quantity of their own, or whose quantities are in the types they return."""
ROOMS = {
    package: (f"{package}.",) if package != "handsim" else ("handsim.hand", "handsim.space")
    for package in PACKAGES
}
INNER = {"ArrivingFrames", "FormerHands", "Part", "Site"}
"""Types of what `open_source`, a take, a rigid object and a glove are made of, which no user makes."""


def exported() -> list[object]:
    return [
        pytest.param(package, name, id=f"{package}.{name}")
        for package in PACKAGES
        for name in importlib.import_module(package).__all__
        if name not in BOOKKEEPING
    ]


def source_of(value: object) -> str:
    """Docstring of a function; of a class its whole source: fields and methods have docstrings too."""
    return inspect.getsource(value) if inspect.isclass(value) else inspect.getdoc(value) or ""


@pytest.mark.parametrize(("package", "name"), exported())
def test_name_is_documented_with_units_and_shapes(package, name):
    value = getattr(importlib.import_module(package), name)
    text = inspect.getdoc(value) or ""
    assert text and not text.startswith(f"{name}("), "no docstring of its own"
    source = inspect.getsource(value)
    if name not in NO_QUANTITY:
        assert ARRAY.search(source) or UNIT.search(source_of(value)), "neither shapes nor units"
    if re.search(r"Float(32|64)?\[", source):
        assert UNIT.search(source) or "share" in source or "probabilit" in source, "an array without a unit"


@pytest.mark.parametrize(("package", "name"), exported())
def test_a_list_of_arguments_is_whole(package, name):
    value = getattr(importlib.import_module(package), name)
    for function in (value, *vars(value).values()) if inspect.isclass(value) else (value,):
        text = inspect.getdoc(function) or ""
        if inspect.isfunction(function) and "\nArgs:\n" in text:
            told = set(re.findall(r"^    \*{0,2}(\w+): ", text, re.M))
            missing = set(inspect.signature(function).parameters) - {"self", "cls"} - told
            assert not missing, f"{function.__qualname__}: {missing}"


def our_types(annotation: object) -> set[type]:
    """The classes of our packages in a type."""
    found = {one for part in get_args(annotation) for one in our_types(part)}
    annotation = get_origin(annotation) or annotation
    if inspect.isclass(annotation) and annotation.__module__.split(".")[0] in PACKAGES:
        found.add(annotation)
    return found


def signatures(value: object) -> list[object]:
    """What states types: a function; a class with its fields, and its public methods and properties."""
    if not inspect.isclass(value):
        return [value]
    members = [
        getattr(member, "fget", None) or getattr(member, "__func__", member)
        for key, member in vars(value).items()
        if not key.startswith("_") or key == "__init__"
    ]
    return [value, *filter(inspect.isfunction, members)]


def types_of(value: object) -> set[type]:
    """Our classes in the signatures of a public name."""
    return {
        one for part in signatures(value) for hint in get_type_hints(part).values() for one in our_types(hint)
    }


def called() -> list[tuple[str, str]]:
    """Public names but for the types that others take and return."""
    names = [one.values for one in exported()]
    values = [getattr(importlib.import_module(package), name) for package, name in names]
    given = {one for value in values for one in types_of(value) if one is not value}
    return [one for one, value in zip(names, values, strict=True) if value not in given]


@pytest.mark.parametrize(("package", "name"), exported())
def test_types_in_public_signatures_are_public(package, name):
    public = {getattr(importlib.import_module(one.values[0]), one.values[1]) for one in exported()}
    private = types_of(getattr(importlib.import_module(package), name)) - public
    assert {one.__name__ for one in private} <= INNER


def examples() -> str:
    blocks = [path.read_text("utf-8") for path in sorted((ROOT / "examples").glob("*.py"))]
    for page in (ROOT / "README.md", *PAGES):
        blocks += re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.S)
    return "\n".join(blocks)


def test_every_name_has_an_example_that_runs():
    """Examples and the Python blocks of README and docs are run by tests of their own.

    Types that public functions take and return need none.
    """
    text = examples()
    unused = [f"{package}.{name}" for package, name in called() if not re.search(rf"\b{name}\b", text)]
    assert unused == []


def test_examples_and_pages_use_public_names_alone():
    inner = re.findall(rf"^\s*(?:from|import) (?:{'|'.join(PACKAGES)})\.\S+.*", examples(), re.M)
    assert inner == []


@pytest.mark.parametrize("package", PACKAGES)
def test_names_for_type_checkers_are_public(package):
    tree = ast.parse((ROOT / package / "__init__.py").read_text("utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    stated = {alias.asname for node in block.body for alias in node.names}
    module = importlib.import_module(package)
    assert stated <= set(module.__all__) <= set(dir(module))
    assert stated >= set(module.__all__) - {
        "__version__",
        "HandSimError",
        "HandSimWarning",
        "ShadowedPackageWarning",
    }


def test_unknown_names_are_told():
    with pytest.raises(AttributeError, match="module 'gloves' has no attribute 'nothing'"):
        importlib.import_module("gloves").nothing  # noqa: B018


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_imports_none_of_its_rooms(package):
    code = f"import sys, {package}; print(sorted(m for m in sys.modules if m.startswith({ROOMS[package]})"
    code += " or m in ('numpy', 'torch', 'mujoco', 'OpenGL')))"
    assert run_python(code).stdout == "[]\n"


def test_the_door_is_small():
    assert len(called()) <= 60
