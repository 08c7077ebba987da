"""Score of a camera rig before it records: forecasts of hands at work, suspicious geometry, and its page.

A map shows what the rig sees of hands placed at each point of a grid in the volume.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.fit import GlovedHand
from gloves.layout import load_layout
from gloves.takes.take import Take, load_take
from handsim.callbacks import OnStep, no_step
from handsim.files.outputs import plain_json
from handsim.pages import (
    NOTHING,
    Paint,
    Section,
    color_bar,
    color_scale,
    coordinates,
    html_list,
    picture,
    write_sections,
)
from handsim.space.objects import MARKER_RADIUS
from handsim.space.rig import HAND_REACH, MIN_CAMERAS, ROOM_CENTER, CameraRig, load_rig
from train.forecast.rig_forecast import (
    HALF_SIDE,
    OPTICS,
    CameraLoss,
    Forecast,
    camera_losses,
    covariances,
    forecast,
    light_work,
    sample_work,
    work_of_take,
)
from train.forecast.settings import ScoreRigSettings
from train.simulation.room import SceneSight, marker_radii
from train.simulation.scenes import SceneMotion

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GRID: Final = 5
"""Number of points of the map along each side of the volume."""
_GLOVE: Final = "dense19"
_PEOPLE: Final = 2  # people for each kind of work
_HANDS: Final = 12  # number of hands placed at every point of the map
_LONGEST_ERROR: Final = 0.01  # [m] larger errors are not averaged: two almost parallel rays make no point

# Figures beyond these thresholds get a sentence of advice.
_MANY_MISSING: Final = 0.05  # share of marker-frames without a point
_POOR_CORNER: Final = 0.7  # share of markers seen by two at the worst point of the volume, over the best
_RARELY_NEEDED: Final = 0.005  # share of marker-frames for which a camera is needed
_RISE: Final = 1.1  # factor by which missing marker-frames may rise without a camera
_LONG_AXIS_RATIO: Final = 2.0  # ratio of the error's longest axis to its shortest
_LEAST_LONG_AXIS: Final = 0.0005  # [m] longest axis of the error
_MANY_GHOSTS: Final = 0.2  # ghosts per frame
_CLOSE_CAMERAS: Final = 0.10  # [m] distance between two cameras with nearly the same view
_OFF_CENTER: Final = 0.5  # [m] distance of the working point from the default position of simulated hands
_NARROW_ANGLE: Final = 30.0  # [deg] largest angle between two cameras
_SMALL_MARKER: Final = 2.0  # [px] diameter of a marker in the picture
_COVERED: Final = 0.9  # share of the cube in view of two cameras
_UPSIDE_DOWN: Final = -0.2  # cosine between its up and the world's, below which a camera is upside down

_COLUMNS: Final = (
    *("by 2 [%]", "by 3 [%]", "missing [%]", "gaps [1/min]"),
    *("median [ms]", "p95 [ms]", "ghosts", "error [mm]"),
)
COLUMNS_TOLD: Final = (
    "By 2, by 3: share of the marker-frames (every marker of every hand in every frame) that so many "
    "cameras see. Missing: those without a point, whether unseen, merged with a neighbor or with too few "
    "rays. Gaps: of one marker, and their lengths. Ghosts: points of a frame that are no marker, where rays "
    "meet by chance, in mirror images, and of reflections. Losses and reflections are those of `handsim "
    "simulate` with the same kind of work. Error: root mean square distance from the true center."
)
"""Explanation of both tables' columns."""
_VIEWS: Final = (("from above", 0, 1), ("from the front", 0, 2))
_ARROW: Final = 0.3  # [m] length of the line that shows a camera's direction


class VolumeMap(NamedTuple):
    """Forecast for a hand at each of G points of a volume."""

    points: Float[np.ndarray, "G 3"]
    """Positions of the wrist [m]."""
    seen_by_two: Float[np.ndarray, "G"]
    """Share of a hand's markers seen by at least two cameras."""
    seen_by_three: Float[np.ndarray, "G"]
    error: Float[np.ndarray, "G"]
    """Root mean square distance of points from the truth [m]; NaN if no marker has a point."""


@dataclass(frozen=True, slots=True, eq=False)
class RigScore:
    """Forecasts for a rig, and its faults."""

    rig: CameraRig
    whole: Forecast
    """Forecast of all work: shares of the marker-frames, gaps [s], error of points [m]."""
    kinds: dict[str, Forecast]
    """Forecast of each kind of work."""
    losses: list[CameraLoss]
    """Contribution of each camera."""
    volume: VolumeMap
    faults: list[str]
    """Suspicious properties of the rig's geometry."""
    work: str
    """Whose hands work, in words."""
    seed: int

    @property
    def advice(self) -> list[str]:
        """Sentences on what to do with the rig, the worst problem first."""
        suspicious = [f"Suspicious: {fault}." for fault in self.faults]
        if self.whole.missing >= 1.0:
            return [*suspicious, "No point is seen: hands work where no two cameras look."]
        return [*suspicious, *_advice_sentences(self)]

    def record(self) -> dict[str, Any]:
        """All figures as JSON, in meters and seconds; unknown ones are null."""
        return {
            "work": self.work,
            "seed": self.seed,
            "rig": self.rig.name,
            "cameras": len(self.rig.cameras),
            "all": _forecast_record(self.whole),
            "kinds": {kind: _forecast_record(one) for kind, one in self.kinds.items()},
            "without_camera": [
                {"seen": one.seen, "needed": one.needed}
                | ({} if one.without is None else _forecast_record(one.without))
                for one in self.losses
            ],
            "volume": plain_json(self.volume._asdict()),
            "suspicious": self.faults,
        }


def score_rig(
    rig: CameraRig | str | Path,
    settings: ScoreRigSettings | None = None,
    *,
    on_step: OnStep = no_step,
    **options: Any,
) -> RigScore:
    """Score a rig as `handsim rig score` does, without any recording.

    Args:
        rig: The cameras, or the name or path of a rig.
        settings: Work of the hands.
        on_step: Called with the name of each step.
        options: Fields of `settings`, by name: `volume=(1, 1, 0.8)` [m].

    Returns:
        Forecasts of all work, of each kind and without each camera, a map of the volume, and advice in
        sentences.

    Raises:
        ArgumentError: A setting is unknown or refused, or a camera is inside the hands.
        CaptureError: The take cannot be read, or its hands are never tracked together.
        LayoutError, RigError: The glove or the rig is unknown.
    """
    cameras, chosen = load_rig(rig), ScoreRigSettings.of(settings, options)
    glove, take, sides = chosen.glove, chosen.take, np.array(chosen.volume, dtype=np.float64)
    on_step("simulating hands")
    if take is None:
        center = np.array(ROOM_CENTER if chosen.center is None else chosen.center, dtype=np.float64)
        layout = load_layout(_GLOVE if glove is None else glove)
        rng = np.random.default_rng(chosen.seed)
        work = sample_work(layout, center, sides, chosen.num_frames, _PEOPLE, rng=rng)
        text = f"simulated people in the glove {layout.name}"
    else:
        text = "a take" if isinstance(take, Take) else f"the take {Path(take).name}"
        given = take if isinstance(take, Take) else load_take(take)
        work = work_of_take(given, None if glove is None else load_layout(glove), chosen.num_frames)
        wrists = [hand.qpos[:, :3] for scenes in work.values() for one in scenes for hand in one.hands]
        center = np.concatenate(wrists).mean(axis=0) if chosen.center is None else np.array(chosen.center)
    on_step("forecasting")
    return score_work(cameras, work, center, sides, described_as=text, seed=chosen.seed)


def score_work(
    rig: CameraRig,
    work: Mapping[str, Sequence[SceneMotion]],
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    *,
    described_as: str,
    seed: int = 0,
) -> RigScore:
    """Score a rig on scenes of each kind of work, and map a volume [m]; `described_as` is shown to users."""
    rng = np.random.default_rng(seed)
    lit = light_work(work, rig, rng=rng)
    everything = [one for scenes in lit.values() for one in scenes]
    return RigScore(
        rig,
        forecast(everything, rig, seed=seed),
        {kind: forecast(scenes, rig, seed=seed) for kind, scenes in lit.items()},
        camera_losses(everything, rig, seed=seed),
        map_volume([one.scene for one in everything], rig, center, sides, rng=rng),
        faults(rig),
        described_as,
        seed,
    )


def map_volume(
    scenes: Sequence[SceneMotion],
    rig: CameraRig,
    center: Float[np.ndarray, "3"],
    sides: Float[np.ndarray, "3"],
    *,
    rng: np.random.Generator,
) -> VolumeMap:
    """Place hands of scenes, in poses of theirs, at each point of a grid in a volume [m]."""
    points = cube_points(center, sides, GRID)
    two, three, errors = [], [], []
    for _ in range(_HANDS):
        scene = scenes[int(rng.integers(len(scenes)))]
        hand = scene.hands[int(rng.integers(len(scene.hands)))]
        qpos = np.tile(hand.qpos[rng.integers(scene.num_frames)], (len(points), 1))
        qpos[:, :3] = points
        placed = SceneMotion((GlovedHand(hand.fit, qpos),))
        sight, radii = SceneSight(placed, rig), marker_radii(placed, OPTICS)
        seen = sight.visible_markers(OPTICS.partial * radii, rng=rng)
        views = seen.sum(axis=-1)
        two.append((views >= MIN_CAMERAS).mean(axis=1))
        three.append((views > MIN_CAMERAS).mean(axis=1))
        rows, columns = np.nonzero(views >= MIN_CAMERAS)
        noise = OPTICS.noise * np.sqrt(MARKER_RADIUS / radii[columns])
        spread = covariances(sight.markers[0][rows, columns], seen[rows, columns], rig, noise)
        lengths = np.sqrt(np.trace(spread, axis1=1, axis2=2))
        errors.append(np.full(views.shape, np.nan))
        errors[-1][rows, columns] = np.where(lengths < _LONGEST_ERROR, lengths, np.nan)
    error = np.concatenate(errors, axis=1)
    known = np.isfinite(error)
    mean = np.where(known, error, 0.0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    return VolumeMap(points, np.mean(two, axis=0), np.mean(three, axis=0), mean)


def cube_points(
    center: Float[np.ndarray, "3"], sides: Float[np.ndarray, "3"] | float, count: int = 7
) -> NDArray[np.float64]:
    """A grid of points (count ** 3, 3) in a box of these sides around a center [m]."""
    steps = np.linspace(-0.5, 0.5, count)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(center + grid * sides)


def _forecast_record(one: Forecast) -> dict[str, Any]:
    axes, directions, mean = one.error
    figures: dict[str, Any] = {field.name: getattr(one, field.name) for field in dataclasses.fields(one)}
    figures |= {"error": mean, "error_axes": axes, "error_directions": directions}
    return {name: plain_json(value) for name, value in figures.items()}


def _advice_sentences(score: RigScore) -> Iterator[str]:
    """Sentences on the figures of a rig, the worst problem first."""
    whole, (axes, directions, _) = score.whole, score.whole.error
    if whole.missing > _MANY_MISSING:
        worst_kind = max(score.kinds, key=lambda kind: score.kinds[kind].missing)
        share = f"{100 * score.kinds[worst_kind].missing:.0f} %"
        most = f", most with {worst_kind} ({share})" if len(score.kinds) > 1 else ""
        yield f"{100 * whole.missing:.1f} % of the marker-frames will be missing{most}: add or move cameras."
    seen = score.volume.seen_by_two
    worst = int(seen.argmin())
    if seen[worst] < _POOR_CORNER * seen.max():
        yield (
            f"At {_position(score.volume.points[worst])} two cameras see {100 * seen[worst]:.0f} % of a "
            f"hand's markers, {100 * seen.max():.0f} % at the best place: keep hands away or aim a camera "
            "at it."
        )
    yield from _camera_sentences(score)
    if axes[0] > _LEAST_LONG_AXIS and axes[0] > _LONG_AXIS_RATIO * axes[2]:
        along = "xyz"[int(np.abs(directions[0]).argmax())]
        yield (
            f"Points are least certain along {along}, {1e3 * axes[0]:.2f} mm against {1e3 * axes[2]:.2f} mm: "
            f"a camera that looks across {along} would help."
        )
    if whole.ghosts > _MANY_GHOSTS:
        worst_kind = max(score.kinds, key=lambda kind: score.kinds[kind].ghosts)
        count = f"{score.kinds[worst_kind].ghosts:.1f}"
        most = f", most with {worst_kind} ({count})" if len(score.kinds) > 1 else ""
        yield (
            f"{whole.ghosts:.1f} points a frame will be no marker{most}: reflections that cameras see, "
            "mirror images, and rays that meet by chance where few cameras see a marker."
        )


def _camera_sentences(score: RigScore) -> Iterator[str]:
    """Sentences on the camera that matters most, and on dispensable cameras."""
    if len(score.losses) == MIN_CAMERAS:
        yield "Without either camera there are no points at all: a third would forgive a loss."
        return
    missing = [0.0 if one.without is None else one.without.missing for one in score.losses]
    worst = int(np.argmax(missing))
    yield (
        f"Camera {worst + 1} matters most: without it {100 * missing[worst]:.1f} % of the marker-frames are "
        f"missing, not {100 * score.whole.missing:.1f} %."
    )
    allowed = _RISE * score.whole.missing + 0.1 * _RARELY_NEEDED
    idle = {
        number: one.without.missing
        for number, one in enumerate(score.losses, 1)
        if one.without is not None and one.needed <= _RARELY_NEEDED and one.without.missing <= allowed
    }
    if not idle:
        return
    least = min(idle, key=lambda number: idle[number])
    reason = (
        f"it sees {100 * score.losses[least - 1].needed:.1f} % of the marker-frames that no two others see, "
        f"and without it {100 * idle[least]:.1f} % are missing, not {100 * score.whole.missing:.1f} %"
    )
    others = ", ".join(str(number) for number in idle if number != least)
    also = f". So can any one of {others}; score the rig again after each" if others else ""
    yield f"Camera {least} can go: {reason}{also}."


def faults(rig: CameraRig) -> list[str]:
    """Sentences on suspicious geometry of a rig."""
    point = working_point(rig)
    return [*_axes_faults(rig, point), *_place_faults(rig, point)]


def working_point(rig: CameraRig) -> NDArray[np.float64]:
    """Point (3,) nearest to all optical axes [m]; `ROOM_CENTER` if they are parallel."""
    axes = rig.T_world_camera[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    total = across.sum(axis=0)
    if np.linalg.cond(total) > 1e6:
        return np.array(ROOM_CENTER)
    return np.linalg.solve(total, np.einsum("cij,cj->i", across, rig.positions))


def _axes_faults(rig: CameraRig, point: NDArray[np.float64]) -> Iterator[str]:
    """Cameras that look in a wrong direction."""
    rays = point - rig.positions
    ahead = np.einsum("ci,ci->c", rays, rig.T_world_camera[:, :3, 2])
    if (ahead < 0.0).sum() > len(ahead) / 2:
        yield (
            "most cameras look away from the point where their axes meet: expected OpenCV's axes, z into the "
            "picture and y down, are these OpenGL's?"
        )
        return
    for number in np.flatnonzero(~rig.in_view(point)) + 1:
        yield f"camera {number} looks away: {_position(point)}, where the others look, is not in its picture"
    for number in np.flatnonzero(-rig.T_world_camera[:, 2, 1] < _UPSIDE_DOWN) + 1:
        yield f"camera {number} is upside down: y of its picture points up in the world, expected down"


def _place_faults(rig: CameraRig, point: NDArray[np.float64]) -> Iterator[str]:
    """Cameras in wrong places, and parts around their common point of view that are not covered."""
    positions = rig.positions
    for number in np.flatnonzero(positions[:, 2] < 0.0) + 1:
        yield f"camera {number} is {-positions[number - 1, 2]:.2f} m below the floor, expected z up"
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1)
    for first, second in zip(*np.nonzero(np.triu(apart < _CLOSE_CAMERAS, 1)), strict=True):
        yield (
            f"cameras {first + 1} and {second + 1} are {100 * apart[first, second]:.0f} cm apart and see "
            "nearly the same"
        )
    if np.linalg.norm(point - ROOM_CENTER) > _OFF_CENTER:
        yield (
            f"the cameras look at {_position(point)}; simulated hands move around "
            f"{_position(np.array(ROOM_CENTER))}, so give generate, simulate and rig score --center, or move "
            "the rig's origin"
        )
    gaps = np.linalg.norm(positions - np.clip(positions, point - HALF_SIDE, point + HALF_SIDE), axis=1)
    for number in np.flatnonzero(gaps < HAND_REACH) + 1:
        yield (
            f"camera {number} is {gaps[number - 1]:.2f} m from the cube that hands work in, expected at "
            f"least {HAND_REACH:g} m"
        )
    rays = (point - positions) / np.linalg.norm(point - positions, axis=1, keepdims=True)
    widest = np.rad2deg(np.arccos(np.clip(np.abs(rays @ rays.T), 0.0, 1.0))).max()
    if widest < _NARROW_ANGLE:
        yield (
            f"no two cameras see the middle at more than {widest:.0f} deg to each other: depth will be "
            f"noisy, expected at least {_NARROW_ANGLE:.0f} deg"
        )
    sizes = pixels_of_a_marker(rig, point)
    for number in np.flatnonzero(sizes < _SMALL_MARKER) + 1:
        yield (
            f"camera {number} sees a marker of {2e3 * MARKER_RADIUS:.1f} mm as {sizes[number - 1]:.1f} px, "
            f"expected at least {_SMALL_MARKER:g} px"
        )
    covered = float((rig.in_view(cube_points(point, 2 * HALF_SIDE)).sum(axis=-1) >= 2).mean())
    if covered < _COVERED:
        yield (
            f"two cameras see only {100 * covered:.0f} % of the cube of {2 * HALF_SIDE:g} m around "
            f"{_position(point)}, expected all of it"
        )


def pixels_of_a_marker(rig: CameraRig, point: Float[np.ndarray, "3"]) -> NDArray[np.float64]:
    """Diameter (C,) of the paper's marker at a point [m] in each camera's picture [px]."""
    distances = np.linalg.norm(point - rig.positions, axis=1)
    focals = np.array([one.focal_length for one in rig.cameras])
    return np.asarray(2 * MARKER_RADIUS * focals / np.maximum(distances, 1e-9))


def _position(point: Float[np.ndarray, "3"]) -> str:
    return f"({coordinates(point, ', ')}) m"


def write_rig_page(path: Path, score: RigScore) -> None:
    """Write the page on a rig's score."""
    rig = score.rig
    seen = f"{score.whole.marker_frames:,} marker-frames of {score.work}"
    lead = f"{len(rig.cameras)} cameras of {rig.pictures()}; {seen}."
    error = score.whole.error
    axes = ", ".join(
        f"{1e3 * axis:.3f} mm along ({coordinates(direction)})"
        for axis, direction in zip(error.axes, error.directions, strict=True)
    )
    note = f"The error as an ellipsoid, standard deviations: {axes}."
    note = note if np.isfinite(error.mean) else "No marker has a point."
    without = (
        "The same hands without one camera. Sees, needed: share of the marker-frames that the camera sees, "
        "and that it sees and fewer than two others."
    )
    caption = "Marker-frames that are missing without each camera, and with all."
    volume = "Hands in poses of the work, set at each point of a grid in the volume, each alone."
    disks = "Disks are cameras, numbered, with their directions. Colors are averages along the view."
    map_drawn = picture((9.6, 4.6), _draw_map, score.volume, rig)
    losses = picture((8.4, 3.2), _draw_losses, score.losses, score.whole.missing)
    sections = [
        Section("What to do", html_list(score.advice)),
        Section("Hands at work", COLUMNS_TOLD, table=work_table(score), notes=[note]),
        Section("Cameras", without, table=camera_table(score), pictures=[(losses, caption)]),
        Section("The volume", volume, table=volume_table(score.volume), pictures=[(map_drawn, disks)]),
    ]
    write_sections(path, sections, title=f"Rig {rig.name}", lead=lead)


def work_table(score: RigScore) -> list[list[str]]:
    """Figures of each kind of work and of all work, header first."""
    rows = (
        [[kind, *_forecast_cells(one)] for kind, one in score.kinds.items()] if len(score.kinds) > 1 else []
    )
    return [["work", *_COLUMNS], *rows, ["all", *_forecast_cells(score.whole)]]


def camera_table(score: RigScore) -> list[list[str]]:
    """Figures without each camera, header first."""
    rows = []
    for number, one in enumerate(score.losses, 1):
        left = [NOTHING] * len(_COLUMNS) if one.without is None else _forecast_cells(one.without)
        rows.append([str(number), f"{100 * one.seen:.1f}", f"{100 * one.needed:.1f}", *left])
    return [["without camera", "sees [%]", "needed [%]", *_COLUMNS], *rows]


def volume_table(volume: VolumeMap) -> list[list[str]]:
    """Figures of the volume, header first."""
    rows = [["a hand's markers", "mean", "worst", "at [m]"]]
    for title, shares in (("two", volume.seen_by_two), ("three", volume.seen_by_three)):
        least, place = f"{100 * shares.min():.1f}", coordinates(volume.points[shares.argmin()])
        rows.append([f"seen by {title} [%]", f"{100 * shares.mean():.1f}", least, place])
    errors = 1e3 * volume.error
    if np.isfinite(errors).any():
        worst = int(np.nanargmax(errors))
        place = coordinates(volume.points[worst])
        rows.append(["error [mm]", f"{np.nanmean(errors):.2f}", f"{errors[worst]:.2f}", place])
    return rows


def _forecast_cells(one: Forecast) -> list[str]:
    return [
        f"{100 * one.seen_by_two:.1f}",
        f"{100 * one.seen_by_three:.1f}",
        f"{100 * one.missing:.1f}",
        f"{one.gaps:.1f}",
        _number(1e3 * one.gap_median, 0),
        _number(1e3 * one.gap_p95, 0),
        f"{one.ghosts:.3f}",
        _number(1e3 * one.error.mean, 3),
    ]


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else NOTHING


def _draw_losses(figure: Figure, losses: list[CameraLoss], missing: float) -> None:
    """Draw the share of missing marker-frames without each camera, and with all."""
    panel = figure.subplots()
    numbers = np.arange(1, len(losses) + 1)
    without = [100.0 if one.without is None else 100 * one.without.missing for one in losses]
    panel.bar(numbers, without, color=Paint.PALE)
    panel.axhline(100 * missing, color=Paint.WARM, linewidth=1.2)
    end = (numbers[-1] + 0.5, 100 * missing)
    panel.annotate("with all cameras", end, color=Paint.WARM, ha="right", va="bottom", fontsize=8)
    panel.set(xticks=numbers, xlabel="without camera", ylabel="marker-frames missing [%]")


def _draw_map(figure: Figure, volume: VolumeMap, rig: CameraRig) -> None:
    """Draw the volume colored by the share of markers that two cameras see, averaged along the view."""
    panels = figure.subplots(1, 2)
    colors = color_scale(0, 100)
    shares = 100 * volume.seen_by_two.reshape(GRID, GRID, GRID)
    points = volume.points.reshape(GRID, GRID, GRID, 3)
    for panel, (title, right, up) in zip(panels, _VIEWS, strict=True):
        flat = shares.mean(axis=3 - right - up)
        panel.pcolormesh(
            np.unique(points[..., right]), np.unique(points[..., up]), flat.T,
            cmap=colors.cmap, norm=colors.norm, shading="nearest", rasterized=False,
        )  # fmt: skip
        for number, pose in enumerate(rig.T_world_camera, 1):
            begin, ahead = pose[[right, up], 3], pose[[right, up], 2]
            line = np.stack([begin, begin + _ARROW * ahead])
            panel.plot(*line.T, color=Paint.LINE, linewidth=2.0, zorder=2)
            panel.plot(*begin, "o", color=Paint.CARD, markeredgecolor=Paint.INK, markersize=11, zorder=3)
            place: dict[str, Any] = {"ha": "center", "va": "center_baseline", "zorder": 4}
            panel.annotate(str(number), begin, fontsize=6.5, color=Paint.INK, **place)
        panel.set_title(title, color=Paint.SOFT)
        panel.set(xlabel="x [m]", ylabel=f"{'xyz'[up]} [m]")
        panel.set_aspect("equal", adjustable="datalim")
    color_bar(figure, colors, "markers seen by two cameras [%]", ax=panels, shrink=0.7)
