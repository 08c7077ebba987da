"""Kernels work in a read-only installation without a home."""

from __future__ import annotations

import os
import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest

from handsim import ShadowedPackageWarning, _imports
from handsim._imports import (
    SIBLINGS,
    VARIABLE,
    ensure_kernel_cache,
    kernel_cache,
    shadowed_siblings,
    warn_if_shadowed,
)

ROOT = Path(__file__).resolve().parents[2]


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


def test_a_script_called_train_is_told_before_the_confusing_error(tmp_path: Path) -> None:
    (tmp_path / "train.py").write_text("")
    result = import_in(tmp_path, "import handsim\nimport track, train.presets")
    assert result.returncode == 1
    told, _, error = result.stderr.partition("'train' is not a package")
    assert "ShadowedPackageWarning" in told and error
    assert f"handsim needs its own package 'train', but `import train` finds {tmp_path}/train.py" in told
    assert f"{tmp_path}/script.py:1:" in told  # the warning points at the user's line


def test_a_foreign_package_is_told(tmp_path: Path) -> None:
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "__init__.py").write_text("")
    result = import_in(tmp_path, "import handsim")
    assert result.returncode == 0
    assert f"`import render` finds {tmp_path}/render;" in result.stderr


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
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(_imports, "is_writable", lambda folder: False)
    monkeypatch.setattr(_imports.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(_imports.tempfile, "tempdir", str(tmp_path))
    yield tmp_path
    os.environ.pop(VARIABLE, None)


def test_a_usual_installation_keeps_numbas_choice(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    ensure_kernel_cache()
    assert VARIABLE not in os.environ


def test_a_temporary_folder_is_the_last_resort(nowhere):
    ensure_kernel_cache()
    folder = Path(os.environ[VARIABLE])
    assert folder.parent == nowhere and folder.stat().st_mode & 0o777 == 0o700
    assert kernel_cache() == (folder, False), "which the doctor tells"


def test_a_folder_that_others_can_write_is_not_trusted(nowhere):
    """numba unpickles what it finds there."""
    bait = nowhere / f"handsim-kernels-{os.getuid()}"
    bait.mkdir()
    bait.chmod(0o777)
    ensure_kernel_cache()
    assert os.environ[VARIABLE] != str(bait)


def test_a_kernel_compiles_where_only_the_temporary_folder_is(tmp_path):
    program = (
        "import os; from handsim import _imports as k; k.is_writable = lambda folder: False; "
        "k.ensure_kernel_cache(); import numpy as np; from handsim.kernels import __name__ as n; "
        "print(os.environ[k.VARIABLE])"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    environment.pop(VARIABLE, None)
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip().startswith(str(tmp_path))
