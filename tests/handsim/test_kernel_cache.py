"""Kernels work in a read-only installation without a home."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from handsim import _kernel_cache
from handsim._kernel_cache import VARIABLE, ensure_kernel_cache, kernel_cache


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """Neither the installation nor the user's cache can be written; the temporary folder is another."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(_kernel_cache, "_is_writable", lambda folder: False)
    monkeypatch.setattr(_kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(_kernel_cache.tempfile, "tempdir", str(tmp_path))
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
        "import os; from handsim import _kernel_cache as k; k._is_writable = lambda folder: False; "
        "k.ensure_kernel_cache(); import numpy as np; from handsim.kernels import __name__ as n; "
        "print(os.environ[k.VARIABLE])"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    environment.pop(VARIABLE, None)
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip().startswith(str(tmp_path))
