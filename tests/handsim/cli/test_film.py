from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from handsim.cli.main import main
from render.illustrations import write_video
from tests.film.filmed import SIZE, Filming, moving_take

FILMING = Filming(seed=21, seconds=8.0, rate=8.0, missing=0.0, swapped=0.0, readout=(0.0, 0.0))


def write_found(path: Path, take) -> None:
    """Write what another program finds as COCO keypoints."""
    frames = FILMING.found(take)
    labels = [
        {
            "image_id": number,
            "side": hand.side,
            "score": hand.confidence,
            "keypoints": np.column_stack([hand.keypoints - 0.5, np.full(21, 2)]).ravel().tolist(),
        }
        for number, frame in enumerate(frames)
        for hand in frame.hands
    ]
    images = [{"id": number, "file_name": f"{number}.png"} for number in range(len(frames))]
    path.write_text(json.dumps({"images": images, "annotations": labels}))


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return FILMING.pictures(moving_take())


@pytest.fixture(scope="module")
def files(tmp_path_factory, pictures) -> Path:
    folder = tmp_path_factory.mktemp("film")
    moving_take().save(folder / "take.npz")
    write_video(folder / "video.mp4", iter(pictures), rate=FILMING.rate, size=SIZE)
    return folder


def test_a_video_becomes_photographs(files, pictures, tmp_path, capsys):
    take = moving_take()
    write_found(tmp_path / "found.json", take)
    out = tmp_path / "out"
    words = ["film", str(files / "take.npz"), str(files / "video.mp4"), "--out", str(out)]
    words += ["--detector", str(tmp_path / "found.json")]
    assert main([*words, "--format", "coco", "--num-frames", "3", "--workers", "1"]) == 0
    content = json.loads((out / "annotations.json").read_text("utf-8"))
    assert len(content["images"]) == 3 and content["annotations"][0]["num_keypoints"] > 0
    middle = content["images"][1]
    picture = cv2.imread(str(next(out.rglob(Path(middle["file_name"]).name))))
    number = int(Path(middle["file_name"]).stem.rsplit("_", 1)[1])
    away = [np.abs(picture[..., ::-1].astype(float) - one).mean() for one in pictures]
    assert int(np.argmin(away)) == number
    record = json.loads((out / "film.json").read_text("utf-8"))
    assert abs(record["offset"] - FILMING.offset) < 0.003
    assert (out / "film.mp4").is_file() and "Camera and clock" in (out / "film.html").read_text("utf-8")
    assert "frames fit" in capsys.readouterr().out


def test_mistakes_are_sentences(files, tmp_path, capsys):
    take, video, out = str(files / "take.npz"), str(files / "video.mp4"), str(tmp_path / "out")
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "rig.toml").write_text("")
    for words, told in (
        ([take, str(tmp_path / "text.mp4")], "not a video that can be read"),
        ([take, str(tmp_path / "none.mp4")], "none.mp4: no such file"),
        ([video, video], "video.mp4"),
        ([take, video, "--camera", str(tmp_path / "rig.toml")], "rig.toml"),
    ):
        assert main(["film", *words, "--out", out]) == 1
        error = capsys.readouterr().err
        assert told in error and len(error.strip().splitlines()) == 1
