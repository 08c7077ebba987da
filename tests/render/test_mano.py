"""MANO's parameters, with a stand-in of the structure of its file: nobody may ship the real one."""

import json

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from handsim import HandModel, sample_shape
from handsim.cli.main import main
from handsim.errors import FileError
from handsim.hand.skin import all_weights
from handsim.space.transforms import random_quaternions
from poses import sample_poses
from render import draw
from render.mano import SHAPES, Mano, ManoFit
from train import simulate_take

BONES = [0, 4, 5, 6, 7, 8, 9, 13, 14, 15, 10, 11, 12, 1, 2, 3]
PARENTS = [2**32 - 1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory):
    """778 vertices of our skin, its weights, and the ten largest differences of people's hands."""
    surface = HandModel.named("M").surface
    known = np.flatnonzero(surface.vertices[:, 0] > -0.005)
    away, chosen = np.full(len(known), np.inf), [int(known[0])]
    while len(chosen) < 778:
        away = np.minimum(
            away, np.linalg.norm(surface.vertices[known] - surface.vertices[chosen[-1]], axis=1)
        )
        chosen.append(int(known[away.argmax()]))
    people = [HandModel(sample_shape(rng=np.random.default_rng([1, n]))) for n in range(60)]
    vertices = np.stack([one.surface.vertices[chosen] for one in people])
    joints = np.stack([one.rest_transforms[BONES, :3, 3] for one in people])
    mean, rows = vertices.mean(axis=0), vertices.transpose(0, 2, 1).reshape(-1, 778)
    _, sizes, ways = np.linalg.svd((vertices - mean).reshape(60, -1), full_matrices=False)
    regressor = np.linalg.lstsq(rows, joints.transpose(0, 2, 1).reshape(-1, 16), rcond=1e-6)[0].T
    arrays = {
        "v_template": mean,
        "shapedirs": (sizes[:10, None] / np.sqrt(60) * ways[:10]).T.reshape(778, 3, 10),
        "posedirs": 1e-5 * np.random.default_rng(0).normal(size=(778, 3, 135)),
        "J_regressor": regressor,
        "weights": all_weights(surface.bone_indices, surface.bone_weights)[chosen][:, BONES],
        "kintree_table": np.array([PARENTS, np.arange(16)], dtype=np.uint32),
    }
    path = tmp_path_factory.mktemp("mano") / "STAND_IN.npz"
    np.savez(path, **arrays)
    return path


def posed(path, record) -> np.ndarray:
    """Vertices (778, 3) of a record as other programs compute them: written for clearness, not for speed."""
    hand = np.load(path)
    turns = Rotation.from_rotvec(np.reshape(record["pose"], (16, 3))).as_matrix()
    rest = hand["v_template"] + hand["shapedirs"] @ record["shape"]
    joints = hand["J_regressor"] @ rest
    rest = rest + hand["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
    chain = np.tile(np.eye(4), (16, 1, 1))
    for joint, parent in enumerate(hand["kintree_table"][0].astype(np.int64)):
        chain[joint, :3, :3] = turns[joint]
        chain[joint, :3, 3] = joints[joint] - (joints[parent] if joint else 0.0)
        chain[joint] = chain[parent] @ chain[joint] if joint else chain[joint]
    chain[:, :3, 3] -= np.einsum("kij,kj->ki", chain[:, :3, :3], joints)
    blended = np.einsum("vk,kij->vij", hand["weights"], chain[:, :3])
    return np.einsum("vij,vj->vi", blended[..., :3], rest) + blended[..., 3] + record["translation"]


def distances(skin: np.ndarray, faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Distance of vertices from a skin, to a few tenths of a millimeter."""
    corners = skin[faces]
    inner = [
        a * corners[:, 0] + b * corners[:, 1] + (1 - a - b) * corners[:, 2]
        for a, b in ((1 / 3, 1 / 3), (0.6, 0.2), (0.2, 0.6), (0.2, 0.2), (0.5, 0.5), (0.5, 0.0), (0.0, 0.5))
    ]
    return KDTree(np.concatenate([skin, *inner])).query(vertices)[0]


@pytest.mark.parametrize("side", ["right", "left"])
def test_parameters_give_the_skin_within_a_millimeter(stand_in, side):
    rng = np.random.default_rng(3)
    model = HandModel(sample_shape(side=side, rng=rng))
    fit = ManoFit(Mano(stand_in), model)
    qpos = sample_poses(model, 12, rng=rng)
    qpos[:, :3], qpos[:, 3:7] = rng.normal(size=(12, 3)), random_quaternions(12, rng=rng)
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    records = fit.records(qpos, camera)
    skins = model.skin(qpos) @ camera[:3, :3].T + camera[:3, 3]
    for record, skin in zip(records, skins, strict=True):
        vertices = posed(stand_in, record) * ([-1.0, 1.0, 1.0] if side == "left" else 1.0)
        off = distances(skin, model.surface.faces, vertices)
        assert record["mirrored"] == (side == "left")
        assert np.sqrt(np.square(off).mean()) < 1e-3
        assert 1e3 * np.sqrt(np.square(off).mean()) < record["rms_mm"] + 0.3 < 2.0
    assert all(record["shape"] == records[0]["shape"] for record in records)
    alone = fit.records(qpos[4:5], camera)[0]
    np.testing.assert_allclose(alone["pose"], records[4]["pose"], atol=1e-5)


def test_pictures_and_coco_have_the_parameters(stand_in, tmp_path):
    take = simulate_take(kind="hand-hand", num_frames=4, seed=2)
    take.save(tmp_path / "take.npz")
    options = ["--format", "coco", "--passes", "rgb", "--num-frames", "2", "--workers", "1"]
    command = ["render", str(tmp_path / "take.npz"), "--out", str(tmp_path / "out"), *options]
    assert main([*command, "--mano", str(stand_in)]) == 0
    annotations = json.loads((tmp_path / "out" / "annotations.json").read_text())["annotations"]
    assert len(annotations) >= 2
    for one in annotations:
        points = posed(stand_in, one["mano"]) * ([-1.0, 1.0, 1.0] if one["side"] == "left" else 1.0)
        assert KDTree(points).query(one["xyz"])[0].max() < 0.03, "keypoints lie in MANO's hand"
    (frame,) = draw(take, frames=[0], passes=("ids",), mano=str(stand_in))
    assert all(hand.mano["rms_mm"] < 2.0 for hand in frame.hands)
    assert draw(take, frames=[0], passes=("ids",)).__next__().hands[0].mano is None


def test_files_that_are_not_manos_are_refused(stand_in, tmp_path):
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(FileError, match=r"expected a \.npz, because pickles can run any program.*np\.savez"):
        Mano(tmp_path / "MANO_RIGHT.pkl")
    arrays = dict(np.load(stand_in))
    np.savez(tmp_path / "objects.npz", **(arrays | {"weights": np.array([None])}))
    with pytest.raises(FileError, match=r"not an \.npz of plain arrays"):
        Mano(tmp_path / "objects.npz")
    np.savez(tmp_path / "short.npz", **(arrays | {"weights": arrays["weights"][:700]}))
    with pytest.raises(FileError, match=r"weights has shape \(700, 16\), expected \(778, 16\)"):
        Mano(tmp_path / "short.npz")
    np.savez(tmp_path / "less.npz", **{name: arrays[name] for name in [*SHAPES][1:]})
    assert (
        main(["render", "none.npz", "--out", str(tmp_path / "o"), "--mano", str(tmp_path / "less.npz")]) == 1
    )
