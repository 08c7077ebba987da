"""`handsim rig import`, as a user types it."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.cli.main import main
from handsim.space.cameras import load_rig
from tests.handsim.space.rig_formats.known_rig import MCAL, POSITIONS, XCP, written


@pytest.mark.parametrize("kind", ["vicon", "qualisys", "motive", "extri", "json"])
def test_a_calibration_becomes_a_rig(tmp_path, capsys, kind):
    file, out = written(tmp_path)[kind], tmp_path / "rig.toml"
    assert main(["rig", "import", str(file), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert f"{out}: 2 cameras, field of view 36.9 degrees, " in said.out.replace("\n", " ")
    assert said.err == ""
    np.testing.assert_allclose(load_rig(out).positions, POSITIONS, atol=1e-6)


def test_what_is_left_out_is_told(tmp_path, capsys):
    video = XCP[XCP.index("<Camera ") : XCP.index("</Cameras>")].replace("Vantage", "Vue")
    bent = XCP.replace('VICON_RADIAL="0 0"', 'VICON_RADIAL="4e-8 0"').replace(
        "</Cameras>", video + "</Cameras>"
    )
    (tmp_path / "lab.xcp").write_text(bent)
    assert main(["rig", "import", str(tmp_path / "lab.xcp"), "--out", str(tmp_path / "rig.toml")]) == 0
    first, second = capsys.readouterr().err.splitlines()
    assert "video cameras see no markers and are left out: 2100_3, 2101_4" in first
    assert "lenses move the corners of pictures by up to 1" in second and "camera '2100'" in second
    assert len(load_rig(tmp_path / "rig.toml").positions) == 2


def test_another_axis_up(tmp_path, capsys):
    (tmp_path / "lab.mcal").write_bytes(MCAL.encode("utf-16"))
    out = tmp_path / "rig.toml"
    assert main(["rig", "import", str(tmp_path / "lab.mcal"), "--out", str(out), "--up", "z"]) == 0
    assert "do not point up on average; is another axis up? --up says which" in capsys.readouterr().err
    np.testing.assert_allclose(load_rig(out).positions, [[0, 1, 3], [4, 2, -1]])


def test_wrong_names_of_files(tmp_path, capsys):
    file = written(tmp_path)["vicon"]
    assert main(["rig", "import", str(file), "--out", str(tmp_path / "rig.json")]) == 1
    assert "expected a file name that ends in .toml" in capsys.readouterr().err
    assert main(["rig", "import", str(tmp_path / "lab.cal"), "--out", str(tmp_path / "rig.toml")]) == 1
    assert "Motive's .cal is a closed format; load it in Motive 3.2" in capsys.readouterr().err
    (tmp_path / "rig.toml").write_text("mine")
    assert main(["rig", "import", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "rig.toml")]) == 1
    assert "is the input" in capsys.readouterr().err
    assert (tmp_path / "rig.toml").read_text() == "mine"
