"""Short captures with truth, on which `ablation` tries the numbers of the tracker."""

from __future__ import annotations

import dataclasses
import hashlib
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.real_scenes import make_scene, sample_gaps, sample_ghosts
from gloves import Capture, MarkerLayout, MarkerPlace, load_layout
from gloves.layout import layout_lines
from gloves.optics.reconstruction import pack_columns
from gloves.takes.take import Take
from track import label_capture, track_capture
from train import load_labeler, simulate_take

VERBS: dict[str, Callable[..., Take]] = {"label": label_capture, "track": track_capture}

SIDES = ("right", "left")
_TIPS = ("index_distal", "middle_distal", "ring_distal", "little_distal")
_BACK = ((0.3, 0.2), (0.3, -0.2), (0.7, 0.2), (0.7, -0.2))  # along and across the palm


class Truth(NamedTuple):
    """Points of a capture whose markers are known: T frames, H hands, S sources (markers, then ghosts)."""

    layout: MarkerLayout
    sides: tuple[Any, ...]
    points: np.ndarray
    """(T, S, 3) [m], NaN where a source has no point."""
    rate: float
    verbs: tuple[str, ...]
    """What is done with the capture."""
    keypoints: np.ndarray | None = None
    """(T, H, 21, 3) [m]; None where nobody knows them."""
    is_fresh: bool = False
    """Whether no column goes on from one frame to the next."""

    def keep(self, path: Path, seed: int) -> None:
        """Write the capture without labels, its truth and its glove, and learn the glove."""
        rng, seen = np.random.default_rng(seed), np.isfinite(self.points[..., 0])
        columns, width = pack_columns(seen, rng=rng)
        if self.is_fresh:
            for frame, row in enumerate(columns):
                row[seen[frame]] = rng.permutation(width)[: seen[frame].sum()] + width * (frame % 2)
            width *= 2
        cloud = np.full((len(seen), width, 3), np.nan)
        t, s = np.nonzero(seen)
        cloud[t, columns[t, s]] = self.points[t, s]
        shape = len(seen), len(self.sides), self.layout.num_markers, 3
        markers = self.points[:, : shape[1] * shape[2]].reshape(shape)
        keypoints = np.full((*shape[:2], 21, 3), np.nan) if self.keypoints is None else self.keypoints
        load_labeler(self.layout)
        path.with_suffix(".toml").write_text("\n".join(layout_lines(self.layout)) + "\n", "utf-8")
        rest = {"sides": np.array(self.sides), "verbs": np.array(self.verbs), "rate": self.rate}
        np.savez_compressed(f"{path}.npz", cloud=cloud, markers=markers, keypoints=keypoints, **rest)


def make_ground(folder: Path, data: Path | None, level: int) -> None:
    """Write the captures of a ground; those that are there already stay."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in _makers(data, level):
        if not (folder / f"{name}.npz").exists():
            make().keep(folder / name, seed=level)


def _makers(data: Path | None, level: int) -> Iterator[tuple[str, Callable[[], Truth]]]:
    """The name of each capture of a ground, and a function that makes it."""
    dense, frames = load_layout("dense19"), (0, 120, 240)[level]
    chosen = np.sort(np.random.default_rng(11).permutation(dense.num_markers)[:12])
    own = dataclasses.replace(dense, name="own12", markers=tuple(dense.markers[k] for k in chosen))
    if level == 1:
        yield "own12", lambda: _simulated(own, "free", frames, ("label", "track"), seed=10, hands=("right",))
        yield "dense19", lambda: _simulated(dense, "real-like", frames, ("track",), seed=10 * level)
        mirror = _mirror_like()
        yield "mirror", lambda: _simulated(mirror, "hand-hand", frames, ("label", "track"), seed=51)
    else:
        yield "own12", lambda: _simulated(own, "real-like", frames, ("label",), seed=10 * level)
        yield "touching", lambda: _simulated(dense, "hand-hand", frames, ("track",), seed=10 * level)
    if data is None:
        return
    people = data / "sig18"
    if level == 1:
        yield "sig18", lambda: _sig18(people / "User1/capture2", "gaps", frames, "label", level)
    else:
        yield "close", lambda: _sig18(people / "User2/capture4", "close", frames, "label", level)
        yield "fresh", lambda: _sig18(people / "User1/capture2", "new-ids", frames, "track", level)
        yield "c009", lambda: _grasp(data / "real", "c009", slice(100, 100 + frames), level)


def _mirror_like() -> MarkerLayout:
    """A glove like its mirror image: markers on the finger tips, and four that are symmetric on the back."""
    places = [MarkerPlace(bone, bone, along=0.7, around=0.0) for bone in _TIPS]
    for number, (along, across) in enumerate(_BACK):
        places.append(MarkerPlace(f"Back{number}", "palm", along=along, around=0.0, across=across))
    return MarkerLayout("mirror0", tuple(places), load_layout("dense19").radius)


def _corrupted(markers: np.ndarray, seed: int) -> np.ndarray:
    """Markers (T, H, M, 3) [m] with gaps, and ghosts, as sources (T, S, 3)."""
    rng = np.random.default_rng(seed)
    sources = markers.reshape(len(markers), -1, 3).copy()
    for source in sources.swapaxes(0, 1):
        source[sample_gaps(len(source), rng)] = np.nan
    middle = np.nanmedian(markers, axis=2, keepdims=True)
    filled = np.where(np.isfinite(markers), markers, middle)
    found = [ghost[:, None] for hand in filled.swapaxes(0, 1) for ghost in sample_ghosts(hand, rng)]
    return np.concatenate([sources, *found], axis=1)


def _simulated(
    layout: MarkerLayout, kind: Any, frames: int, verbs: tuple[str, ...], seed: int, **options: Any
) -> Truth:
    take = simulate_take(kind, glove=layout, num_frames=frames, seed=seed, **options)
    markers = np.stack([take.observed(side) for side in take.sides], axis=1)
    return Truth(layout, take.sides, _corrupted(markers, seed), take.rate, verbs, take.keypoints())


def _sig18(folder: Path, condition: str, frames: int, verb: str, seed: int) -> Truth:
    scene = make_scene(folder, condition, seed=seed, frames=frames)
    fresh = condition == "new-ids"
    return Truth(load_layout("dense19"), SIDES, scene.points, scene.rate, (verb,), is_fresh=fresh)


def _grasp(folder: Path, name: str, part: slice, seed: int) -> Truth:
    file, layout = np.load(folder / f"grasp-{name}.npz"), load_layout(folder / "grasp21.toml")
    order = [file["names"].tolist().index(marker) for marker in layout.names]
    markers = file["places"][part][:, None, order].astype(float)
    return Truth(layout, SIDES[:1], _corrupted(markers, seed), float(file["rate"]), ("label",))


def measure(folder: Path) -> dict[str, dict[str, Any]]:
    """Label and track every capture of a ground: figures and digests, by capture and verb."""
    torch.set_num_threads(1)
    return {
        f"{path.stem} {verb}": _row(path, VERBS[verb])
        for path in sorted(folder.glob("*.npz"))
        for verb in np.load(path)["verbs"].tolist()
    }


def _row(path: Path, function: Callable[..., Take]) -> dict[str, Any]:
    """Frames right [%], error of keypoints [mm], time [s], and digests of labels with poses and of doubt."""
    file, began = np.load(path), time.process_time()
    cloud, markers, sides = file["cloud"], file["markers"], file["sides"].tolist()
    capture = Capture(tuple(f"*{k}" for k in range(cloud.shape[1])), cloud, float(file["rate"]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        take = function(capture, glove=load_layout(path.with_suffix(".toml")), hands=sides)
    hands = [take.hand_index(side) for side in sides]
    found, keypoints = np.stack([take.observed(side) for side in sides], axis=1), take.keypoints()[:, hands]
    right = (found == markers).all(axis=-1) | np.isnan(found[..., 0]) & np.isnan(markers[..., 0])
    counted = np.isfinite(markers[..., 0]).any(axis=(1, 2))
    known = np.isfinite(file["keypoints"]).any() and np.isfinite(keypoints).any()
    distances = np.linalg.norm(keypoints - file["keypoints"], axis=-1) if known else np.empty(0)
    doubt = (take.confidence, take.status, take.rms, take.angle_spread, take.keypoint_spread)
    return {
        "frames": 100.0 * float(right[counted].all(axis=(1, 2)).mean()),
        "error": 1e3 * float(np.nanmean(distances)) if known else None,
        "seconds": time.process_time() - began,
        "digest": _digest(found, keypoints),
        "doubt": _digest(*doubt, sorted(str(one.message) for one in said)),
    }


def _digest(*values: Any) -> str:
    sha = hashlib.sha256()
    for value in values:
        sha.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return sha.hexdigest()[:16]
