from __future__ import annotations

import importlib
import json
import re
import tomllib
import zipfile
from importlib import metadata

import pytest
import yaml

from tests.programs import ROOT, run_python
from tests.wheels import PACKAGES, build_wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    return zipfile.ZipFile(build_wheel(tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")))


def test_wheel_holds_the_seven_packages_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    (about,) = (top for top in tops if top.endswith(".dist-info"))
    assert tops == {*PACKAGES, about}
    assert not [name for name in wheel.namelist() if "test" in name.lower()]


def test_wheel_holds_every_source_and_data_file(wheel: zipfile.ZipFile) -> None:
    """Every file under the seven packages is in the wheel: layouts, poses and weights too."""
    wanted = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {f"{package}/py.typed" for package in PACKAGES} <= wanted
    assert wanted <= set(wheel.namelist())


def test_wheel_carries_license_command_and_one_version(wheel: zipfile.ZipFile) -> None:
    stated = re.search(r'__version__ = "(.+)"', (ROOT / "handsim" / "__init__.py").read_text())
    assert stated is not None
    about = f"handsim-{stated.group(1)}.dist-info"
    texts = {name: wheel.read(f"{about}/{name}").decode() for name in ("METADATA", "entry_points.txt")}
    assert f"\nVersion: {stated.group(1)}\n" in texts["METADATA"]
    assert "handsim = handsim.cli.main:main" in texts["entry_points.txt"]
    assert f"{about}/licenses/LICENSE" in wheel.namelist()
    assert "version" not in _project_table()  # pyproject.toml repeats no version
    assert f"version: {stated.group(1)}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## [{stated.group(1)}]" in (ROOT / "CHANGELOG.md").read_text()


def test_files_that_cite_the_release_agree() -> None:
    """The version and the date of the newest release, in every file that states them."""
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert changes.index("## [Unreleased]\n") < changes.index("\n## [0")
    found = re.search(r"\n## \[(\d\S*)\] - (\d{4}-\d\d-\d\d)\n", changes)
    assert found is not None
    version, day = found.groups()
    assert version == importlib.import_module("handsim").__version__
    assert f'\nversion: {version}\ndate-released: "{day}"\n' in (ROOT / "CITATION.cff").read_text("utf-8")
    archived = json.loads((ROOT / ".zenodo.json").read_text("utf-8"))
    assert (archived["version"], archived["publication_date"]) == (version, day)
    assert f'version: "{version}"' in (ROOT / "conda" / "recipe.yaml").read_text("utf-8")


@pytest.mark.parametrize(
    "path", sorted((ROOT / ".github" / "workflows").glob("*.yml")), ids=lambda path: path.stem
)
def test_workflows_call_targets_and_files_that_exist(path) -> None:
    text = path.read_text("utf-8")
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
    assert set(re.findall(r"\bmake ([a-z-]+)", text)) <= set(targets)
    assert all(
        (ROOT / file).exists() for file in re.findall(r"(?:tests/\S+\.py|\.ci/\w+|docs/\S+\.md)", text)
    )
    assert yaml.safe_load(text)["jobs"]


def test_the_recipe_for_conda_has_every_dependency() -> None:
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text("utf-8"))
    renamed = {"mujoco-python": "mujoco", "pytorch": "torch", "pytorch-lightning": "lightning-fabric",
               "openexr-python": "openexr", "py-opencv": "opencv-python-headless",
               "matplotlib-base": "matplotlib"}  # fmt: skip
    named = {
        renamed.get(name, name): limits for name, limits in map(str.split, recipe["requirements"]["run"])
    }
    ours = dict(re.fullmatch(r"([\w-]+)(\S+)", one).groups() for one in _project_table()["dependencies"])
    assert {_canonical(name): limits for name, limits in named.items() if name != "python"} == {
        _canonical(name): limits for name, limits in ours.items()
    }


def test_the_dockerfile_installs_what_exists() -> None:
    text = (ROOT / "Dockerfile").read_text("utf-8")
    (extras,) = re.findall(r"handsim\[([\w,-]+)\]", text)
    assert set(extras.split(",")) <= set(_project_table()["optional-dependencies"])
    packages = re.search(r"^DRAWING_PACKAGES := (.+)$", (ROOT / "Makefile").read_text("utf-8"), re.M)
    assert packages is not None and packages[1] in text
    json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text("utf-8"))


def _project_table():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_exist(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__all__ == sorted(set(module.__all__))
    assert [name for name in module.__all__ if not hasattr(module, name)] == []
    assert module.__version__ == importlib.import_module("handsim").__version__


def test_nobody_pays_for_another_packages_imports() -> None:
    """Every module of these packages, imported in a fresh Python, leaves the heavy ones alone."""
    code = "import importlib, sys\n"
    for packages, heavy in (
        (("handsim", "gloves", "poses"), ("torch",)),
        (("train",), ("pyrender", "OpenGL")),
    ):
        modules = sorted(
            ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            for package in packages
            for path in (ROOT / package).rglob("*.py")
        )
        code += f"for name in {modules}: importlib.import_module(name)\n"
        code += f"print(sorted({set(heavy)} & set(sys.modules)))\n"
    assert run_python(code).stdout == "[]\n[]\n"


def test_labeling_and_tracking_load_only_what_they_need() -> None:
    code = (
        "import sys, track.captures\n"
        "from train import load_labeler\n"
        "load_labeler('dense19')\n"
        "heavy = {'torch', 'mujoco', 'trimesh', 'matplotlib', 'cv2', 'scipy.optimize', 'scipy.spatial'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert run_python(code).stdout == "[]\n"


def test_constraints_pin_every_dependency() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert all(pins.values())
    project = _project_table()
    extras = [name for extra in project["optional-dependencies"].values() for name in extra]
    wanted = [*project["dependencies"], *(name for name in extras if not name.startswith("handsim["))]
    names = {_canonical(re.split(r"[<>=!]", requirement)[0]) for requirement in wanted}
    pinned = {_canonical(name) for name in pins}
    assert names <= pinned
    assert {_canonical(name) for name in _requirements_of(names)} <= pinned


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _requirements_of(names: set[str]) -> set[str]:
    """The installed requirements of these distributions, all the way down, extras left out."""
    found: set[str] = set()
    waiting = set(names)
    while waiting:
        name = waiting.pop()
        try:
            requirements = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # a marker for another system or Python
        found.add(name)
        if name == "torch":
            continue  # its CUDA build has dozens of its own, pinned by torch itself
        for requirement in requirements:
            if "extra ==" not in requirement:
                following = _canonical(re.split(r"[\s<>=!;\[(~]", requirement)[0])
                waiting |= {following} - found
    return found
