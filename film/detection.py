"""`detect_hands`: finds hands in photographs or in a video, and writes COCO keypoints and a contact sheet."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

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
from handsim.hand.shape import NUM_KEYPOINTS, Side
from render.captions import draw_keypoints, in_rows, scaled
from render.formats.coco import CATEGORY, keypoint_triples
from render.formats.records import encode_jpeg, rounded, to_json
from render.frames import Bytes
from render.photographs import PHOTO_SUFFIXES, is_map, read_photograph
from render.scenery.backgrounds import photo_files

_SEARCH_RATE: Final = 10.0  # [Hz] frames that are searched; a take has the motion between them
_MOST_FOUND: Final = 8  # largest number of hands that MediaPipe may find in a picture
_MOST_SHOWN: Final = 24  # largest number of pictures on the contact sheet
_SHOWN_WIDTH: Final = 320  # [px] width of a picture on it
_DETECTORS: Final = "handsim, mediapipe, a folder of weights or a file of keypoints (.json)"
_UNMIRRORED: Final = {"Left": "right", "Right": "left"}
"""Our names of MediaPipe's sides: MediaPipe expects mirrored pictures."""


class MediaPipeHands:
    """MediaPipe as a detector with the interface of `HandDetector`."""

    def __init__(self) -> None:
        package = import_extra("mediapipe", "the detector mediapipe", "mediapipe")
        self._hands = package.solutions.hands.Hands(static_image_mode=True, max_num_hands=_MOST_FOUND)

    def detect(self, image: Bytes) -> list[FoundHand]:
        """All hands in an sRGB picture; MediaPipe gives no confidence but that of the side."""
        results, hands = self._hands.process(image), []
        landmarks, sides = results.multi_hand_landmarks or (), results.multi_handedness or ()
        for marks, classes in zip(landmarks, sides, strict=True):
            keypoints = np.array([(one.x, one.y) for one in marks.landmark]) * image.shape[1::-1]
            box = np.concatenate([keypoints.min(axis=0), np.ptp(keypoints, axis=0)])
            best = classes.classification[0]
            score, side = float(best.score), cast(Side, _UNMIRRORED[best.label])
            hands.append(FoundHand(side, box, score, keypoints, np.full(NUM_KEYPOINTS, score)))
        return hands


_Detector = HandDetector | MediaPipeHands


def resolve_detector(detector: HandDetector | StoredHands | str | Path | None) -> _Detector | StoredHands:
    """The detector of a name, a folder of weights or a file of keypoints; the shipped one for None."""
    if isinstance(detector, HandDetector | StoredHands):
        return detector
    check_type("detector", detector or "", (str, os.PathLike), _DETECTORS)
    if detector is None or str(detector) == "handsim":
        return HandDetector.load()
    if str(detector) == "mediapipe":
        return MediaPipeHands()
    if str(detector).lower().endswith(".json"):
        return StoredHands.load(detector)
    if not Path(detector).is_dir():
        raise ArgumentError(f"detector is '{detector}', expected {_DETECTORS}")
    return HandDetector.load(detector)


def find_hands(film: Film, detector: _Detector | StoredHands, progress: Progress) -> list[FoundFrame]:
    """All frames of a video; those that were searched have the hands in them."""
    frames, step = list[FoundFrame](), max(1, round(film.rate / _SEARCH_RATE))
    for number, (time, picture) in enumerate(film.frames()):
        progress(number + 1, max(film.num_frames, number + 1))
        if isinstance(detector, StoredHands):
            frames.append(FoundFrame(time, detector.frames.get(number)))
        else:
            frames.append(FoundFrame(time, None if number % step else detector.detect(picture)))
    if not frames:
        raise CaptureError(f"{film.path}: no frame can be read, expected a video")
    last = max(detector.frames) if isinstance(detector, StoredHands) else 0
    if last >= len(frames):
        raise CaptureError(f"hands of frame {last} were given, and {film.path} has {len(frames)} frames")
    return frames


class _Searched(NamedTuple):
    """A picture that was searched."""

    record: dict[str, Any]  # COCO's record of the image
    hands: Sequence[FoundHand]
    picture: Callable[[], Bytes]  # reads it again, because all pictures together may be too large


def detect_hands(
    pictures: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    detector: HandDetector | str | Path | None = None,
    progress: Progress = no_progress,
) -> StoredHands:
    """Find the hands in photographs or in a video, and write them as COCO keypoints.

    A contact sheet of the same name (.jpg) beside the file shows the hands in up to 24 pictures.

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
    resolved = resolve_detector(detector)
    if isinstance(resolved, StoredHands):
        raise ArgumentError(f"detector is {detector}, expected handsim, mediapipe or a folder of weights")
    if len(paths) == 1 and not paths[0].is_dir() and paths[0].suffix.lower() not in PHOTO_SUFFIXES:
        searched = list(_search_video(paths[0], resolved, progress))
    else:
        searched = list(_search_photos(paths, resolved, progress))
    for one in searched:
        one.record["file_name"] = os.path.relpath(one.record["file_name"], file.parent)
    labels = [_annotation(one.record, hand) for one in searched for hand in one.hands]
    content = {
        "info": {"description": "Hands that handsim found in pictures", "version": full_version()},
        "licenses": [],
        "images": [one.record for one in searched],
        "annotations": [{"id": number, **label} for number, label in enumerate(labels, 1)],
        "categories": [CATEGORY],
    }
    write_text(file, to_json(content))
    cells, visible = [], np.ones(NUM_KEYPOINTS, bool)
    for one in searched[:: -(-len(searched) // _MOST_SHOWN)]:
        picture = one.picture()
        scale = min(1.0, _SHOWN_WIDTH / picture.shape[1])
        hands = [(hand.keypoints, visible) for hand in one.hands]
        cells.append(draw_keypoints(scaled(picture, scale), hands, scale=scale))
    with atomic_write(file.with_suffix(".jpg")) as temporary:
        temporary.write_bytes(encode_jpeg(in_rows(cells)))
    return StoredHands({one.record["id"]: one.hands for one in searched})


def _search_photos(paths: Sequence[Path], detector: _Detector, progress: Progress) -> Iterator[_Searched]:
    """Search the photographs in files and folders."""
    files = [file for path in paths for file in (photo_files(path)[0] if path.is_dir() else (path,))]
    files = [file for file in files if not is_map(file)]
    if not files:
        raise ArgumentError("no photograph was given, expected files or folders of them, or a video")
    for number, file in enumerate(files):
        picture = read_photograph(file)
        record = {"id": number, "file_name": file, "width": picture.shape[1], "height": picture.shape[0]}
        yield _Searched(record, detector.detect(picture), functools.partial(read_photograph, file))
        progress(number + 1, len(files))


def _search_video(path: Path, detector: _Detector, progress: Progress) -> Iterator[_Searched]:
    """Search some frames of a video each second."""
    film = Film(path)
    for number, frame in enumerate(find_hands(film, detector, progress)):
        if frame.hands is not None:
            record = {"id": number, "file_name": path, "time": frame.time}
            record |= dict(zip(("width", "height"), film.size, strict=True))
            yield _Searched(record, frame.hands, functools.partial(film.picture, number))


def _annotation(image: dict[str, Any], hand: FoundHand) -> dict[str, Any]:
    """Convert a found hand to a COCO annotation, to which the caller adds an id."""
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
