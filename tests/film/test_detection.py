"""Files of keypoints of drawn pictures: gloves, rooms, videos, damaged pictures, and what film reads."""

from __future__ import annotations

import itertools
import json
import types

import cv2
import numpy as np
import pytest

from film import HandDetector, StoredHands, detect_hands
from film.detection import resolve_detector
from film.training import draw_scenes
from handsim.cli.main import main
from handsim.errors import ArgumentError
from handsim.hand.model import KEYPOINT_NAMES
from render.illustrations import write_video

GLOVED = 1  # number of a shard


@pytest.fixture(scope="module")
def gloved():
    """Drawn pictures of a hand in a glove that nobody learned from."""
    return [one for one in itertools.islice(draw_scenes(GLOVED, seed=4321), 12) if len(one.sides)]


@pytest.fixture(scope="module")
def folder(gloved, tmp_path_factory):
    """These pictures, and one of a room without hands."""
    folder = tmp_path_factory.mktemp("pictures")
    for number, scene in enumerate(gloved):
        cv2.imwrite(str(folder / f"{number:02d}.png"), scene.picture[..., ::-1])
    steps = np.linspace(60, 200, 320, dtype=np.uint8)
    cv2.imwrite(str(folder / "empty.png"), np.tile(steps[None, :, None], (240, 1, 3)))
    return folder


def test_drawn_gloves_are_found_and_film_reads_the_file(folder, gloved, tmp_path, capsys):
    file = tmp_path / "out" / "keypoints.json"
    assert main(["detect", str(folder), "--out", str(file)]) == 0
    told = capsys.readouterr().out
    content = json.loads(file.read_text("utf-8"))
    assert content["categories"][0]["keypoints"] == list(KEYPOINT_NAMES)
    names = [image["file_name"] for image in content["images"]]
    assert [(file.parent / name).is_file() for name in names] == [True] * (len(gloved) + 1)
    with_hands = {one["image_id"] for one in content["annotations"]}
    assert len(gloved) not in with_hands and len(with_hands) > 0.6 * len(gloved)
    assert f"hands in {len(with_hands)} of {len(names)} pictures" in told
    assert cv2.imread(str(file.with_suffix(".jpg"))).shape[1] > 900
    found = StoredHands.load(file)
    number = min(with_hands)
    ours = HandDetector.load().detect(gloved[number].picture)
    assert len(found.frames[number]) == len(ours)
    for one, other in zip(found.frames[number], ours, strict=True):
        inside = one.scores > 0.0
        assert one.side == other.side and inside.sum() > 10
        np.testing.assert_allclose(one.keypoints[inside], other.keypoints[inside], atol=1e-4)
        np.testing.assert_allclose(one.scores[inside], other.scores[inside], atol=1e-4)


def test_a_video_is_searched_ten_times_a_second(gloved, tmp_path):
    size = gloved[0].picture.shape[1::-1]
    write_video(tmp_path / "video.mp4", (gloved[0].picture for _ in range(9)), rate=30.0, size=size)
    found = detect_hands(tmp_path / "video.mp4", tmp_path / "found.json")
    assert sorted(found.frames) == [0, 3, 6]
    images = json.loads((tmp_path / "found.json").read_text("utf-8"))["images"]
    assert [image["id"] for image in images] == [0, 3, 6] and images[1]["time"] == pytest.approx(0.1)


def test_bad_pictures_are_told_in_one_sentence(folder, tmp_path, capsys):
    data = (folder / "00.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "none").mkdir()
    out = ["--out", str(tmp_path / "out.json")]
    for words, told in (
        ([str(tmp_path / "cut.png"), *out], "cut.png"),
        ([str(tmp_path / "text.mp4"), *out], "not a video that can be read"),
        ([str(tmp_path / "nowhere.jpg"), *out], "nowhere.jpg"),
        ([str(tmp_path / "none"), *out], "no photograph"),
        ([str(folder), "--out", str(tmp_path / "out.txt")], "ends in .json"),
        ([str(folder), *out, "--detector", str(tmp_path / "none")], "finder.onnx"),
        ([str(folder), *out, "--detector", "found.json"], "found.json"),
    ):
        assert main(["detect", *words]) == 1
        error = capsys.readouterr().err
        assert told in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out.json").exists()


def test_hands_of_a_file_are_found_already(tmp_path):
    hands = StoredHands({0: []})
    assert resolve_detector(hands) is hands
    with pytest.raises(ArgumentError, match="expected handsim, mediapipe or a folder"):
        detect_hands(tmp_path / "a.png", tmp_path / "out.json", detector=hands)
    with pytest.raises(ArgumentError, match="detector is 'mdiapipe', expected handsim, mediapipe, a folder"):
        resolve_detector("mdiapipe")


def test_sides_of_mediapipe_are_those_of_a_mirror(monkeypatch):
    mark, side = types.SimpleNamespace(x=0.5, y=0.25), types.SimpleNamespace(score=0.9, label="Left")
    told = types.SimpleNamespace(
        multi_hand_landmarks=[types.SimpleNamespace(landmark=[mark] * 21)],
        multi_handedness=[types.SimpleNamespace(classification=[side])],
    )
    hands = types.SimpleNamespace(Hands=lambda **_: types.SimpleNamespace(process=lambda image: told))
    package = types.SimpleNamespace(solutions=types.SimpleNamespace(hands=hands))
    monkeypatch.setattr("film.detection.import_extra", lambda *_: package)
    (hand,) = resolve_detector("mediapipe").detect(np.zeros((40, 80, 3), np.uint8))
    assert hand.side == "right" and hand.confidence == 0.9
    np.testing.assert_allclose(hand.keypoints, np.tile([40.0, 10.0], (21, 1)))
