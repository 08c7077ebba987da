"""The wheel of these sources, and an installation of it that sees nothing of the checkout."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from tests.programs import ROOT

PACKAGES = ("handsim", "poses", "gloves", "render", "train", "track", "film")


def build_wheel(source: Path, out: Path) -> Path:
    """The wheel, built from a copy: what setuptools leaves beside the sources must not enter the next one."""
    for name in (*PACKAGES, "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    command = [sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", str(out), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "BackendUnavailable" in done.stderr or "No module named pip" in done.stderr:
        pytest.skip("needs pip and setuptools in this environment; `make test` installs them")
    assert done.returncode == 0, done.stderr
    (path,) = out.glob("handsim-*.whl")
    return path


def install_wheel(wheel: Path, folder: Path) -> Path:
    """Python of a new environment with the wheel; its dependencies are those of this environment."""
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    options = ["--quiet", "--no-deps", "--no-index", "--no-compile", str(wheel)]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), "install", *options], check=True)
    (site,) = folder.glob("lib/python*/site-packages")
    # Paths in .pth files of that folder, as those of editable installations, are not followed.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python
