"""`detect_hands`: the hands in photographs or in a video, as a file of COCO keypoints and a contact sheet."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from film.bundle import FoundFrame
from film.detector import FoundHand, HandDetector
from film.stored_hands import StoredHands
from film.video import Film
from handsim._checks import check_type
from handsim._plugins import import_extra
from handsim._version import full_version
from handsim.callbacks import Progress, no_progress
from handsim.errors import ArgumentError, CaptureError
from handsim.files.outputs import atomic_write, check_outputs, write_text
from handsim.hand.shape import NUM_KEYPOINTS
from render.captions import draw_keypoints, in_rows, scaled
from render.formats.coco import CATEGORY, keypoint_triples
from render.formats.records import encode_jpeg, rounded, to_json
from render.frames import Bytes
from render.photographs import PHOTO_SUFFIXES, is_map, read_photograph
from render.scenery.backgrounds import photo_files

_LOOKS: Final = 10.0  # [Hz] how often the detector looks at a video; a take has the motion between two looks
_MOST_FOUND: Final = 8  # hands that MediaPipe may find in a picture
_SHOWN: Final = 24  # pictures on the contact sheet
_WIDTH: Final = 320  # of a picture on it [px]
_DETECTORS: Final = "handsim, mediapipe, a folder of weights or a file of keypoints (.json)"
_IN_A_MIRROR: Final = {"Left": "right", "Right": "left"}
"""Our names for MediaPipe's sides, which are those of a mirrored picture."""


class MediaPipeHands:
    """The hands that MediaPipe finds, as `HandDetector` gives them."""

    def __init__(self) -> None:
        package = import_extra("mediapipe", "the detector mediapipe", "mediapipe")
        self._hands = package.solutions.hands.Hands(static_image_mode=True, max_num_hands=_MOST_FOUND)

    def detect(self, image: Bytes) -> list[FoundHand]:
        """All hands in an sRGB picture; confidence is that of the side, as MediaPipe tells no other."""
        told, found = self._hands.process(image), []
        size, ones = image.shape[1::-1], np.ones(NUM_KEYPOINTS)
        for marks, sides in zip(told.multi_hand_landmarks or (), told.multi_handedness or (), strict=True):
            keypoints = np.array([(one.x, one.y) for one in marks.landmark]) * size
            box = np.concatenate([keypoints.min(axis=0), np.ptp(keypoints, axis=0)])
            sure = float(sides.classification[0].score)
            side: Any = _IN_A_MIRROR[sides.classification[0].label]
            found.append(FoundHand(side, box, sure, keypoints, sure * ones))
        return found


_Finder = HandDetector | MediaPipeHands


def resolve_detector(
    given: HandDetector | StoredHands | str | Path | None,
) -> _Finder | StoredHands:
    """The detector of this name, folder of weights or file of found keypoints; the shipped one for None."""
    if isinstance(given, HandDetector | StoredHands):
        return given
    check_type("detector", given or "", (str, os.PathLike), _DETECTORS)
    if given is None or str(given) == "handsim":
        return HandDetector.load()
    if str(given) == "mediapipe":
        return MediaPipeHands()
    if str(given).lower().endswith(".json"):
        return StoredHands.load(given)
    if not Path(given).is_dir():
        raise ArgumentError(f"detector is '{given}', expected {_DETECTORS}")
    return HandDetector.load(given)


def find_hands(film: Film, detector: _Finder | StoredHands, progress: Progress) -> list[FoundFrame]:
    """The frames of a video, some of them with the hands in them."""
    found: list[FoundFrame] = []
    step = max(1, round(film.rate / _LOOKS))
    for number, (time, picture) in enumerate(film.frames()):
        progress(number + 1, max(film.num_frames, number + 1))
        if isinstance(detector, StoredHands):
            found.append(FoundFrame(time, detector.frames.get(number)))
        else:
            found.append(FoundFrame(time, None if number % step else detector.detect(picture)))
    if not found:
        raise CaptureError(f"{film.path}: no frame can be read, expected a video")
    last = max(detector.frames) if isinstance(detector, StoredHands) else 0
    if last >= len(found):
        raise CaptureError(f"hands of frame {last} were given, and {film.path} has {len(found)} frames")
    return found


class _Searched(NamedTuple):
    """A picture that was searched."""

    record: dict[str, Any]  # of the image in COCO
    hands: Sequence[FoundHand]
    picture: Callable[[], Bytes]  # read again, as all pictures together may be too large


def detect_hands(
    pictures: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    detector: HandDetector | str | Path | None = None,
    progress: Progress = no_progress,
) -> StoredHands:
    """Find the hands in photographs or in a video, and write them as COCO keypoints.

    A contact sheet of the same name (.jpg) beside the file shows up to 24 pictures with what was found.

    Args:
        pictures: Photographs and folders of them, or one video, which is searched ten times a second.
        out: File (.json). An image has the number of the photograph or of the video's frame, from 0, as its
            `id`; an annotation has `side`, `score`, `bbox`, and `keypoints` [px] with their scores.
        detector: A detector, `handsim` for the shipped one, `mediapipe`, or a folder of weights; the shipped
            one when not given.
        progress: Called with the numbers of searched and of all pictures.

    Returns:
        The hands by the number of their picture, for `detector` of `annotate_film`.

    Raises:
        HandSimError: A picture is missing or damaged, or there is none.
    """
    check_type("pictures", pictures, (str, os.PathLike, list, tuple), "photographs, folders or a video")
    given = [pictures] if isinstance(pictures, str | os.PathLike) else pictures
    paths, file = [Path(one) for one in given], Path(out)
    check_outputs(paths, (file, file.with_suffix(".jpg")), ".json")
    finder = resolve_detector(detector)
    if isinstance(finder, StoredHands):
        raise ArgumentError(f"detector is {detector}, expected handsim, mediapipe or a folder of weights")
    one_video = len(paths) == 1 and not paths[0].is_dir() and paths[0].suffix.lower() not in PHOTO_SUFFIXES
    looks = list(_in_video(paths[0], finder, progress) if one_video else _in_photos(paths, finder, progress))
    for look in looks:
        look.record["file_name"] = os.path.relpath(look.record["file_name"], file.parent)
    labels = [_annotation(look.record, hand) for look in looks for hand in look.hands]
    info = {"description": "Hands that handsim found in pictures", "version": full_version()}
    content = {
        "info": info,
        "licenses": [],
        "images": [look.record for look in looks],
        "annotations": [{"id": number, **label} for number, label in enumerate(labels, 1)],
        "categories": [CATEGORY],
    }
    write_text(file, to_json(content))
    cells = []
    for look in looks[:: -(-len(looks) // _SHOWN)]:
        picture, seen = look.picture(), np.ones(NUM_KEYPOINTS, bool)
        scale = min(1.0, _WIDTH / picture.shape[1])
        hands = [(hand.keypoints, seen) for hand in look.hands]
        cells.append(draw_keypoints(scaled(picture, scale), hands, scale=scale))
    with atomic_write(file.with_suffix(".jpg")) as temporary:
        temporary.write_bytes(encode_jpeg(in_rows(cells)))
    return StoredHands({look.record["id"]: look.hands for look in looks})


def _in_photos(paths: Sequence[Path], finder: _Finder, progress: Progress) -> Iterator[_Searched]:
    """The photographs of files and folders."""
    files = [file for path in paths for file in (photo_files(path)[0] if path.is_dir() else (path,))]
    files = [file for file in files if not is_map(file)]
    if not files:
        raise ArgumentError("no photograph was given, expected files or folders of them, or a video")
    for number, file in enumerate(files):
        picture = read_photograph(file)
        record = {"id": number, "file_name": file, "width": picture.shape[1], "height": picture.shape[0]}
        yield _Searched(record, finder.detect(picture), functools.partial(read_photograph, file))
        progress(number + 1, len(files))


def _in_video(path: Path, finder: _Finder, progress: Progress) -> Iterator[_Searched]:
    """The frames of a video that were searched."""
    film = Film(path)
    for number, frame in enumerate(find_hands(film, finder, progress)):
        if frame.hands is not None:
            record = {"id": number, "file_name": path, "time": frame.time}
            record |= dict(zip(("width", "height"), film.size, strict=True))
            yield _Searched(record, frame.hands, functools.partial(film.picture, number))


def _annotation(image: dict[str, Any], hand: FoundHand) -> dict[str, Any]:
    """The COCO annotation of a found hand; the caller adds the annotation's id."""
    size = image["width"], image["height"]
    keypoints = keypoint_triples(hand.keypoints, np.ones(NUM_KEYPOINTS, bool), size)
    return {
        "image_id": image["id"],
        "category_id": CATEGORY["id"],
        "keypoints": keypoints,
        "num_keypoints": sum(flag > 0 for flag in keypoints[2::3]),
        "bbox": rounded(hand.box, 3),
        "area": round(float(hand.box[2] * hand.box[3]), 3),
        "iscrowd": 0,
        "side": hand.side,
        "score": round(hand.confidence, 5),
        "keypoint_scores": rounded(hand.scores, 5),
    }
