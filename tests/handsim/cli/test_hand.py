from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from gloves import GloveFit, Take, attach, load_layout, load_take
from gloves.fit import attach_markers, wear
from handsim import HandModel, join_qpos, sample_shape
from handsim.cli.main import main
from handsim.hand.model_files import coordinate_names, coordinate_values
from handsim.hand.shape import JOINT_NAMES
from handsim.space.transforms import UpAxis
from track import User, load_user


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


def test_an_opensim_model_has_the_markers_of_the_glove(tmp_path: Path) -> None:
    out = tmp_path / "hand.osim"
    assert main(["hand", "--out", str(out), "--side", "left", "--glove", "dense19"]) == 0
    names = {marker.get("name") for marker in ET.parse(out).iter("Marker")}
    assert names > {*load_layout("dense19").names, "left:ThumbTip", "left_wrist", "left_little_tip"}


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_mesh_is_the_skin(suffix: str, tmp_path: Path) -> None:
    mesh = tmp_path / f"hand.{suffix}"
    assert main(["hand", "--out", str(tmp_path / "hand.xml"), "--mesh", str(mesh)]) == 0
    loaded = trimesh.load(mesh, force="mesh", process=False)
    surface = HandModel.named("M").surface
    np.testing.assert_allclose(loaded.bounds, [surface.vertices.min(0), surface.vertices.max(0)], atol=1e-6)
    assert len(loaded.faces) == len(surface.faces)
    assert loaded.volume > 0  # faces look outwards


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people: a user of two calibrated hands, and a take of one left hand."""
    rng, folder = np.random.default_rng(5), tmp_path_factory.mktemp("people")
    layout = load_layout("dense19")
    model = HandModel(sample_shape(rng=rng))
    fit = GloveFit(model, wear(layout, model, along=0.002, around=0.05, rng=rng))
    User((fit, fit.with_side("left"))).save(folder / "user.json")
    hand = attach(layout, HandModel(sample_shape(side="left", rng=rng)))
    Take.of_poses([hand], join_qpos(np.zeros((3, 20)))[:, None], rate=120.0).save(folder / "one.truth.npz")
    return folder


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_user_leaves_with_the_calibrated_markers(files: Path, side: str, tmp_path: Path) -> None:
    out = tmp_path / "hand.xml"
    assert main(["hand", "--shape", str(files / "user.json"), "--side", side, "--out", str(out)]) == 0
    (fit,) = (fit for fit in load_user(files / "user.json") if fit.side == side)
    opened = mujoco.MjModel.from_xml_path(str(out))
    data = mujoco.MjData(opened)
    mujoco.mj_kinematics(opened, data)
    np.testing.assert_allclose(data.xpos[1:], fit.model.rest_transforms[:, :3, 3], atol=1e-5)
    sites = np.stack([data.site(name).xpos for name in fit.layout.names])
    np.testing.assert_allclose(sites, fit.attachment.points, atol=1e-5)


def test_the_only_hand_of_a_take_is_taken(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = str(files / "one.truth.npz")
    for name in ("hand.urdf", "hand.glb"):
        assert main(["hand", "--take", take, "--out", str(tmp_path / name)]) == 0
    assert "left hand of" in capsys.readouterr().out
    shape = load_take(take).hands[0].shape
    opened = mujoco.MjModel.from_xml_path(str(tmp_path / "hand.urdf"))
    middle = opened.body("middle_middle").pos  # in the frame of the bone before it
    assert opened.njnt == 20
    assert opened.body("middle_proximal_abduction").pos == pytest.approx(shape.knuckles[2] * [1, -1, 1])
    assert np.linalg.norm(middle) in (pytest.approx(0.0), pytest.approx(shape.bone_lengths[2, 0]))
    mesh = trimesh.load(tmp_path / "hand.glb", force="mesh", process=False)
    assert len(mesh.vertices) == len(HandModel(shape).surface.vertices)


@pytest.mark.parametrize("up", ["y", "z"])
def test_an_opensim_model_begins_in_the_first_pose_of_a_take_with_any_axis_up(
    up: UpAxis, files: Path, tmp_path: Path
) -> None:
    take, out = files / "one.truth.npz", tmp_path / "hand.osim"
    assert main(["hand", "--take", str(take), "--out", str(out), "--up", up]) == 0
    begins = {
        one.get("name"): float(one.findtext("default_value") or "nan")
        for one in ET.parse(out).iter("Coordinate")
    }
    values = coordinate_values(load_take(take).qpos[:1, 0], up)[0]
    expected = dict(zip(coordinate_names("left"), values, strict=True))
    assert begins == pytest.approx(expected, abs=1e-9)


def test_servos_go_where_they_are_told(tmp_path: Path, rng: np.random.Generator) -> None:
    out = tmp_path / "hand.xml"
    assert main(["hand", "--out", str(out), "--size", "XS", "--actuators"]) == 0
    opened = mujoco.MjModel.from_xml_path(str(out))
    assert [opened.actuator(n).name for n in range(opened.nu)] == list(JOINT_NAMES)
    np.testing.assert_allclose(opened.actuator_ctrlrange, HandModel.named("XS").skeleton.ranges, atol=1e-5)
    data = mujoco.MjData(opened)
    goal = np.clip(rng.uniform(0.1, 0.5, size=20), *opened.actuator_ctrlrange.T)
    data.ctrl[:] = goal
    for _ in range(500):  # a second
        mujoco.mj_step(opened, data)
    np.testing.assert_allclose(data.qpos[7:], goal, atol=0.02)  # fingers may touch
