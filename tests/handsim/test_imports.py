"""Kernels work in a read-only installation without a home."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest

import handsim
from handsim import ShadowedPackageWarning, _imports
from handsim._imports import (
    CACHE_VARIABLE,
    SIBLINGS,
    ensure_kernel_cache,
    kernel_cache,
    shadowed_siblings,
    warn_if_shadowed,
)
from tests.programs import ROOT, run_python

FOREIGN = pytest.mark.parametrize(
    ("name", "package"), [("train", False), ("render", True), ("poses", False), ("gloves", True)]
)


def import_in(folder: Path, code: str, *flags: str) -> subprocess.CompletedProcess[str]:
    """Run `code` as a script's neighbor would, with handsim on the path after the script's own folder."""
    script = folder / "script.py"
    script.write_text(code)
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    command = [sys.executable, *flags, str(script)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder, check=False)


def test_our_own_packages_are_no_strangers() -> None:
    assert shadowed_siblings() == {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_shadowed()


def test_every_sibling_counts_as_a_stranger_from_another_home(tmp_path: Path) -> None:
    assert tuple(shadowed_siblings(str(tmp_path))) == SIBLINGS


def lay(folder: Path, name: str, *, package: bool) -> Path:
    """Lay a foreign module or package of a name into a folder, and return the place that messages name."""
    if not package:
        (folder / f"{name}.py").write_text("x = 1")
        return folder / f"{name}.py"
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text("x = 1")
    return folder / name


@FOREIGN
def test_a_foreign_name_on_the_path_is_told_and_ours_is_found_within_handsim(tmp_path, name, package):
    place = lay(tmp_path, name, package=package)
    code = f"import handsim\nimport handsim.{name} as ours, track, sys\nprint(ours.__file__, {name}.__file__)"
    result = import_in(tmp_path, code.replace("track,", f"track, {name},"))
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [str(ROOT / name / "__init__.py")] * 2
    assert f"handsim needs its own package '{name}', but `import {name}` finds {place};" in result.stderr
    assert f"{tmp_path}/script.py:1:" in result.stderr  # the warning points at the user's line


@FOREIGN
@pytest.mark.parametrize("user", ["handsim.{}", "track", "handsim.cli.main"])
def test_a_foreign_name_that_is_imported_is_an_error_with_its_path(tmp_path, name, package, user):
    if (name, user) == ("render", "track"):
        pytest.skip("track does not need render")
    place = lay(tmp_path, name, package=package)
    result = import_in(tmp_path, f"import {name}, {user.format(name)}")
    assert result.returncode == 1
    told = result.stderr.splitlines()[-1]
    assert told.startswith(
        f"handsim._imports.ShadowedPackageError: handsim needs its own package '{name}', but"
    )
    assert f"{place} is imported" in told and f"import handsim.{name} before it" in told


@pytest.mark.parametrize("name", ["train", "render", "track"])
def test_a_script_of_such_a_name_works_by_the_safe_names(tmp_path, name):
    script = tmp_path / f"{name}.py"
    script.write_text(
        "from handsim.gloves import load_layout\nimport handsim.track, handsim.train, handsim.render\n"
        "print(handsim.track.Status, load_layout('dense19').name)"
    )
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("source", "what"), [("x = 1\n", "belongs to another package"), (None, "is missing")]
)
def test_files_of_another_package_in_place_of_ours_are_told_with_the_remedy(tmp_path, source, what):
    home = tmp_path / "site"
    shutil.copytree(ROOT / "handsim", home / "handsim", ignore=shutil.ignore_patterns("__pycache__", "data"))
    if source is not None:
        (home / "render").mkdir()
        (home / "render" / "__init__.py").write_text(source)
    told = run_python("from handsim.render import draw", folder=home, check=False, PYTHONPATH=str(home))
    assert f"render/__init__.py {what}; run `pip uninstall render`" in told.stderr


def test_a_public_name_of_another_package_is_told():
    with pytest.raises(AttributeError, match=r"'handsim' has no attribute 'load_take'; gloves.load_take has"):
        handsim.load_take  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'nonsense'$"):
        handsim.nonsense  # noqa: B018


def test_a_module_is_the_same_under_both_names() -> None:
    code = (
        "import handsim.train.labelers.protocol as a, train.labelers.protocol as b, sys, handsim\n"
        "import handsim.poses, poses\n"
        "from handsim.gloves import load_layout; import gloves\n"
        "assert a is b and handsim.poses is poses and load_layout is gloves.load_layout\n"
        "assert a.__name__ == a.__spec__.name == 'train.labelers.protocol'\n"
        "assert a.__package__ == 'train.labelers'\n"
        "assert handsim.track.Status is gloves.Status and 'track' in sys.modules"
    )
    run_python(code)


def test_a_mere_folder_is_harmless_and_so_is_safe_path(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()  # without __init__.py Python goes on looking and finds ours
    assert import_in(tmp_path, "import handsim").stderr == ""
    (tmp_path / "track.py").write_text("")
    assert "track" in import_in(tmp_path, "import handsim").stderr
    assert import_in(tmp_path, "import handsim", "-P").stderr == ""


def test_a_module_without_a_spec_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gloves", types.ModuleType("gloves"))
    with pytest.warns(ShadowedPackageWarning, match="needs its own package 'gloves'"):
        warn_if_shadowed()


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """Neither the installation nor the user's cache can be written; the temporary folder is another."""
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    monkeypatch.setattr(_imports, "is_writable", lambda folder: False)
    monkeypatch.setattr(_imports.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(_imports.tempfile, "tempdir", str(tmp_path))
    yield tmp_path
    os.environ.pop(CACHE_VARIABLE, None)


def test_a_usual_installation_keeps_numbas_choice(monkeypatch):
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    ensure_kernel_cache()
    assert CACHE_VARIABLE not in os.environ


def test_a_temporary_folder_is_the_last_resort(nowhere):
    ensure_kernel_cache()
    folder = Path(os.environ[CACHE_VARIABLE])
    assert folder.parent == nowhere and folder.stat().st_mode & 0o777 == 0o700
    assert kernel_cache() == (folder, False), "which the doctor tells"


def test_a_folder_that_others_can_write_is_not_trusted(nowhere):
    """numba unpickles what it finds there."""
    bait = nowhere / f"handsim-kernels-{os.getuid()}"
    bait.mkdir()
    bait.chmod(0o777)
    ensure_kernel_cache()
    assert os.environ[CACHE_VARIABLE] != str(bait)


def test_a_kernel_compiles_where_only_the_temporary_folder_is(tmp_path, monkeypatch):
    program = (
        "import os; from handsim import _imports as k; k.is_writable = lambda folder: False; "
        "k.ensure_kernel_cache(); import numpy as np; from handsim.kernels import __name__ as n; "
        "print(os.environ[k.CACHE_VARIABLE])"
    )
    monkeypatch.delenv(CACHE_VARIABLE, raising=False)
    assert run_python(program, TMPDIR=str(tmp_path)).stdout.startswith(str(tmp_path))
