"""Scenes for other programs: usd-core and embree see what our pictures and records say."""

import cv2
import numpy as np
import pytest
import trimesh

from handsim.cli.main import main
from handsim.errors import ArgumentError
from render import RenderedFrame, draw, write_scene
from train import simulate_take

pxr = pytest.importorskip("pxr")
embree = pytest.importorskip("trimesh.ray.ray_pyembree")
from pxr import Usd, UsdGeom, UsdLux, UsdShade  # noqa: E402

OFF_CENTER = {"placement": "still", "camera": "sr300"}


@pytest.fixture(scope="module")
def take():
    return simulate_take(kind="hand-pen", num_frames=20, seed=3)


def opened(path) -> tuple[Usd.Stage, np.ndarray, np.ndarray]:
    """The stage, its camera's matrix (4, 4) from the world to the film, and its position."""
    stage = Usd.Stage.Open(str(path))
    frustum = UsdGeom.Camera.Get(stage, "/scene/camera").GetCamera(0).frustum
    film = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    return stage, film, np.array(frustum.GetPosition())


def seen_ids(stage: Usd.Stage, film: np.ndarray, eye: np.ndarray, frame: RenderedFrame) -> np.ndarray:
    """Number of the hand or body in each pixel, by embree."""
    owners = ["person", *(hand.shape.side for hand in frame.hands), *(body.name for body in frame.bodies)]
    vertices, faces, ids, count = [], [], [], 0
    for prim in filter(lambda one: one.IsA(UsdGeom.Mesh) and one.GetName() != "behind", stage.Traverse()):
        mesh = UsdGeom.Mesh(prim)
        vertices.append(np.array(mesh.GetPointsAttr().Get()))
        faces.append(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3) + count)
        ids += len(faces[-1]) * [owners.index(prim.GetParent().GetName())]
        count += len(vertices[-1])
    width, height = frame.camera.size
    rows, columns = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    ends = np.stack([2 * columns / width - 1, 1 - 2 * rows / height, 0 * rows, 1 + 0 * rows], axis=1)
    ends = ends @ np.linalg.inv(film)
    rays = ends[:, :3] / ends[:, 3:] - eye
    solid = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    hit = embree.RayMeshIntersector(solid).intersects_first(np.tile(eye, (len(rays), 1)), rays)
    return np.where(hit >= 0, np.array(ids)[hit], 0).reshape(height, width)


@pytest.mark.parametrize("dress", ["skin", "glove"])
def test_scene_has_the_camera_keypoints_and_silhouettes_of_the_picture(take, tmp_path, dress):
    settings = {"view": OFF_CENTER, "seed": 5, "dress": dress}
    write_scene(tmp_path / "scene.usdc", take, frame=7, **settings)
    (frame,) = draw(take, frames=[7], **settings)
    stage, film, eye = opened(tmp_path / "scene.usdc")
    size = np.array(frame.camera.size)
    for hand in frame.hands:
        points = UsdGeom.Points.Get(stage, f"/scene/{hand.shape.side}/keypoints").GetPointsAttr().Get()
        flat = np.column_stack([points, np.ones(21)]) @ film
        pixels = 0.5 * (1.0 + flat[:, :2] / flat[:, 3:] * [1.0, -1.0]) * size
        np.testing.assert_allclose(pixels, hand.keypoints, atol=0.01)
    ids = seen_ids(stage, film, eye, frame)
    for number in np.unique(frame.ids)[1:]:
        mine, theirs = frame.ids == number, ids == number
        assert (mine & theirs).sum() / (mine | theirs).sum() > 0.98


def test_scene_has_textures_lamps_and_the_background_of_the_picture(take, tmp_path):
    write_scene(tmp_path / "scene.usda", take, frame=7, seed=5)
    (frame,) = draw(take, frames=[7], seed=5)
    stage, *_ = opened(tmp_path / "scene.usda")
    lighting = frame.choices["lighting"]
    for number, lamp in enumerate(lighting["lamps"]):
        made = UsdLux.DistantLight.Get(stage, f"/scene/lamp_{number}")
        assert made.GetIntensityAttr().Get() == pytest.approx(np.pi * lamp["strength"])
        towards = np.array(UsdGeom.Xformable(made).ComputeLocalToWorldTransform(0))[2, :3]
        np.testing.assert_allclose(towards, lamp["direction"] / np.linalg.norm(lamp["direction"]), atol=1e-6)
    names = [
        UsdShade.Shader(prim).GetInput("file").Get().path
        for prim in stage.Traverse()
        if prim.IsA(UsdShade.Shader) and UsdShade.Shader(prim).GetInput("file")
    ]
    assert len(names) == 7 and all((tmp_path / name).is_file() for name in names)
    behind = cv2.imread(str(tmp_path / "scene" / "behind.png"))[..., ::-1].astype(int)
    assert np.abs(behind - frame.rgb)[frame.ids == 0].max(axis=-1).mean() < 20.0  # apart from shadows


def test_scene_of_a_record_is_that_picture(take, tmp_path):
    *_, frame = draw(take, frames=[7], view={"placement": "rig"}, seed=2)
    record = {"number": 7, "camera": frame.camera.name, "choices": frame.choices}
    write_scene(tmp_path / "scene.usdc", take, record=record, view={"placement": "rig"}, seed=2)
    _, _, eye = opened(tmp_path / "scene.usdc")
    np.testing.assert_allclose(eye, frame.camera.T_world_camera[:3, 3], atol=1e-6)


def test_scenes_that_cannot_be_written_are_refused(take, tmp_path):
    with pytest.raises(ArgumentError, match=r"expected a file name that ends in \.usdc, \.usda"):
        write_scene(tmp_path / "scene.obj", take, frame=7)
    with pytest.raises(ArgumentError, match="has a fisheye lens, expected pinhole"):
        write_scene(tmp_path / "scene.usdc", take, frame=7, camera="headset_fisheye")
    assert not any(tmp_path.iterdir())


def test_export_writes_a_scene(take, tmp_path, capsys):
    take.save(tmp_path / "take.npz")
    source, scene = str(tmp_path / "take.npz"), tmp_path / "scene.usdc"
    assert main(["export", source, "--scene", str(scene), "--frame", "7"]) == 0
    assert "textures are in" in capsys.readouterr().out
    assert opened(scene)[0].GetPrimAtPath("/scene/behind")
    for wrong in (["--frame", "7"], ["--out", "a.glb", "--scene", "b.usdc"], []):
        assert main(["export", source, *wrong]) == 1
    assert "expected --out, or --scene" in capsys.readouterr().err
