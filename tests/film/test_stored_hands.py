from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from film import StoredHands
from handsim.errors import DatasetError
from tests.sentences import error_names

HAND = {"image_id": 3, "side": "left", "keypoints": [10.0, 20.0, 2] * 20 + [30.0, 60.0, 1], "score": 0.8}


def stored(folder: Path, images: list, labels: list) -> StoredHands:
    path = folder / "found.json"
    path.write_text(json.dumps({"images": images, "annotations": labels}))
    return StoredHands.load(path)


def test_hands_are_by_the_number_of_their_frame(tmp_path):
    found = stored(tmp_path, [{"id": 0}, {"id": 3}], [HAND])
    assert found.frames[0] == [] and 1 not in found.frames
    (hand,) = found.frames[3]
    assert hand.side == "left" and hand.confidence == 0.8
    np.testing.assert_allclose(hand.keypoints[[0, 20]], [[10.5, 20.5], [30.5, 60.5]])
    np.testing.assert_allclose(hand.scores[[0, 20]], [0.8, 0.4])
    np.testing.assert_allclose(hand.box, [10.5, 20.5, 20.0, 40.0])


@pytest.mark.parametrize(
    ("images", "label", "words"),
    [
        ([{"id": "a"}], {}, "the id of an image is 'a', expected the number of a frame"),
        ([{"id": 2}], {}, "not COCO keypoints of a video (3)"),
        ([{"id": 3}], {"side": "R"}, "unknown side 'R'; valid names: left, right"),
        ([{"id": 3}], {"keypoints": [1.0] * 60}, "60 numbers of keypoints of a hand, expected 63"),
        ([{"id": 3}], {"keypoints": None}, "expected 63"),
        (None, {}, "not COCO keypoints of a video"),
    ],
)
def test_other_files_are_refused(images, label, words, tmp_path):
    with error_names(DatasetError, f"found.json: | {words}"):
        stored(tmp_path, images, [{**HAND, **label}])


def test_a_file_without_hands_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="no hand in any frame"):
        stored(tmp_path, [{"id": 3}], [])
