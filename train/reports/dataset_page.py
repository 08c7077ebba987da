"""The page of plots that `handsim generate` writes beside a training set."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import NDArray

from gloves.captures.capture import run_lengths
from handsim.app.page import Section, write_page
from handsim.errors import DatasetError
from handsim.hand.shape import JOINTS, SIDES
from handsim.space.rig import as_rig
from train.data.shards import Dataset, hands_name
from train.reports import dataset_plots as _plots
from train.reports.plot_style import picture

REPORT: Final = "report.html"
MOST_ROWS: Final = 50_000
"""Rows read for the plots; larger sets are sampled evenly."""
ANGLE_BINS: Final = 40
_CHUNK: Final = 1024  # rows whose marker pairs are held in memory at one time
_LOW: Final = np.array([joint.low for joint in JOINTS])
_HIGH: Final = np.array([joint.high for joint in JOINTS])


def write_dataset_page(
    path: Path, dataset: Dataset, *, present: Bool[np.ndarray, "T M"] | None = None, rate: float = 120.0
) -> Path:
    """Write the page on a training set: one HTML file with its pictures inside, complete or not at all.

    Args:
        path: The page; an older one is replaced.
        dataset: The set.
        present: Which markers a continuous take of this glove and rig holds, for the lengths of gaps; a
            training set's frames are independent and have none.
        rate: Frames per second of that take [Hz].

    Returns:
        The page's path.

    Raises:
        DatasetError: `present` is not a table of frames and markers, or the rate is not positive.
    """
    rows, manifest = sample_rows(dataset), dataset.manifest
    sections = [
        _figures_section(dataset, rows),
        _angles_section(rows),
        _sight_section(rows, dataset),
        _ghosts_section(rows),
        _neighbors_section(rows, 2.0 * float(manifest.config["layout"]["radius"])),
    ]
    if present is not None:
        sections.append(gap_section(present, rate))
    write_page(
        path,
        sections,
        title=f"Training set {dataset.path.resolve().name}",
        lead=f"{manifest.num_frames:,} frames of glove {manifest.config['layout']['name']} before rig "
        f"{manifest.config['rig']}, seed {manifest.config['seed']}.",
    )
    return path


def gap_section(present: Bool[np.ndarray, "T M"], rate: float) -> Section:
    """Lengths of the gaps in a continuous take, beside published figures of real finger markers."""
    if present.ndim != 2 or not present.size or present.dtype != np.bool_:
        raise DatasetError(
            f"present is {present.dtype} of shape {present.shape}, expected bool (frames, markers)"
        )
    if not 0.0 < rate < np.inf:
        raise DatasetError(f"rate is {rate:g} Hz, expected a positive number")
    lengths = run_lengths(~present, inside=True)
    frames, markers = present.shape
    text = (
        f"A continuous take of {frames:,} frames at {rate:g} Hz. Of its {markers} markers "
        f"{100 * (~present).mean():.2f} % are missing, in {len(lengths):,} gaps; gaps that the take's ends "
        "cut off are not counted."
    )
    if not len(lengths):
        return Section("Gaps", text)
    drawn = picture((9.0, 4.2), partial(_plots.draw_gaps, lengths=lengths, rate=rate))
    caption = (
        "Share of gaps by length. Orange: median and 90th percentile of the gap lists of real finger markers "
        "that were published with LocalMoCap (SIGGRAPH 2023)."
    )
    return Section("Gaps", text, pictures=[(drawn, caption)])


def sample_rows(dataset: Dataset, most: int = MOST_ROWS) -> Shaped[np.ndarray, "T"]:
    """At most this many rows, evenly spaced over all shards, in order."""
    total = sum(len(shard) for shard in dataset.shards)
    chosen = np.arange(min(most, total)) * total // min(most, total)
    first, parts = 0, []
    for shard in dataset.shards:
        here = chosen[(chosen >= first) & (chosen < first + len(shard))] - first
        parts.append(shard[here])
        first += len(shard)
    return np.concatenate(parts)


def angle_shares(rows: Shaped[np.ndarray, "T"], bins: int = ANGLE_BINS) -> Float[np.ndarray, "20 N"]:
    """Share of frames in each of equally wide bins over the range of each joint angle."""
    angles = np.rad2deg(rows["qpos"][:, 7:].astype(np.float64))
    index = np.floor((angles - _LOW) / (_HIGH - _LOW) * bins).astype(np.int64).clip(0, bins - 1)
    counts = np.stack([np.bincount(index[:, joint], minlength=bins) for joint in range(len(JOINTS))])
    return counts / len(rows)


def camera_shares(rows: Shaped[np.ndarray, "T"], num_cameras: int) -> Float[np.ndarray, "M C+1"]:
    """Share of frames in which exactly 0, 1, ... cameras see each marker."""
    counts = np.bitwise_count(rows["cameras"])
    return np.stack([(counts == n).mean(axis=0) for n in range(num_cameras + 1)], axis=1)


def ghost_counts(rows: Shaped[np.ndarray, "T"]) -> Int[np.ndarray, "G+1"]:
    """Frames with 0, 1, ... ghosts."""
    here = np.isfinite(rows["ghosts"][..., 0])
    return np.bincount(here.sum(axis=1), minlength=here.shape[1] + 1)


def ghost_distances(rows: Shaped[np.ndarray, "T"]) -> Float[np.ndarray, "N"]:
    """From every ghost to the nearest marker of its frame, seen or not [m]."""
    frame, ghost = np.nonzero(np.isfinite(rows["ghosts"][..., 0]))
    away = rows["markers"][frame].astype(np.float64) - rows["ghosts"][frame, ghost][:, None]
    distances: NDArray[np.float64] = np.linalg.norm(away, axis=-1).min(axis=1)
    return distances


def neighbor_distances(rows: Shaped[np.ndarray, "T"]) -> Float[np.ndarray, "T M"]:
    """From every marker to the nearest other one, seen or not, center to center [m]."""
    parts = []
    for first in range(0, len(rows), _CHUNK):
        markers = rows["markers"][first : first + _CHUNK]
        apart = np.linalg.norm(markers[:, :, None] - markers[:, None], axis=-1)
        apart[:, range(markers.shape[1]), range(markers.shape[1])] = np.inf
        parts.append(apart.min(axis=-1))
    return np.concatenate(parts).astype(np.float64)


def _figures_section(dataset: Dataset, rows: Shaped[np.ndarray, "T"]) -> Section:
    manifest = dataset.manifest
    files = [dataset.path / hands_name(shard) for shard in range(len(dataset.shards))]
    hands = np.concatenate([np.load(file, allow_pickle=False)["length"] for file in files])
    length = 1e3 * np.percentile(hands, [0, 50, 100])
    found = np.isfinite(rows["observed"][..., 0]).sum(axis=1).mean()
    counts = ghost_counts(rows)
    size = sum((dataset.path / name).stat().st_size for name in manifest.files)
    table = [
        ["figure", "value"],
        ["frames", f"{manifest.num_frames:,}"],
        ["people", f"{len(hands) // len(SIDES):,}"],
        ["left hands", f"{100 * (rows['hand'] % len(SIDES) == SIDES.index('left')).mean():.1f} %"],
        ["hand length, shortest, median, longest", " / ".join(f"{value:.0f}" for value in length) + " mm"],
        ["markers found per frame", f"{found:.2f} of {len(manifest.marker_names)}"],
        ["ghosts per frame", f"{(counts * np.arange(len(counts))).sum() / len(rows):.2f}"],
        ["bytes", f"{size:,}"],
    ]
    text = (
        f"The plots and means are made from {len(rows):,} of {manifest.num_frames:,} frames, evenly chosen."
    )
    return Section("In figures", text, table=table)


def _angles_section(rows: Shaped[np.ndarray, "T"]) -> Section:
    edges = np.linspace(_LOW, _HIGH, ANGLE_BINS + 1, axis=1)
    middle = np.rad2deg(np.percentile(rows["qpos"][:, 7:], [1.0, 99.0], axis=0)).T
    draw = partial(_plots.draw_angles, shares=angle_shares(rows), edges=edges, middle=middle)
    text = (
        "Share of frames by angle, for each of the twenty joints. Zero is the flat hand; flexion counts "
        "towards the palm, abduction towards the thumb (the thumb's: away from the palm)."
    )
    caption = (
        "Gray: the joint's range. Orange: between these angles lie 98 % of the frames. The four fingers of a "
        "row share their axes."
    )
    return Section("Joint angles", text, pictures=[(picture((10.8, 7.0), draw), caption)])


def _sight_section(rows: Shaped[np.ndarray, "T"], dataset: Dataset) -> Section:
    manifest = dataset.manifest
    lost = 1.0 - np.isfinite(rows["observed"][..., 0]).mean(axis=0)
    shares = camera_shares(rows, len(as_rig(manifest.config["rig"]).positions))
    draw = partial(
        _plots.draw_visibility,
        names=manifest.marker_names,
        lost=lost,
        seen_by=shares,
        min_cameras=manifest.min_cameras,
    )
    text = (
        f"A marker has a point when the rays of at least {manifest.min_cameras} cameras meet; other hands, "
        "held objects, merged blobs and lost pictures are included."
    )
    caption = f"Left: how often each marker is lost. Right: how many of {shares.shape[1] - 1} cameras see it."
    size = (10.8, 1.6 + 0.21 * len(lost))
    return Section("Occlusion", text, pictures=[(picture(size, draw), caption)])


def _ghosts_section(rows: Shaped[np.ndarray, "T"]) -> Section:
    counts = ghost_counts(rows)
    draw = partial(_plots.draw_ghosts, counts=counts, distances=ghost_distances(rows))
    caption = f"Left: ghosts per frame, of which {len(counts) - 1} at most are kept. Right: their distances."
    text = "Points of no marker: mirror images in shiny surfaces near the hand, and stray reflections."
    return Section("Ghosts", text, pictures=[(picture((10.8, 3.4), draw), caption)])


def _neighbors_section(rows: Shaped[np.ndarray, "T"], diameter: float) -> Section:
    distances = neighbor_distances(rows)
    closer = 100.0 * (distances.min(axis=1) < diameter).mean()
    draw = partial(_plots.draw_neighbors, distances=distances, diameter=diameter)
    caption = (
        f"Markers seen or not. In {closer:.2f} % of the frames two of them are nearer to each other than "
        "a marker is wide."
    )
    text = "The nearer markers are to each other, the easier they are confused."
    return Section("Nearest markers", text, pictures=[(picture((9.0, 3.6), draw), caption)])
