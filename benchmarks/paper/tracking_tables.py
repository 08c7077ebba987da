"""Tables 5 and 7 of the paper, and few cameras: our tracker beside the paper's figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Final

import numpy as np
import tyro

from benchmarks.paper.labeling_tables import LabelerFile, SaveName
from benchmarks.paper.printed import CAMERAS, CAMERAS_FRAMES, TABLE5, TABLE7
from benchmarks.paper.take_evaluation import (
    OCCLUSIONS,
    TrackingReport,
    evaluate_tracker,
    measured_users,
    true_users,
)
from benchmarks.record import Figures, report
from gloves import GloveFit, Take
from handsim.app.messages import progress_bar
from handsim.space.objects import named_object
from track import RigidTemplate, Tracker, calibrate
from train import Labeler, SimulateSettings, load_labeler, simulate_take
from train.simulation.scenes import KINDS, CalibrationTakeConfig
from train.simulation.takes import simulate_calibration

GLOVE: Final = "dense19"
WITH_BODY: Final = "hand-controller"
USERS: Final[dict[str, Callable[[Take, Labeler], list[GloveFit]]]] = {
    "calibrated": lambda take, _: true_users(take),
    "uncalibrated": measured_users,
}
_KEYS: Final = {"calibrated": "true", "uncalibrated": "size"}
_ERRORS: Final = "errors of joints [mm], angles [deg], by markers missing: none, 1-2, 3-5, 6 or more"
Measured = dict[str, dict[str, TrackingReport]]
"""Reports by users, then by capture."""
_Frames = Annotated[int | None, tyro.conf.arg(help="Frames of each capture; the paper's when not given.")]
_Seed = Annotated[int, tyro.conf.arg(help="Seed of the captures; 0 gives the twins.")]


def table5(
    labeler: LabelerFile = None, num_frames: _Frames = None, seed: _Seed = 0, save: SaveName = None
) -> None:
    """Tables 5 and 7: frames all of whose labels are right, frames whose poses fit, and errors."""
    network = load_labeler(GLOVE, labeler)
    takes = {kind: simulate_take(kind=kind, num_frames=num_frames, seed=seed) for kind in KINDS}
    measured = measure({kind: take.without_body() for kind, take in takes.items()}, network)
    body = measure_with_body(takes[WITH_BODY], network)
    with_body = {
        f"body_{_KEYS[users]}": (f"{WITH_BODY}, controller too, right [%]: handsim, {users}", share)
        for users, share in body.items()
    }
    report(save, printed_figures() | table_figures(measured) | with_body)


def cameras(
    rig: str = "six",
    labeler: LabelerFile = None,
    num_frames: int = CAMERAS_FRAMES,
    seed: _Seed = 0,
    save: SaveName = None,
) -> None:
    """Hands in the air before fewer cameras: the paper switches off more than half of its 16."""
    take = simulate_take(settings=SimulateSettings("single-hand", num_frames, GLOVE, rig, seed))
    figures: Figures = {
        "paper": ("Han 2018, calibrated: valid, right of these [%]", 100 * np.array(CAMERAS)),
        "missing": (f"share of markers missing before rig {rig} [%]", 100 * missing_share(take)),
    }
    for users, reports in measure({"single-hand": take}, load_labeler(GLOVE, labeler)).items():
        one = reports["single-hand"].figures()
        shares = [100 * one[name] for name in ("valid", "right_of_valid", "valid_and_right")]
        errors = [1e3 * one["joint_error"], np.rad2deg(one["angle_error"])]
        what = f"valid, right of these, both [%]; joints [mm], joint angles [deg]: handsim, {users}"
        figures[_KEYS[users]] = what, [*shares, *errors]
    report(save, figures)


def calibrated(
    num_frames: _Frames = None, seed: _Seed = 0, free: float = 40.0, save: SaveName = None
) -> None:
    """Our tracker with hands that `handsim calibrate` finds in a capture of the same people.

    Args:
        num_frames: Frames of each capture; the paper's when not given.
        seed: Seed of the captures; 0 gives the twins.
        free: Free motion in the calibration captures [s].
        save: Name of the file in benchmarks/figures.
    """
    network = load_labeler(GLOVE)
    reports: dict[str, TrackingReport] = {}
    for kind in KINDS:
        take = simulate_take(kind=kind, num_frames=num_frames, seed=seed).without_body()
        hands = calibrated_users(take, seed, free)
        reports[kind] = evaluate_tracker(take, hands, Tracker(hands, network))
    errors = np.nanmax([errors_by_occlusion([one]) for one in reports.values()], axis=0)
    report(
        save,
        {
            "right": (f"frames all of whose labels are right [%]: {', '.join(reports)}", _right(reports)),
            "errors": (f"mean {_ERRORS}: calibrated from a capture, the worst of the takes", errors),
        },
    )


TRACKING_TABLES: Final[dict[str, Callable[..., None]]] = {
    "table5": table5,
    "cameras": cameras,
    "calibrated": calibrated,
}


def measure(takes: Mapping[str, Take], labeler: Labeler) -> Measured:
    """Run our tracker over every take, with calibrated and uncalibrated hands."""
    measured: Measured = {users: {} for users in USERS}
    with progress_bar("frames") as bar:
        bar(0, len(measured) * sum(take.num_frames for take in takes.values()))
        for name, take in takes.items():
            for users, reports in measured.items():
                hands = USERS[users](take, labeler)
                reports[name] = evaluate_tracker(take, hands, Tracker(hands, labeler), done=bar.advance)
    return measured


def measure_with_body(take: Take, labeler: Labeler) -> dict[str, float]:
    """Share of right frames [%] of our tracker, by users, with the take's body tracked beside the hands."""
    body = RigidTemplate.of(named_object(take.bodies[0].name))
    shares = {}
    for users, hands_of in USERS.items():
        hands = hands_of(take, labeler)
        found = evaluate_tracker(take, hands, Tracker(hands, labeler, (body,)))
        shares[users] = 100 * float(found.right.mean())
    return shares


def calibrated_users(take: Take, seed: int, free: float) -> list[GloveFit]:
    """The people of a take as `handsim calibrate` finds them in a capture that they make for it."""
    config, rng = CalibrationTakeConfig(free=free), np.random.default_rng((seed, 1))
    made = simulate_calibration(tuple(take.hands), config, rng=rng)
    return list(calibrate(made).of_sides(take.sides))


def printed_figures() -> Figures:
    """The figures that the paper prints in Tables 5 and 7."""
    kept: Figures = {}
    for method, shares in TABLE5.items():
        words = f"frames all of whose labels are right [%]: {method}, calibrated"
        kept[f"printed_{method.split()[0].lower()}"] = words, [100 * shares[kind] for kind in KINDS]
    for users, pairs in TABLE7.items():
        words = f"valid frames, right ones of these [%]: Han 2018, {users}"
        kept[f"printed_valid_{_KEYS[users]}"] = words, [100 * np.array(pairs[kind]) for kind in KINDS]
    return kept


def table_figures(measured: Measured) -> Figures:
    """The figures of Tables 5 and 7, and errors over all captures."""
    kept: Figures = {}
    for users, reports in measured.items():
        key, who = _KEYS[users], f"{', '.join(reports)}: handsim, {users}"
        shares = [one.figures() for one in reports.values()]
        valid = [[100 * one["valid"], 100 * one["right_of_valid"]] for one in shares]
        kept[f"right_{key}"] = f"frames all of whose labels are right [%], {who}", _right(reports)
        kept[f"valid_{key}"] = f"valid frames, right ones of these [%], {who}", valid
        errors = errors_by_occlusion(list(reports.values()))
        kept[f"errors_{key}"] = f"mean {_ERRORS}: handsim, {users}", errors
    return kept


def errors_by_occlusion(reports: Sequence[TrackingReport]) -> list[list[float]]:
    """Mean errors of joints [mm] and joint angles [deg] over all poses, by the number of missing markers."""
    parts = np.array([[one.by_occlusion()[bound] for bound in OCCLUSIONS] for one in reports])
    weights, errors = parts[..., :1], np.nan_to_num(parts[..., 1:])
    with np.errstate(invalid="ignore"):
        means = (weights * errors).sum(axis=0) / weights.sum(axis=0)
    return [[1e3 * joint, np.rad2deg(angle)] for joint, angle in means]


def missing_share(take: Take) -> float:
    """Share of the markers without a point."""
    return 1.0 - float(take.markers_present().mean())


def _right(reports: Mapping[str, TrackingReport]) -> list[float]:
    return [100 * float(one.right.mean()) for one in reports.values()]
