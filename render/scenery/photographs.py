"""A user's own photographs as backgrounds."""

from __future__ import annotations

import functools
import itertools
import warnings
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from handsim.errors import HandSimError
from handsim.files.inputs import check_regular
from handsim.files.outputs import plain_path

PHOTO_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff")
_TRIES: Final = 50  # after so many unreadable files in turn, the folder counts as one without photographs
_MOST_PIXELS: Final = 100_000_000  # of a photograph
_GAMMA: Final = 2.2


@functools.lru_cache(maxsize=2)
def photo_files(folder: Path) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Photographs in a folder and its subfolders: those with the first bytes of a picture, and the others."""
    if not folder.is_dir():
        raise HandSimError(f"{folder}: no such folder of photographs")
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in PHOTO_SUFFIXES)
    good = tuple(filter(_begins_as_picture, files))
    if not good:
        raise _no_photo(folder)
    return good, tuple(file for file in files if file not in set(good))


def _begins_as_picture(file: Path) -> bool:
    with plain_path(file) as plain:
        return bool(cv2.haveImageReader(str(plain)))


def pick_photo(folder: Path, rng: np.random.Generator) -> Path:
    """A random photograph that can be read whole."""
    files, _ = photo_files(folder)
    for index in rng.permutation(len(files))[:_TRIES]:
        if _read(files[index]) is not None:
            readable: Path = files[index]
            return readable
    raise _no_photo(folder)


def photos_beside(file: Path, count: int) -> list[Path]:
    """A photograph and others of its folder, so many together; they come again where there are fewer."""
    files, _ = photo_files(file.parent)
    start = files.index(file) + 1 if file in files else 0
    others = (one for one in (*files[start:], *files[:start]) if one != file and _read(one) is not None)
    chosen = [file, *itertools.islice(others, count - 1)]
    return list(itertools.islice(itertools.cycle(chosen), count))


def _no_photo(folder: Path) -> HandSimError:
    endings = ", ".join(PHOTO_SUFFIXES)
    return HandSimError(f"{folder}: no photograph that can be read; expected files that end in {endings}")


def _read(file: Path) -> NDArray[np.uint8] | None:
    try:
        check_regular(file, error=HandSimError)
        if _num_pixels(file) > _MOST_PIXELS:
            return None
        data = np.fromfile(file, dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    except (OSError, cv2.error, HandSimError):
        return None
    return None if picture is None else np.asarray(picture)


def _num_pixels(file: Path) -> int:
    """Pixels that a file states; OpenCV would allocate them all before it finds that they are not there.

    The same holds for the parts of a PNG, which are checked.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of decompression bombs
            with Image.open(file) as picture:
                pixels = int(picture.width * picture.height)
                picture.verify()
                return pixels
    except Exception as error:  # headers are damaged in many ways
        raise HandSimError(f"{file}: not a readable photograph") from error


def draw_photo(file: Path, size: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """A random part of a photograph in the picture's proportions, which fills it: half of it or more."""
    photo = _read(file)
    if photo is None:
        raise HandSimError(f"{file}: not a readable photograph")
    height, width = photo.shape[:2]
    scale = min(width / size[0], height / size[1]) * rng.uniform(0.5, 1.0)
    part = np.maximum(np.array(size) * scale, 1.0).astype(int)
    left, top = (int(rng.integers(0, room + 1)) for room in np.array([width, height]) - part)
    cut = photo[top : top + part[1], left : left + part[0], ::-1]
    shrinks = part[0] > size[0]
    scaled = cv2.resize(
        np.ascontiguousarray(cut), size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    )
    light: NDArray[np.float32] = (scaled.astype(np.float32) / 255.0) ** _GAMMA
    return light
