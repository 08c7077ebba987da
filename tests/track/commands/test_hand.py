from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from gloves.attachment import attach_markers
from gloves.layout import load_layout
from handsim.app.cli import main
from handsim.hand.model import HandModel


@pytest.mark.parametrize("side", ["right", "left"])
def test_model_opens_and_moves_as_ours_does(side: str, tmp_path: Path, rng: np.random.Generator) -> None:
    out = tmp_path / "new" / "hand.xml"
    assert main(["hand", "--out", str(out), "--size", "L", "--side", side, "--glove", "dense19"]) == 0
    opened = mujoco.MjModel.from_xml_path(str(out))
    assert (opened.nq, opened.nv, opened.nsite) == (27, 26, 19)
    data = mujoco.MjData(opened)
    data.qpos[:] = rng.uniform(-0.3, 0.3, 27)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    mujoco.mj_kinematics(opened, data)
    model = HandModel.named("L", side=side)  # type: ignore[arg-type]
    ours = model.forward_kinematics(data.qpos[None])[0]
    np.testing.assert_allclose(data.xpos[1:], ours[:, :3, 3], atol=1e-5)  # the XML rounds
    layout = load_layout("dense19")
    mujoco.mj_resetData(opened, data)
    mujoco.mj_kinematics(opened, data)
    sites = np.stack([data.site(name).xpos for name in layout.names])
    np.testing.assert_allclose(sites, attach_markers(layout, model).points, atol=1e-5)


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_mesh_is_the_skin(suffix: str, tmp_path: Path) -> None:
    mesh = tmp_path / f"hand.{suffix}"
    assert main(["hand", "--out", str(tmp_path / "hand.xml"), "--mesh", str(mesh)]) == 0
    loaded = trimesh.load(mesh, force="mesh", process=False)
    surface = HandModel.named("M").surface
    np.testing.assert_allclose(loaded.bounds, [surface.vertices.min(0), surface.vertices.max(0)], atol=1e-6)
    assert len(loaded.faces) == len(surface.faces)
    assert loaded.volume > 0  # faces look outwards


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--out", "hand.txt"], "ends in .xml"),
        (["--mesh", "hand.fbx"], "ends in .glb, .obj, .ply, .stl"),
        (["--glove", "dense18"], "did you mean 'dense19'?"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    args: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["hand", *args]) == 1
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
