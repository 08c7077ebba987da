"""Takes as the viewer shows them: a tracked one with its status, a simulated one with its truth."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.takes.take import Take
from gloves.takes.tracked_take import COASTING, LOST, STATUSES, TrackedTake
from handsim.space.cameras import CameraRig, as_rig, list_rigs
from handsim.space.objects import named_object, object_names
from handsim.space.transforms import rotation_quaternions
from track.viewer.recordings.recording import Curve, Doubt, Recording, ShownBody, ShownFrame, runs_of

_CERTAIN: Final = 0.95  # confidence of every label of a frame that needs no look
_MOST_DOUBTS: Final = 12  # rows


class TrackedRecording(Recording):
    """A tracked take: labels, poses and status as the tracker made them.

    Args:
        take: The take.
        rig: The cameras, where they are known.
    """

    def __init__(self, take: TrackedTake, rig: CameraRig | None = None) -> None:
        self._take = take
        self._models = tuple(hand.model for hand in take.hands)
        self._offsets = np.cumsum([0, *(hand.layout.num_markers for hand in take.hands)])
        points = np.isfinite(take.points[..., 0]).sum(axis=1)
        super().__init__(
            take.times,
            take.label_names,
            most_points=int(points.max()) + int(self._offsets[-1]),
            radius=take.hands[0].layout.radius,
            bodies=tuple(shown_body(body.name) for body in take.bodies),
            rig=rig,
            curves=_curves(take),
            doubts=doubts_of(take),
        )

    def replace(self, take: TrackedTake) -> None:
        """Show the same frames with other labels and poses."""
        self._take, self.curves, self.doubts = take, _curves(take), doubts_of(take)

    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""
        take = self._take
        there = np.isfinite(take.points[index, :, 0])
        filled = take.filled[index] & np.isfinite(take.markers[index, ..., 0])
        hand, marker = np.nonzero(filled)
        return ShownFrame(
            time=float(take.times[index]),
            words=tuple(self._words(index)),
            hands=self._models,
            qpos=take.qpos[index],
            points=np.concatenate([take.points[index, there], take.markers[index][filled]]),
            labels=np.concatenate([take.labels[index, there].astype(np.int64), self._offsets[hand] + marker]),
            seen=np.repeat([True, False], [int(there.sum()), len(hand)]),
            bodies=take.body_poses[index],
        )

    def _words(self, index: int) -> list[str]:
        take = self._take
        rows: list[tuple[str, int, float, int]] = [
            (side, take.status[index, hand], take.rms[index, hand], int(take.filled[index, hand].sum()))
            for hand, side in enumerate(take.sides)
        ]
        rows += [
            (body.name, take.body_status[index, number], take.body_rms[index, number], 0)
            for number, body in enumerate(take.bodies)
        ]
        lines = []
        for name, status, rms, filled in rows:
            parts = [f"**{name}** {STATUSES[status]}"]
            parts += [f"RMS {1e3 * rms:.2f} mm"] if np.isfinite(rms) else []
            parts += [f"{filled} filled in"] if filled else []
            lines.append(", ".join(parts))
        there = np.isfinite(take.points[index, :, 0])
        return [*lines, f"{there.sum()} points, {(take.labels[index, there] < 0).sum()} without label"]


def doubts_of(take: TrackedTake) -> tuple[Doubt, ...]:
    """Spans in which a hand is lost or coasts, the longest first, then unsure labels, the worst first.

    A hand that has not been seen yet is not lost.
    """
    found: list[tuple[float, int, Doubt]] = []
    for number, side in enumerate(take.sides):
        status = take.status[:, number]
        known = np.logical_or.accumulate(status != LOST)
        for first, last in runs_of(known & ((status == LOST) | (status == COASTING))):
            state = LOST if (status[first : last + 1] == LOST).any() else COASTING
            found.append((0.0, last - first, Doubt(first, last, first, f"{side} {STATUSES[state]}")))
    sure = np.where(take.labels >= 0, take.confidence, 1.0)
    least = sure.min(axis=1, initial=1.0)
    for first, last in runs_of(least < _CERTAIN):
        worst = first + int(least[first : last + 1].argmin())
        label = take.label_names[take.labels[worst, sure[worst].argmin()]]
        words = f"{label} {100 * least[worst]:.0f} %"
        found.append((float(least[worst]), last - first, Doubt(first, last, worst, words)))
    found.sort(key=lambda entry: (entry[0], -entry[1], entry[2].first))
    return tuple(doubt for *_, doubt in found[:_MOST_DOUBTS])


def _curves(take: TrackedTake) -> tuple[Curve, ...]:
    """RMS of each hand, and doubt."""
    curves = [Curve(f"{side} RMS [mm]", 1e3 * take.rms[:, hand]) for hand, side in enumerate(take.sides)]
    return (*curves, Curve("doubt, 0 to 1", 1.0 - frame_confidence(take)))


def frame_confidence(take: TrackedTake) -> Float[np.ndarray, "T"]:
    """The least confidence of a frame's labels; 0 where a hand is coasting or has just been lost.

    NaN in frames without labels.
    """
    labeled = take.labels >= 0
    least: NDArray[np.float64] = np.where(labeled, take.confidence, np.inf).min(axis=1, initial=np.inf)
    least[np.isinf(least)] = np.nan
    lost = take.status == LOST
    just_lost = lost & ~np.concatenate([np.ones_like(lost[:1]), lost[:-1]])
    least[((take.status == COASTING) | just_lost).any(axis=1)] = 0.0
    return least


class TruthRecording(Recording):
    """The truth of a simulated take.

    Args:
        take: The take.
        rig: The cameras; those of the take, if it names shipped ones or holds its own, when None.
    """

    def __init__(self, take: Take, rig: CameraRig | None = None) -> None:
        self._take = take
        self._models = tuple(hand.fit.model for hand in take.hands)
        self._bodies = np.empty((take.num_frames, 0, 7))
        names = [f"{hand.side}:{name}" for hand in take.hands for name in hand.layout.names]
        bodies: tuple[ShownBody, ...] = ()
        if take.body is not None:
            names += [f"{take.body.name}:{name}" for name in take.body.marker_names]
            bodies = (shown_body(take.body.name),)
            self._bodies = poses_of(take.body.T_world_body)[:, None]
        super().__init__(
            np.arange(take.num_frames) / take.rate,
            tuple(names),
            most_points=int(np.isfinite(take.points[..., 0]).sum(axis=1).max(initial=0)),
            radius=take.hands[0].layout.radius if take.hands else 0.0035,
            bodies=bodies,
            rig=rig_of_settings(take.settings.get("rig")) if rig is None else rig,
            has_filled=False,
        )

    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""
        take = self._take
        there = np.isfinite(take.points[index, :, 0])
        labels = take.labels[index, there].astype(np.int64)
        return ShownFrame(
            time=float(self.times[index]),
            words=("**truth** of a simulated take", f"{len(labels)} points, {(labels < 0).sum()} ghosts"),
            hands=self._models,
            qpos=np.array([hand.qpos[index] for hand in take.hands]).reshape(-1, 27),
            points=take.points[index, there],
            labels=labels,
            seen=np.ones(len(labels), dtype=np.bool_),
            bodies=self._bodies[index],
        )


def shown_body(name: str) -> ShownBody:
    """A body with its shape, if it is one of handsim's own objects."""
    if name not in object_names():
        return ShownBody(name)
    obj = named_object(name)
    return ShownBody(name, obj.vertices, obj.faces)


def rig_of_settings(rig: object) -> CameraRig | None:
    """The rig that settings name or hold; None for a path, which is none to follow."""
    return as_rig(rig) if isinstance(rig, dict) or rig in list_rigs() else None


def poses_of(transforms: Float[np.ndarray, "T 4 4"]) -> NDArray[np.float64]:
    """Positions and quaternions (T, 7)."""
    return np.concatenate([transforms[:, :3, 3], rotation_quaternions(transforms[:, :3, :3])], axis=1)
