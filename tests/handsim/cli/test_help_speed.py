"""Help loads no compiler and none of the libraries that commands work with."""

from __future__ import annotations

import pytest

from tests.programs import run_python

HEAVY = (
    "numba",
    "torch",
    "scipy.ndimage",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.interpolate",
    "scipy.optimize",
    "trimesh",
    "mujoco",
    "matplotlib",
)
CODE = """
import sys
from handsim.cli.main import main
try:
    main()
finally:
    print("loaded", *sorted(set({heavy}) & set(sys.modules)))
"""


@pytest.mark.parametrize(
    "command",
    [
        "label",
        "track",
        "render",
        "train",
        "evaluate",
        "hand",
        "glove",
        "rig",
        "glove score",
        "export",
    ],
)
def test_help_loads_nothing_heavy(command, tmp_path):
    own = {"XDG_CACHE_HOME": str(tmp_path)}  # no kept page
    told = run_python(CODE.format(heavy=HEAVY), *command.split(), "--help", **own)
    assert f"usage: handsim {command}" in told.stdout
    assert told.stdout.splitlines()[-1] == "loaded"
    kept = run_python(CODE.format(heavy=(*HEAVY, "tyro", "numpy")), *command.split(), "--help", **own)
    assert kept.stdout == told.stdout


def test_kernels_stay_compiled_in_a_program_that_asks_for_help():
    code = (
        "import sys, contextlib\n"
        "from handsim.cli.main import main\n"
        "with contextlib.suppress(SystemExit):\n    main(['label', '--help'])\n"
        "from handsim.kernels import point_distance\n"
        "print(type(point_distance).__name__)"
    )
    assert run_python(code, "label", "--help").stdout.splitlines()[-1] == "CPUDispatcher"
