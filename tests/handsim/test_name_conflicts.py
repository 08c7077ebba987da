from __future__ import annotations

import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest

from handsim._name_conflicts import SIBLINGS, ShadowedPackageWarning, shadowed_siblings, warn_if_shadowed

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


def test_a_script_called_train_is_told(tmp_path: Path) -> None:
    (tmp_path / "train.py").write_text("")
    result = import_in(tmp_path, "import handsim")
    assert result.returncode == 0
    assert "ShadowedPackageWarning" in result.stderr
    assert (
        f"handsim needs its own package 'train', but `import train` finds {tmp_path}/train.py"
        in result.stderr
    )
    assert f"{tmp_path}/script.py:1:" in result.stderr  # the warning points at the user's line


def test_the_warning_comes_before_the_confusing_error(tmp_path: Path) -> None:
    (tmp_path / "train.py").write_text("")
    result = import_in(tmp_path, "import track, train.presets")
    assert result.returncode == 1
    assert result.stderr.index("ShadowedPackageWarning") < result.stderr.index("'train' is not a package")


def test_a_foreign_package_is_told(tmp_path: Path) -> None:
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "__init__.py").write_text("")
    result = import_in(tmp_path, "import handsim")
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
