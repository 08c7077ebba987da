"""The page of plots that `handsim generate` writes beside a training set."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from gloves.captures.capture import run_lengths
from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS, JOINTS, SIDES
from handsim.pages import Paint, Section, annotate, color_bar, joint_words, picture, write_sections
from handsim.space.rig import load_rig
from train.data.shards import Dataset, hands_name
from train.reports.hand_plot import slips_picture
from train.simulation.training_frames import GenerateSettings, slipped_gloves

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REPORT: Final = "report.html"
MAX_ROWS: Final = 50_000
"""Number of rows read for the plots; larger sets are sampled evenly."""
_ANGLE_BINS: Final = 40
_CHUNK: Final = 1024  # number of rows whose marker pairs are in memory together
_LOW: Final = np.array([joint.low_deg for joint in JOINTS])
_HIGH: Final = np.array([joint.high_deg for joint in JOINTS])
_PUBLISHED_MEDIAN: Final = (3, 4)  # [frames] median gap of real finger markers: lowest and highest take
_PUBLISHED_P90: Final = (24, 43)  # [frames] the same for the 90th percentile


def write_dataset_page(
    path: Path, dataset: Dataset, *, present: Bool[np.ndarray, "T M"] | None = None, rate: float = 120.0
) -> Path:
    """Write the page on a training set, with gaps of `present` markers in a take of some rate [Hz]."""
    rows, manifest = sample_rows(dataset), dataset.manifest
    rig = load_rig(manifest.config["rig"])
    sections = [
        _figures_section(dataset, rows),
        _angles_section(rows),
        _sight_section(rows, dataset, len(rig.positions)),
        _ghosts_section(rows),
        _slips_section(dataset),
        _neighbors_section(rows, 2.0 * float(manifest.config["layout"]["radius"])),
    ]
    if present is not None:
        sections.append(gap_section(present, rate))
    write_sections(
        path,
        sections,
        title=f"Training set {dataset.path.resolve().name}",
        lead=f"{manifest.num_frames:,} frames of glove {manifest.config['layout']['name']} before the "
        f"{len(rig.positions)} cameras of rig {rig.name}, seed {manifest.config['seed']}.",
    )
    return path


def sample_rows(dataset: Dataset, most: int = MAX_ROWS) -> Shaped[np.ndarray, "T"]:
    """At most `most` rows in order, evenly spaced over all shards."""
    rows = dataset.mapped_rows()
    count = min(most, len(rows))
    return rows[np.arange(count) * len(rows) // count]


def _figures_section(dataset: Dataset, rows: Shaped[np.ndarray, "T"]) -> Section:
    """Table of figures on the whole set."""
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
    """Histograms of joint angles."""
    text = (
        "Share of frames by angle, for each of the twenty joints. Zero is the flat hand; flexion counts "
        "towards the palm, abduction towards the thumb (the thumb's: away from the palm)."
    )
    caption = (
        "Gray: the joint's range. Orange: between these angles lie 98 % of the frames. The four fingers of a "
        "row share their axes."
    )
    middle = np.rad2deg(np.percentile(rows["qpos"][:, 7:], [1.0, 99.0], axis=0)).T
    drawn = picture((10.8, 7.0), _draw_angles, angle_shares(rows), middle)
    return Section("Joint angles", text, pictures=[(drawn, caption)])


def angle_shares(rows: Shaped[np.ndarray, "T"], bins: int = _ANGLE_BINS) -> Float[np.ndarray, "20 N"]:
    """Share of frames in each of equally wide bins over the range of each joint angle."""
    angles = np.rad2deg(rows["qpos"][:, 7:].astype(np.float64))
    index = np.floor((angles - _LOW) / (_HIGH - _LOW) * bins).astype(np.int64).clip(0, bins - 1)
    counts = np.stack([np.bincount(index[:, joint], minlength=bins) for joint in range(len(JOINTS))])
    return counts / len(rows)


def _draw_angles(
    figure: Figure, shares: Float[np.ndarray, "20 N"], middle: Float[np.ndarray, "20 2"]
) -> None:
    """Draw a column per digit and a row per joint angle; 98 % of the frames lie between `middle` [deg]."""
    panels = figure.subplots(4, 5)
    edges = np.linspace(_LOW, _HIGH, _ANGLE_BINS + 1, axis=1)
    for number, joint in enumerate(JOINTS):
        digit, row = divmod(number, 4)
        panel: Axes = panels[row, digit]
        if digit > 1:  # The thumb has its own axes; axes must be linked before drawing.
            panel.sharex(panels[row, 1])
            panel.sharey(panels[row, 1])
        density = 100.0 * shares[number] / np.diff(edges[number])
        panel.axvspan(joint.low_deg, joint.high_deg, color=Paint.BAND, linewidth=0)
        panel.stairs(density, edges[number], fill=True, color=Paint.BLUE)
        panel.set_title(joint_words(joint.name), loc="left", color=Paint.SOFT, fontsize=8.5)
        panel.margins(x=0.03, y=0.08)
        panel.axhline(0.0, color=Paint.LINE, linewidth=0.8)
        panel.plot(
            middle[number], [0.0, 0.0], color=Paint.WARM, linewidth=2.6, solid_capstyle="butt", clip_on=False
        )
        panel.xaxis.set_major_formatter("{x:.0f}°")
        panel.locator_params(axis="x", nbins=5)
        panel.locator_params(axis="y", nbins=3)
        panel.tick_params(labelsize=8.0, length=2.5)
        panel.spines["left"].set_visible(digit < 2)
        panel.tick_params(axis="y", left=digit < 2, labelleft=digit < 2)
    for digit, name in enumerate(DIGITS):
        place = (0.0, 1.0), (0.0, 20.0)
        annotate(panels[0, digit], name, *place, xycoords="axes fraction", weight="bold", fontsize=10.5)
    figure.supylabel("share of frames [% per degree]", fontsize=9.0, color=Paint.SOFT)


def _sight_section(rows: Shaped[np.ndarray, "T"], dataset: Dataset, num_cameras: int) -> Section:
    """How often each marker is lost, and how many cameras have a free view of it."""
    manifest = dataset.manifest
    least = manifest.min_cameras
    lost = 1.0 - np.isfinite(rows["observed"][..., 0]).mean(axis=0)
    shares = camera_shares(rows, num_cameras)
    text = (
        f"A marker has a point when the rays of at least {least} cameras meet; otherwise it is lost. Cameras "
        "without a free view, merged blobs, missed blobs and lost pictures are all included."
    )
    caption = (
        "Left: how often each marker is lost, for whatever reason. Right: how many of "
        f"{num_cameras} cameras have a free view of it, past hands and held objects alone."
    )
    size = (10.8, 1.6 + 0.21 * len(lost))
    drawn = picture(size, _draw_visibility, manifest.marker_names, lost, shares, least)
    return Section("Occlusion", text, pictures=[(drawn, caption)])


def camera_shares(rows: Shaped[np.ndarray, "T"], num_cameras: int) -> Float[np.ndarray, "M C+1"]:
    """Share of frames in which exactly 0, 1, ... cameras see each marker."""
    counts = np.bitwise_count(rows["cameras"])
    return np.stack([(counts == n).mean(axis=0) for n in range(num_cameras + 1)], axis=1)


def _draw_visibility(
    figure: Figure,
    names: tuple[str, ...],
    lost: Float[np.ndarray, "M"],
    seen_by: Float[np.ndarray, "M C+1"],
    min_cameras: int,
) -> None:
    """Draw the share of frames that lose each marker, and its number of cameras with a free view."""
    rows = np.arange(len(names))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 1.5))
    left.barh(rows, 100.0 * lost, color=Paint.BLUE, height=0.62)
    for row, share in enumerate(lost):
        annotate(
            left, f"{100 * share:.1f}", (100 * share, row), (4, 0), va="center", color=Paint.SOFT, fontsize=8
        )
    left.set_yticks(rows, names, color=Paint.INK, parse_math=False)
    left.set(ylim=(len(names) - 0.4, -0.6), xlim=(0.0, max(0.1, 115.0 * float(lost.max(initial=0.0)))))
    left.set_xlabel("frames in which it is lost [%]")
    left.tick_params(axis="y", length=0)
    most = int(np.flatnonzero(seen_by.sum(axis=0))[-1]) if seen_by.any() else 0
    shades = right.pcolormesh(
        np.arange(most + 2) - 0.5, np.arange(len(names) + 1) - 0.5, 100.0 * seen_by[:, : most + 1],
        cmap="Blues", vmin=0.0, edgecolors=Paint.CARD, linewidth=1.2,
    )  # fmt: skip
    means = seen_by @ np.arange(seen_by.shape[1])
    right.plot(
        means, rows, "o", color=Paint.CARD, markeredgecolor=Paint.INK, markersize=4.5, markeredgewidth=0.9
    )
    annotate(right, "mean", (means[0], 0.0), (0, 13), ha="center", fontsize=8.0)
    least = min_cameras - 0.5
    right.axvline(least, color=Paint.WARM, linewidth=1.4)
    annotate(right, f"at least {min_cameras}", (least, -0.5), (3, 3), color=Paint.WARM, fontsize=8.0)
    right.set_xlabel("cameras with a free view of it")
    right.locator_params(axis="x", integer=True)
    right.tick_params(axis="y", length=0)
    right.spines["left"].set_visible(False)
    color_bar(figure, shades, "share of frames [%]", ax=right, pad=0.02, aspect=35)


def _ghosts_section(rows: Shaped[np.ndarray, "T"]) -> Section:
    """Number of ghosts, and their distances from markers."""
    counts = ghost_counts(rows)
    caption = f"Left: ghosts per frame, of which {len(counts) - 1} at most are kept. Right: their distances."
    text = "Points of no marker: mirror images in shiny surfaces near the hand, and stray reflections."
    drawn = picture((10.8, 3.4), _draw_ghosts, counts, ghost_distances(rows))
    return Section("Ghosts", text, pictures=[(drawn, caption)])


def ghost_counts(rows: Shaped[np.ndarray, "T"]) -> Int[np.ndarray, "G+1"]:
    """Number of frames with 0, 1, ... ghosts."""
    here = np.isfinite(rows["ghosts"][..., 0])
    return np.bincount(here.sum(axis=1), minlength=here.shape[1] + 1)


def ghost_distances(rows: Shaped[np.ndarray, "T"]) -> Float[np.ndarray, "N"]:
    """Distance from every ghost to the nearest marker of its frame, seen or not [m]."""
    frame, ghost = np.nonzero(np.isfinite(rows["ghosts"][..., 0]))
    away = rows["markers"][frame].astype(np.float64) - rows["ghosts"][frame, ghost][:, None]
    return np.asarray(np.linalg.norm(away, axis=-1).min(axis=1))


def _draw_ghosts(figure: Figure, counts: Int[np.ndarray, "G+1"], distances: Float[np.ndarray, "N"]) -> None:
    """Draw the number of ghosts per frame, and their distances from the nearest marker [m]."""
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
    shares = 100.0 * counts / max(1, counts.sum())
    left.bar(np.arange(len(counts)), shares, color=Paint.BLUE, width=0.62)
    for count, share in enumerate(shares):
        annotate(left, f"{share:.1f}", (count, share), (0, 3), ha="center", color=Paint.SOFT, fontsize=8.0)
    left.set(xlabel="ghosts in a frame", ylabel="share of frames [%]")
    left.locator_params(axis="x", integer=True)
    right.stairs(*_histogram(distances, _bin_edges(distances)), fill=True, color=Paint.BLUE)
    right.set(xlabel="from a ghost to the nearest marker [mm]", ylabel="share of ghosts [% per mm]")
    right.set_xlim(left=0.0)
    right.margins(y=0.12)
    if len(distances):
        _mark_value(right, 1e3 * float(np.median(distances)), "median {:.0f} mm", Paint.INK)
    else:
        right.set_ylim(0.0, 1.0)
        right.annotate("no ghosts", (0.5, 0.5), xycoords="axes fraction", ha="center", color=Paint.SOFT)


def _slips_section(dataset: Dataset) -> Section:
    """Positions of each marker with slips of the glove."""
    config = dataset.manifest.config
    names = ("population", "slip_along", "slip_around")
    given = {name: value for name, value in config.items() if name in names}
    settings, model = GenerateSettings.from_json(given), HandModel.named("M")
    slips = slipped_gloves(dataset.layout, model, settings, rng=np.random.default_rng(0))
    text = (
        f"Nobody wears a glove as designed: markers slip by {settings.slip_along:g} bone lengths along the "
        f"bones and {settings.slip_around:g} degrees around them, as standard deviations."
    )
    caption = (
        f"The markers of {len(slips)} people of this population, each at its place on a right hand of size "
        "M, one color a marker. Left: from the back. Right: from the palm's side."
    )
    return Section("Slips", text, pictures=[(slips_picture(dataset.layout, slips), caption)])


def _neighbors_section(rows: Shaped[np.ndarray, "T"], diameter: float) -> Section:
    """Distances between neighboring markers of some diameter [m]."""
    distances = neighbor_distances(rows)
    closer = 100.0 * (distances.min(axis=1) < diameter).mean()
    caption = (
        f"Markers seen or not. In {closer:.2f} % of the frames two of them are nearer to each other than "
        "a marker is wide."
    )
    text = "The nearer markers are to each other, the easier they are confused."
    drawn = picture((9.0, 3.6), _draw_neighbors, distances, diameter)
    return Section("Nearest markers", text, pictures=[(drawn, caption)])


def neighbor_distances(rows: Shaped[np.ndarray, "T"]) -> Float[np.ndarray, "T M"]:
    """Distance from every marker to the nearest other one, between centers [m]."""
    parts = []
    for first in range(0, len(rows), _CHUNK):
        markers = rows["markers"][first : first + _CHUNK]
        apart = np.linalg.norm(markers[:, :, None] - markers[:, None], axis=-1)
        apart[:, range(markers.shape[1]), range(markers.shape[1])] = np.inf
        parts.append(apart.min(axis=-1))
    return np.concatenate(parts).astype(np.float64)


def _draw_neighbors(figure: Figure, distances: Float[np.ndarray, "T M"], diameter: float) -> None:
    """Draw the distances of each marker's nearest neighbor, and of each frame's closest pair [m]."""
    panel = figure.subplots()
    nearest, bins = distances.min(axis=1), _bin_edges(distances)
    panel.stairs(*_histogram(distances.ravel(), bins), fill=True, color=Paint.PALE)
    panel.stairs(*_histogram(nearest, bins), color=Paint.BLUE, linewidth=1.6)
    panel.margins(y=0.12)
    panel.set(xlabel="distance to the nearest other marker, center to center [mm]", ylabel="share [% per mm]")
    for values, name, color in (
        (nearest, "nearest pair\nof each frame", Paint.BLUE),
        (distances, "every marker", Paint.SOFT),
    ):
        shares, _ = _histogram(values.ravel(), bins)
        peak = int(shares.argmax())
        annotate(panel, name, (bins[peak], shares[peak]), (10, 4), color=color, annotation_clip=False)
    panel.set_xlim(left=0.0)
    _mark_value(panel, 1e3 * diameter, "marker diameter\n{:.1f} mm", Paint.WARM)


def _bin_edges(distances: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "B"]:
    """Edges [mm] of at most 80 bins, of whole millimeters, from 0 to the 99.9th percentile."""
    longest = 1e3 * float(np.percentile(distances, 99.9)) if distances.size else 1.0
    width = max(1.0, np.ceil(longest / 80.0))
    return np.arange(0.0, longest + width, width)


def _histogram(
    distances: Float[np.ndarray, "N"], bins: Float[np.ndarray, "B"]
) -> tuple[Float[np.ndarray, "B-1"], Float[np.ndarray, "B"]]:
    """Percentage of the distances [m] per millimeter in each bin, and the bins [mm]."""
    counts, _ = np.histogram(1e3 * distances, bins)
    return 100.0 * counts / (max(1, len(distances)) * np.diff(bins)), bins


def _mark_value(panel: Axes, value: float, text: str, color: str) -> None:
    """Draw a vertical line with a text beside its top."""
    panel.axvline(value, color=color, linewidth=1.4)
    panel.annotate(
        text.format(value), (value, 1.0), (5, -2), ("data", "axes fraction"), "offset points", va="top",
        color=color,
    )  # fmt: skip


def gap_section(present: Bool[np.ndarray, "T M"], rate: float) -> Section:
    """Lengths of gaps in a continuous take, and published ones of real finger markers."""
    lengths = run_lengths(~present, inside=True)
    frames, markers = present.shape
    text = (
        f"A continuous take of {frames:,} frames at {rate:g} Hz. Of its {markers} markers "
        f"{100 * (~present).mean():.2f} % are missing, in {len(lengths):,} gaps; gaps that the take's ends "
        "cut off are not counted."
    )
    if not len(lengths):
        return Section("Gaps", text)
    caption = (
        "Share of gaps by length. Orange: median and 90th percentile of the gap lists of real finger markers "
        "that were published with LocalMoCap (SIGGRAPH 2023)."
    )
    return Section("Gaps", text, pictures=[(picture((9.0, 4.2), _draw_gaps, lengths, rate), caption)])


def _draw_gaps(figure: Figure, lengths: Int[np.ndarray, "G"], rate: float) -> None:
    """Draw the share of gaps up to each length [frames], and the published median and 90th percentile."""
    panel = figure.subplots()
    ordered = np.sort(lengths)
    longest = int(max(ordered[-1], 1.3 * _PUBLISHED_P90[1]))
    steps = np.arange(1, longest + 2)
    shares = 100.0 * np.searchsorted(ordered, steps, side="right") / len(ordered)
    panel.step(steps, shares, where="post", color=Paint.BLUE, linewidth=1.8)
    panel.set(xscale="log", xlim=(0.9, 1.15 * longest), ylim=(0.0, 103.0))
    panel.set(xlabel="length of a gap [frames]", ylabel="gaps no longer than that [%]")
    panel.xaxis.set_major_formatter("{x:.0f}")
    milliseconds = panel.secondary_xaxis(
        "top", functions=(partial(np.multiply, 1e3 / rate), partial(np.multiply, rate / 1e3))
    )
    milliseconds.xaxis.set_major_formatter("{x:.0f}")
    milliseconds.set_xlabel(f"[ms at {rate:g} Hz]")
    for height, name, published in ((50.0, "median", _PUBLISHED_MEDIAN), (90.0, "p90", _PUBLISHED_P90)):
        mine = int(np.percentile(ordered, height, method="inverted_cdf"))
        panel.axhline(height, color=Paint.BAND, linewidth=1.0, zorder=0)
        panel.plot(
            published, (height, height), color=Paint.WARM, linewidth=5.0, solid_capstyle="butt", alpha=0.85
        )
        text = f"real finger markers: {name} {published[0]} to {published[1]}"
        annotate(panel, text, (published[1], height), (8, -11), color=Paint.WARM)
        panel.plot(mine, height, "o", color=Paint.BLUE, markersize=6.0, markeredgecolor=Paint.CARD)
        annotate(
            panel, f"{name} {mine}", (mine, height), (-8, 5), color=Paint.BLUE, ha="right", weight="bold"
        )
