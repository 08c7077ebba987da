"""handsim as users have it: installed from its wheel, far from the checkout."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from handsim.cli.main import COMMANDS
from tests.documents import ROOT, blocks_of, run_blocks
from tests.wheels import PACKAGES, build_wheel, install_wheel

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wheel")]
EXAMPLES = ("01", "03", "10")  # a hand, the weights, pictures


class Installation(NamedTuple):
    """An environment with handsim installed from its wheel."""

    wheel: Path
    python: Path

    def run(self, *command: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment in a folder, without the variables that lead to the checkout."""
        own = {
            name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "NUMBA_CACHE_DIR")
        }
        program = [str(self.python.with_name(command[0])), *command[1:]]
        return subprocess.run(
            program, cwd=folder, env=own | more, capture_output=True, text=True, check=False
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    wheel = build_wheel(tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel"))
    return Installation(wheel, install_wheel(wheel, tmp_path_factory.mktemp("environment")))


def test_the_wheel_is_small_and_everything_comes_from_it(installed, tmp_path):
    assert installed.wheel.stat().st_size < 30e6
    code = (
        f"import {', '.join(PACKAGES)}\nprint(*(one.__file__ for one in ({', '.join(PACKAGES)})), sep='\\n')"
    )
    told = installed.run("python", "-c", code, folder=tmp_path)
    assert told.returncode == 0, told.stderr
    home = installed.python.parents[1].resolve()
    assert all(Path(one).is_relative_to(home) for one in told.stdout.split())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_tells_its_options(installed, tmp_path, command):
    told = installed.run("handsim", command, "--help", folder=tmp_path)
    assert (told.returncode, told.stderr) == (0, "")
    assert f"usage: handsim {command}" in told.stdout


def test_the_demo_runs_the_whole_chain(installed, tmp_path):
    told = installed.run("handsim", "demo", "--num-frames", "200", folder=tmp_path)
    assert told.returncode == 0, told.stderr
    page = tmp_path / "demo" / "index.html"
    pictures = re.findall(r'src="([^"]+)"', page.read_text())
    assert len(pictures) > 3 and all((page.parent / one).stat().st_size for one in pictures)


@pytest.mark.parametrize("number", EXAMPLES)
def test_examples_run(installed, tmp_path, number):
    (script,) = (ROOT / "examples").glob(f"{number}_*.py")
    told = installed.run("python", str(script), folder=tmp_path)
    assert told.returncode == 0 and told.stdout.strip(), told.stderr


def test_the_block_of_the_readme_runs(installed, tmp_path):
    script = next(block for block in blocks_of(ROOT / "README.md") if block.kind == "python")
    (printed,) = run_blocks([script], tmp_path, installed.wheel.parent, str(installed.python), path="")
    assert printed.strip()


@pytest.mark.parametrize(
    ("arguments", "hidden", "extra"),
    [
        (("export", "dense19", "--out", "out.onnx"), "onnx", "onnx"),
        (("view", "dense19"), "viser", "view"),
        (("doctor", "--send", "osc://127.0.0.1:9"), "pythonosc", "send"),
    ],
)
def test_a_command_without_its_extra_names_it(installed, tmp_path, arguments, hidden, extra):
    """Python finds no package whose name in sys.modules is None."""
    (tmp_path / "sitecustomize.py").write_text(f"import sys\nsys.modules[{hidden!r}] = None\n")
    told = installed.run("handsim", *arguments, folder=tmp_path, PYTHONPATH=str(tmp_path))
    assert told.returncode == 1 and told.stderr.count("\n") == 1, told.stderr
    assert f"pip install 'handsim[{extra}]'" in told.stderr


def test_sources_and_wheel_repeat(tmp_path):
    """`make dist` compares two of each itself; it makes them of the commit that is checked out."""
    if not (ROOT / ".git").exists():
        pytest.skip("needs a git checkout, of which .ci/dist makes a clone")
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
    own = {**os.environ, "PYTHON": sys.executable, "PYTHONPATH": ""}
    done = subprocess.run([str(clone / ".ci/dist")], env=own, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [one.suffix for one in sorted((clone / "dist").iterdir())] == [".whl", ".gz"]
