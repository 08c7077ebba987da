"""`StoredHands`: hands that another program found in a video, read from its file of keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from film.detector import FoundHand
from handsim._checks import check_array, check_choice
from handsim.errors import DatasetError, errors_of
from handsim.files.inputs import load_json
from handsim.hand.shape import NUM_KEYPOINTS, SIDES
from render.formats.records import labeled_keypoints

_VISIBLE_FLAG: Final = 2.0  # COCO's flag of a visible keypoint; 1 is hidden, 0 not labeled


@dataclass(frozen=True, slots=True, eq=False)
class StoredHands:
    """The hands that any detector found in a video."""

    frames: Mapping[int, Sequence[FoundHand]]
    """Hands by the number of the frame in the video, from 0; frames that were not searched are missing."""

    @classmethod
    def load(cls, path: str | Path) -> StoredHands:
        """Read COCO keypoints: an image for each frame that was searched, whose `id` is the frame's number.

        An annotation has `image_id`, `side` ("right" or "left"), `keypoints` (u, v [px] from the first
        pixel's center, and COCO's flag, 21 times in the order of `KEYPOINT_NAMES`), and may have `score`
        and `keypoint_scores`.

        Raises:
            DatasetError: The file has another format, or no hand.
        """
        content = load_json(Path(path))
        with errors_of(path, DatasetError):
            try:
                hands: dict[int, list[FoundHand]] = {_frame(image["id"]): [] for image in content["images"]}
                for label in content["annotations"]:
                    hands[label["image_id"]].append(_hand(label))
            except (KeyError, TypeError, AttributeError) as error:
                raise DatasetError(
                    f"not COCO keypoints of a video ({error}), expected images with `id` and annotations "
                    "with `image_id`, `side` and `keypoints`"
                ) from error
            if not any(hands.values()):
                raise DatasetError("no hand in any frame, expected annotations of hands")
        return cls(hands)


def _frame(image_id: Any) -> int:
    """Validate the id of an image, which is the number of a frame."""
    if not isinstance(image_id, int) or image_id < 0:
        raise DatasetError(f"the id of an image is {image_id!r}, expected the number of a frame, from 0")
    return image_id


def _hand(label: Mapping[str, Any]) -> FoundHand:
    """Convert an annotation to a hand."""
    pixels, flags = labeled_keypoints(label)
    if not np.isfinite([*pixels.ravel(), *flags]).all():
        raise DatasetError("keypoints of a hand are not finite, expected pixels and COCO's flags")
    check_choice(label["side"], SIDES, noun="side")
    score = float(label.get("score", 1.0))
    scores = score * np.clip(flags / _VISIBLE_FLAG, 0.0, 1.0)
    if "keypoint_scores" in label:
        given = np.asarray(label["keypoint_scores"], dtype=np.float64)
        scores = np.where(flags > 0.0, check_array("keypoint_scores", given, (NUM_KEYPOINTS,)), 0.0)
    known = pixels[scores > 0.0] if (scores > 0.0).any() else pixels
    box = np.concatenate([known.min(axis=0), np.ptp(known, axis=0)])
    return FoundHand(label["side"], box, score, pixels, scores)
