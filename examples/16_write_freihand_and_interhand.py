"""Write your own dataset formats: the files of FreiHAND and of InterHand2.6M, for loaders of these sets.

    python examples/16_write_freihand_and_interhand.py [FOLDER]

Both count pixels from the first one's center, half a pixel less than handsim, and hold pinhole cameras only.
FreiHAND has one entry per visible hand; left hands stay left hands. InterHand2.6M has a right and a left hand
in millimeters, digits from tip to base before the wrist, and numerals for cameras, another for each pose.
Neither has MANO parameters. InterHand2.6M's `annotations/skeleton.txt` is that of the original set.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from render import RenderedFrame, draw
from train import simulate_take

TIP_TO_BASE = [joint for base in range(1, 21, 4) for joint in range(base + 3, base - 1, -1)]
INTERHAND_JOINTS = [*TIP_TO_BASE, 0]  # our keypoints in the order of InterHand2.6M


def centered_K(frame: RenderedFrame) -> np.ndarray:
    """Camera matrix (3, 3) for pixels that are counted from the first one's center."""
    if frame.camera.lens.kind != "pinhole":
        raise SystemExit(f"camera '{frame.camera.name}' has a lens, which neither format can hold")
    return frame.camera.K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


def save_picture(path: Path, picture: np.ndarray, quality: int = 95) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = picture[..., ::-1] if picture.ndim == 3 else picture
    cv2.imwrite(str(path), ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])


def write_freihand(folder: Path, frames: Sequence[RenderedFrame]) -> int:
    """Write `training/rgb`, `training/mask` and the lists `training_*.json`; return the number of entries."""
    lists: dict[str, list] = {"K": [], "xyz": [], "scale": [], "mano": [], "info": []}
    for frame in frames:
        for hand in frame.hands:
            if not hand.mask.any():
                continue
            name = f"{len(lists['K']):08d}.jpg"
            save_picture(folder / "training" / "rgb" / name, frame.rgb)
            save_picture(folder / "training" / "mask" / name, 255 * hand.mask.astype(np.uint8), quality=100)
            bone = hand.keypoints_world[10] - hand.keypoints_world[9]  # the first one of the middle finger
            lists["K"].append(centered_K(frame).tolist())
            lists["xyz"].append(frame.camera.local(hand.keypoints_world).tolist())
            lists["scale"].append(float(np.linalg.norm(bone)))
            lists["mano"].append(None)
            lists["info"].append({"side": hand.shape.side, "frame": frame.number})
    for name, values in lists.items():
        (folder / f"training_{name}.json").write_text(json.dumps(values))
    return len(lists["K"])


def write_interhand(folder: Path, frames: Sequence[RenderedFrame]) -> int:
    """Write `images/train` and `annotations/train/InterHand2.6M_train_*.json`; return how many pictures."""
    numerals: dict[tuple[str, bytes], str] = {}
    cameras: dict[str, dict] = {"campos": {}, "camrot": {}, "focal": {}, "princpt": {}}
    images, annotations, joints = [], [], {}
    for number, frame in enumerate(frames, start=1):
        K, pose = centered_K(frame), frame.camera.T_world_camera
        camera = numerals.setdefault((frame.camera.name, pose.tobytes()), str(len(numerals)))
        cameras["campos"][camera] = (1e3 * pose[:3, 3]).tolist()
        cameras["camrot"][camera] = pose[:3, :3].T.tolist()
        cameras["focal"][camera], cameras["princpt"][camera] = [K[0, 0], K[1, 1]], K[:2, 2].tolist()
        world, valid = np.zeros((2, 21, 3)), np.zeros((2, 21), dtype=int)
        for hand in frame.hands:
            row = ("right", "left").index(hand.shape.side)
            world[row], valid[row] = 1e3 * hand.keypoints_world[INTERHAND_JOINTS], 1
        kind = "interacting" if len(frame.hands) == 2 else frame.hands[0].shape.side
        of_hands = {"hand_type": kind, "hand_type_valid": 1}
        joints[str(frame.number)] = {
            "world_coord": world.reshape(42, 3).tolist(),
            "joint_valid": valid.reshape(42, 1).tolist(),
            **of_hands,
        }
        name, (width, height) = f"{frame.key}.jpg", frame.camera.size
        save_picture(folder / "images" / "train" / name, frame.rgb)
        images.append(
            {
                **{"id": number, "file_name": name, "width": width, "height": height, "capture": 0},
                **{"subject": 0, "seq_name": "handsim", "camera": camera, "frame_idx": frame.number},
            }
        )
        rows, columns = np.nonzero(np.any([hand.mask for hand in frame.hands], axis=0))
        if len(rows):
            left, top = int(columns.min()), int(rows.min())
            box = [left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top]
            one = {"id": number, "image_id": number, "category_id": 1, "iscrowd": 0, "bbox": box}
            annotations.append({**one, "joint_valid": valid.ravel().tolist(), **of_hands})
    data = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "hand"}]}
    start = folder / "annotations" / "train"
    start.mkdir(parents=True)
    for name, content in {"data": data, "camera": {"0": cameras}, "joint_3d": {"0": joints}}.items():
        (start / f"InterHand2.6M_train_{name}.json").write_text(json.dumps(content))
    return len(images)


def largest_error(folder: Path, frames: Sequence[RenderedFrame]) -> float:
    """Read InterHand2.6M's files as its loader does; largest distance from our keypoints [px]."""
    start = folder / "annotations" / "train" / "InterHand2.6M_train"
    data, cameras, joints = (
        json.loads(Path(f"{start}_{name}.json").read_text()) for name in ("data", "camera", "joint_3d")
    )
    errors = []
    for image, frame in zip(data["images"], frames, strict=True):
        camera = {name: np.array(table[image["camera"]]) for name, table in cameras["0"].items()}
        world = np.array(joints["0"][str(image["frame_idx"])]["world_coord"])
        local = (world - camera["campos"]) @ camera["camrot"].T
        pixels = (local[:, :2] / local[:, 2:] * camera["focal"] + camera["princpt"]).reshape(2, 21, 2)
        for hand in frame.hands:
            mine = pixels[("right", "left").index(hand.shape.side)]
            errors.append(np.abs(mine - (hand.keypoints[INTERHAND_JOINTS] - 0.5)).max())
    return float(max(errors))


def main() -> None:
    take = simulate_take(kind="hand-hand", num_frames=25)
    frames = list(draw(take, frames=(0, 12, 24), view={"views": 2}, passes=("rgb",), seed=0))
    with TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else temporary)
        print(f"FreiHAND: {write_freihand(folder / 'freihand', frames)} hands")
        print(f"InterHand2.6M: {write_interhand(folder / 'interhand', frames)} pictures")
        xyz, K = (
            json.loads((folder / f"freihand/training_{name}.json").read_text()) for name in ("xyz", "K")
        )
        projected = np.einsum("nij,nkj->nki", np.array(K), np.array(xyz))
        own = [hand.keypoints - 0.5 for frame in frames for hand in frame.hands if hand.mask.any()]
        error = np.abs(projected[..., :2] / projected[..., 2:] - own).max()
        assert max(error, largest_error(folder / "interhand", frames)) < 1e-3
        print("read again, their keypoints are where ours are")


if __name__ == "__main__":
    main()
