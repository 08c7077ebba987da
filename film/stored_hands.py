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

_SEEN: Final = 2.0  # COCO's flag of a keypoint that is seen; 1 is hidden, 0 not found


@dataclass(frozen=True, slots=True, eq=False)
class StoredHands:
    """The hands of a video, as any detector found them."""

    frames: Mapping[int, Sequence[FoundHand]]
    """By the number of the frame in the video, from 0; frames that were not looked at are missing."""

    @classmethod
    def load(cls, path: str | Path) -> StoredHands:
        """Read COCO keypoints: an image for each frame that was looked at, whose `id` is the frame's number.

        An annotation has `image_id`, `side` ("right" or "left"), `keypoints` (u, v [px] from the first
        pixel's center, and COCO's flag, 21 times in the order of `KEYPOINT_NAMES`), and may have `score`
        and `keypoint_scores`.

        Raises:
            DatasetError: The file is no such file.
        """
        content = load_json(Path(path))
        with errors_of(path, DatasetError):
            try:
                found: dict[int, list[FoundHand]] = {_number(image["id"]): [] for image in content["images"]}
                for label in content["annotations"]:
                    found[label["image_id"]].append(_hand(label))
            except (KeyError, TypeError, AttributeError) as error:
                raise DatasetError(
                    f"not COCO keypoints of a video ({error}), expected images with `id` and annotations "
                    "with `image_id`, `side` and `keypoints`"
                ) from error
            if not any(found.values()):
                raise DatasetError("no hand in any frame, expected annotations of hands")
        return cls(found)


def _number(given: Any) -> int:
    if not isinstance(given, int) or given < 0:
        raise DatasetError(f"the id of an image is {given!r}, expected the number of a frame, from 0")
    return given


def _hand(label: Mapping[str, Any]) -> FoundHand:
    """The hand of an annotation."""
    pixels, flags = labeled_keypoints(label)
    if not np.isfinite([*pixels.ravel(), *flags]).all():
        raise DatasetError("keypoints of a hand are not finite, expected pixels and COCO's flags")
    check_choice(label["side"], SIDES, noun="side")
    sure = float(label.get("score", 1.0))
    scores = sure * np.clip(flags / _SEEN, 0.0, 1.0)
    if "keypoint_scores" in label:
        given = np.asarray(label["keypoint_scores"], dtype=np.float64)
        scores = np.where(flags > 0.0, check_array("keypoint_scores", given, (NUM_KEYPOINTS,)), 0.0)
    known = pixels[scores > 0.0] if (scores > 0.0).any() else pixels
    box = np.concatenate([known.min(axis=0), np.ptp(known, axis=0)])
    return FoundHand(label["side"], box, sure, pixels, scores)
