"""Whether two sessions of a person differ as much as the report's minimal detectable differences say.

python -m benchmarks.sessions [--glove dense19] [--users 30] [--seconds 4] [--calibrate] [--change]

Each simulated user makes one motion of the right hand in two sessions. For each session every marker is glued
on anew, up to 6 mm off along either direction of the skin, and moves with the flesh by 0.5 to 2 mm (RMS, a
figure per session, by linear functions of the digit's angles). Sessions are tracked as `handsim track` does,
with measured hands or --calibrate.

Errors within the 95 % interval are those of at most 1.96 standard deviations. The found MDD is 1.96 times the
root mean square, over users, of the difference between the sessions of an angle in a frame, of its mean, of
its 95th percentile and of the range from its 5th; the forecast one is that of the report, from the parts of
the standard deviations that change between sessions.

With --change one joint of each digit truly differs between the sessions by 5 to 30 degrees: it is fixed at
another angle, or its range is smaller in one of them. The found changes are regressed on the true ones, all
together and by kind, with standard errors for persons as the independent units, and the share of changes that
exceed the forecast MDD (the larger one of the pair) is compared with that of normal errors of this size.
"""

from __future__ import annotations

import dataclasses
import warnings
from itertools import product

import numpy as np
from scipy.stats import norm, spearmanr

from benchmarks.people import flesh_motion
from benchmarks.record import Figures, describe, report, run
from gloves import GloveFit, load_layout
from gloves.fit import GlovedHand, nominal_fit
from handsim import HandSimWarning, load_rig
from handsim.hand.shape import DIGITS, EVERYBODY, JOINT_NAMES, NUM_JOINTS
from track import track_capture
from track.config import HandOrigin
from track.kinematics.pose_spread import CHANGING, DETECTABLE, SOURCES, measurement_error
from train.simulation.room import RoomConfig, record_take
from train.simulation.scenes import CalibrationTakeConfig, sample_calibration_scene
from train.simulation.training_frames import sample_hands, wear_gloves

GLUED, FLESH = 0.006, (0.0005, 0.002)  # [m]
CHANGE = (5.0, 30.0)  # [deg]
GROUPS = {"MCP": (5, 9, 13, 17), "PIP": (6, 10, 14, 18), "DIP": (7, 11, 15, 19), "thumb": (2, 3)}
Session = dict[str, np.ndarray]


def glued(fit: GloveFit, rng: np.random.Generator) -> GloveFit:
    """The hand with each marker shifted along the skin."""
    worn = fit.attachment
    shifts = rng.uniform(-GLUED, GLUED, worn.points.shape)
    shifts -= (shifts * worn.normals).sum(axis=1, keepdims=True) * worn.normals
    return GloveFit(fit.model, dataclasses.replace(worn, points=worn.points + shifts))


def changed(qpos: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Poses (T, 27) of two sessions that differ in one flexion of each digit alone."""
    motions = [qpos.copy(), qpos.copy()]
    for digit in range(len(DIGITS)):
        joint = 7 + 4 * digit + rng.integers(2 if digit == 0 else 1, 4)
        angles, change = qpos[:, joint], np.deg2rad(rng.uniform(*CHANGE))
        low, middle, high = np.percentile(angles, (5.0, 50.0, 95.0))
        if rng.random() < 0.5:
            pair = [np.full_like(angles, middle), np.full_like(angles, middle + change)]
        else:
            pair = [low + (angles - low) * max(1.0 - change / (high - low), 0.0), angles]
        for motion, order in zip(motions, rng.permutation(2), strict=True):
            motion[:, joint] = pair[order]
    return motions


def sessions_of(user: int, glove: str, seconds: float, calibrate: bool, change: bool) -> list[Session]:
    """True and found angles, standard deviations (T, 20) and their parts (20, 4) of both sessions [deg]."""
    rng = np.random.default_rng((user, 56))
    layout = load_layout(glove)
    model = next(one for one in sample_hands(EVERYBODY, rng=rng) if one.shape.side == "right")
    (worn,) = wear_gloves(layout, [model], along=0.0, around=0.0, rng=rng)
    config = CalibrationTakeConfig(free=seconds, rounds=0)
    scene = sample_calibration_scene((worn,), config, rng=rng)
    moved_by = scene.hands[0].qpos
    motions = changed(moved_by, np.random.default_rng((user, 57))) if change else [moved_by] * 2
    made: list[Session] = []
    for qpos in motions:
        hand = GlovedHand(glued(worn, rng), qpos)
        moved = flesh_motion(hand.fit.attachment, hand.qpos, rng.uniform(*FLESH), rng=rng)
        moving = dataclasses.replace(scene, hands=(hand,), skin=(moved,))
        take = record_take(moving, load_rig("figure5"), RoomConfig(), {}, rng=rng)
        found = track_capture(take.capture(), glove=layout, hands="right", calibrate=calibrate)
        assert found.angle_spread is not None
        made.append(
            {
                "true": np.rad2deg(take.qpos[:, 0, 7:]),
                "found": np.rad2deg(found.qpos[:, 0, 7:]),
                "spread": np.rad2deg(found.angle_spread[:, 0]),
                "budget": np.array(
                    found.settings["budget"].get("right", np.full((NUM_JOINTS, len(SOURCES)), np.nan))
                ),
            }
        )
    return made


def measures(angles: np.ndarray) -> dict[str, np.ndarray]:
    """What is compared between sessions of angles (T, 20): rows by measure."""
    low, high = np.nanpercentile(angles, (5.0, 95.0), axis=0)
    return {
        "frame": angles,
        "mean": np.nanmean(angles, axis=0)[None],
        "peak": high[None],
        "range": (high - low)[None],
    }


def responses(pairs: list[list[Session]], origin: HandOrigin, told: np.ndarray) -> Figures:
    """How much of a true change between sessions is found, and how often a change exceeds the MDD."""
    figures: Figures = {}
    # The motion decides which joints (U, 20) changed: a joint at another angle has the same range of motion.
    differs = np.array([np.abs(one["true"] - other["true"]).max(axis=0) > 0.1 for one, other in pairs])
    moves = np.array([np.max([np.ptp(one["true"], axis=0) for one in pair], axis=0) > 0.1 for pair in pairs])
    kinds = {"": differs, ", fixed": differs & ~moves, ", smaller range": differs & moves}
    for measure in CHANGING:
        true, found = (
            [measures(second[angles])[measure] - measures(first[angles])[measure] for first, second in pairs]
            for angles in ("true", "found")
        )
        errors = [[measurement_error(one["budget"], origin, measure) for one in pair] for pair in pairs]
        users = np.repeat(np.arange(len(pairs)), [len(rows) for rows in true])
        limits = DETECTABLE * np.max(errors, axis=1)[users]
        change, seen = np.concatenate(true), np.concatenate(found)
        usable = np.isfinite(seen) & told
        is_changed = differs[users] & usable
        for (kind, which), (group, joints) in product(kinds.items(), GROUPS.items()):
            some = np.zeros_like(usable)
            some[:, joints] = (which[users] & usable)[:, joints]
            if (measure, kind) == ("range", ", fixed") or not some.any():
                continue  # The range of a fixed joint does not change.
            figures[f"{measure}_{group}{kind}"] = (
                f"change of the {measure}, {group}{kind}, found on true: slope, its standard error, "
                "intercept, SD of the rest, largest miss [deg]; joints",
                [
                    *regression(change[some], seen[some], users[np.nonzero(some)[0]]),
                    np.abs(seen - change)[some].max(),
                    int((which & told)[:, joints].sum()),
                ],
            )
        unchanged = ~differs[users] & usable
        figures[f"{measure}_false"] = (
            f"unchanged joints whose {measure} exceeds the MDD [%]",
            100.0 * (np.abs(seen) > limits)[unchanged].mean(),
        )
        shift = 1.96 * np.abs(change) / limits
        forecast = norm.cdf(shift - 1.96) + norm.cdf(-shift - 1.96)
        is_called = (np.abs(seen) > limits) & (np.sign(seen) == np.sign(change))
        for low, high in ((5.0, 10.0), (10.0, 20.0), (20.0, 30.0)):
            band = is_changed & (np.abs(change) >= low) & (np.abs(change) < high)
            figures[f"{measure}_{low:g}"] = (
                f"true changes of the {measure} by {low:g} to {high:g} degrees that exceed the MDD [%]: "
                "found, forecast; changes",
                [100.0 * is_called[band].mean(), 100.0 * forecast[band].mean(), int(band.sum())],
            )
    return figures


def regression(x: np.ndarray, y: np.ndarray, users: np.ndarray) -> tuple[float, float, float, float]:
    """Slope of y on x, its standard error with users as independent units, intercept, and SD of the rest."""
    around = x - x.mean()
    slope = around @ y / (around @ around)
    rest = y - y.mean() - slope * around
    sums, count = np.bincount(users, around * rest), len(set(users.tolist()))
    with np.errstate(divide="ignore"):  # one user has no standard error
        error = np.sqrt(np.divide(count, count - 1) * (sums @ sums)) / (around @ around)
    return slope, error, y.mean() - slope * x.mean(), rest.std(ddof=2)


def main(
    glove: str = "dense19",
    users: int = 30,
    seconds: float = 4.0,
    calibrate: bool = False,
    change: bool = False,
    save: str | None = None,
) -> None:
    warnings.simplefilter("ignore", HandSimWarning)
    print(describe("numba"))
    pairs = [sessions_of(user, glove, seconds, calibrate, change) for user in range(users)]
    every = [one for pair in pairs for one in pair]
    off = np.concatenate([one["found"] - one["true"] for one in every])
    spread = np.concatenate([one["spread"] for one in every])
    seen = np.isfinite(off[:, 0])
    within = 100.0 * (np.abs(off[seen]) <= 1.96 * spread[seen]).mean(axis=0)
    both = [[measures(one["found"]) for one in pair] for pair in pairs]
    budget = np.sqrt(np.nanmean(np.array([one["budget"] for one in every]) ** 2, axis=0))
    origin: HandOrigin = "calibrated" if calibrate else "measured"
    digits = nominal_fit(glove, "M", "right").attachment.digits
    told = np.isin(np.arange(NUM_JOINTS) // 4, digits)  # joints of digits with a marker
    print("joint | within the 95 % interval [%] | RMSE [deg]")
    rms = np.sqrt(np.nanmean(off**2, axis=0))
    for row in zip(JOINT_NAMES, within, rms, strict=True):
        print("{:28s} | {:5.1f} | {:5.2f}".format(*row))
    figures: Figures = {
        "users": ("users with two sessions", users),
        "lost": ("frames without a pose [%]", 100.0 * (1.0 - seen.mean())),
        "within": (
            "errors within the 95 % interval [%]: all, least and largest of a joint",
            [within[told].mean(), within[told].min(), within[told].max()],
        ),
        "joints": ("joints with 93 to 97 %", int(((within[told] >= 93.0) & (within[told] <= 97.0)).sum())),
    }
    if change:
        report(save, figures | responses(pairs, origin, told))
        return
    for measure in CHANGING:
        changes = np.concatenate([one[measure] - other[measure] for one, other in both])
        found = 1.96 * np.sqrt(np.nanmean(changes**2, axis=0))[told]
        forecast = DETECTABLE * measurement_error(budget, origin, measure)[told]
        ratio = forecast / found
        figures[measure] = (
            f"forecast MDD of the {measure} over the found one: median, least, largest of a joint; joints "
            "with 0.8 to 1.25 [%]; rank correlation; median found MDD [deg]",
            [
                *(np.median(ratio), ratio.min(), ratio.max()),
                100.0 * ((ratio >= 0.8) & (ratio <= 1.25)).mean(),
                spearmanr(forecast, found).statistic,
                np.median(found),
            ],
        )
    report(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
