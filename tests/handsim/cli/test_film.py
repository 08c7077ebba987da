from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from film import annotation
from handsim.cli.main import main
from handsim.errors import HandSimError
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
    assert "frames fit" in capsys.readouterr().out and not (out / "study.json").exists()


def test_several_videos_have_a_folder_each_and_a_bad_one_stops_none(
    files, pictures, tmp_path, capsys, monkeypatch
):
    take, out, later = moving_take(), tmp_path / "out", 8  # the second camera begins eight frames later
    write_video(tmp_path / "late.mp4", iter(pictures[later:]), rate=FILMING.rate, size=SIZE)
    (tmp_path / "bad.mp4").write_text("no video")

    def found(film, detector, progress):
        hands = FILMING.found(take)[len(pictures) - film.num_frames :]
        return [frame._replace(time=number / FILMING.rate) for number, frame in enumerate(hands)]

    monkeypatch.setattr(annotation, "find_hands", found)
    videos = [str(files / "video.mp4"), str(tmp_path / "bad.mp4"), str(tmp_path / "late.mp4")]
    words = ["film", str(files / "take.npz"), *videos, "--out", str(out), "--format", "coco"]
    words += ["--passes", "rgb", "--num-frames", "2"]
    assert main([*words, "--workers", "1"]) == 1
    said = capsys.readouterr()
    assert f"{videos[1]}: not registered: not a video that can be read" in said.err
    assert said.err.splitlines()[-1] == f"handsim film: 1 of 3 files were not registered: {videos[1]}"
    assert {path.name for path in out.iterdir()} == {"video", "late", "study.json"}
    table = said.out.splitlines()[-3:-1]
    clocks = (FILMING.offset, FILMING.offset + later / FILMING.rate)
    for name, clock, line in zip(("video", "late"), clocks, table, strict=True):
        record = json.loads((out / name / "film.json").read_text("utf-8"))
        assert len(json.loads((out / name / "annotations.json").read_text("utf-8"))["images"]) == 2
        assert abs(record["offset"] - clock) < 0.003
        row = line.split()
        assert row[0] == name
        place = np.array(record["cameras"][0]["T_world_camera"])[:3, 3]
        assert np.allclose(np.array(row[1:4], float), place, atol=6e-4)
        told = [1e3 * record["deviations"]["position"], record["cameras"][0]["K"][0][0], record["offset"]]
        assert np.allclose(np.array(row[4:7], float), told, atol=0.06)
        (counts,) = (line for line in said.out.splitlines() if line.startswith(f"{out / name}: "))
        counted, frames = int(counts.split()[1]), int(counts.split()[3])
        assert frames == record["frames"] and row[7] == f"{100 * counted / frames:.0f}"

    def refuse(*given, **settings):
        raise HandSimError(f"{Path(given[1]).name} again")

    monkeypatch.setattr(annotation, "annotate_film", refuse)
    assert main([*words, "--workers", "2"]) == 1  # what is there stays, whatever the number of processes is
    again = capsys.readouterr().out.splitlines()
    assert again[2:] == [*table, f"{out}: 0 files registered now, 2 before"]
    next((out / "late").rglob("*.jpg")).unlink()
    assert main(words) == 1
    error = capsys.readouterr().err
    assert "late.mp4 again" in error and "video.mp4 again" not in error


def test_several_videos_are_refused_before_work(files, tmp_path, capsys):
    take, video, out = str(files / "take.npz"), str(files / "video.mp4"), tmp_path / "out"
    for words, told in (
        ([], "no video is given"),
        ([video, str(tmp_path / "video.mov")], f"two outputs are {out / 'video'}, expected two files"),
        ([video, "b.mp4", "--detector", "found.json"], "found.json and 2 videos, expected the one"),
    ):
        assert main(["film", take, *words, "--out", str(out)]) == 1
        error = capsys.readouterr().err
        assert told in error and len(error.strip().splitlines()) == 1 and not out.exists()


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
