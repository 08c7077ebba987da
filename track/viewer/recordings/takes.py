"""Takes as the viewer shows them, simulated or tracked: labels, poses and their status."""

from __future__ import annotations

import numpy as np

from gloves.takes.take import STATUSES, RigidBody, Take
from handsim.space.cameras import CameraRig, as_rig, list_rigs
from track.take_summary import doubts_of, frame_confidence
from track.viewer.recordings.recording import Curve, Recording, ShownBody, ShownFrame


class TakeRecording(Recording):
    """A take: labels, poses and status as they were simulated or tracked.

    Args:
        take: The take.
        rig: The cameras; those that the take names, if they come with handsim, when None.
    """

    def __init__(self, take: Take, rig: CameraRig | None = None) -> None:
        self._models = tuple(hand.model for hand in take.hands)
        points = np.isfinite(take.points[..., 0]).sum(axis=1)
        super().__init__(
            take.times,
            take.label_names,
            most_points=int(points.max()) + take.hand_labels[-1].stop,
            radius=take.hands[0].layout.radius,
            bodies=tuple(shown_body(body) for body in take.bodies),
            rig=rig_of_settings(take.settings.get("rig")) if rig is None else rig,
        )
        self.replace(take)

    def replace(self, take: Take) -> None:
        """Show the same frames with other labels and poses."""
        self._take, self.curves, self.doubts = take, _curves(take), doubts_of(take)
        self._filled = np.concatenate([take.filled(side) for side in take.sides], axis=1)
        self._markers = np.concatenate([take.markers(side) for side in take.sides], axis=1)

    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""
        take = self._take
        there = np.isfinite(take.points[index, :, 0])
        filled = np.flatnonzero(self._filled[index])
        return ShownFrame(
            time=float(take.times[index]),
            words=tuple(self._words(index)),
            hands=self._models,
            qpos=take.qpos[index],
            points=np.concatenate([take.points[index, there], self._markers[index, filled]]),
            labels=np.concatenate([take.labels[index, there].astype(np.int64), filled]),
            seen=np.repeat([True, False], [int(there.sum()), len(filled)]),
            bodies=take.body_poses[index],
        )

    def _words(self, index: int) -> list[str]:
        take = self._take
        rows: list[tuple[str, int, float, int]] = [
            (side, take.status[index, hand], take.rms[index, hand], int(self._filled[index, labels].sum()))
            for hand, (side, labels) in enumerate(zip(take.sides, take.hand_labels, strict=True))
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


def _curves(take: Take) -> tuple[Curve, ...]:
    """RMS of each hand, and doubt; nothing where no pose was fitted, as of a truth."""
    if not np.isfinite(take.rms).any():
        return ()
    curves = [Curve(f"{side} RMS [mm]", 1e3 * take.rms[:, hand]) for hand, side in enumerate(take.sides)]
    return (*curves, Curve("doubt, 0 to 1", 1.0 - frame_confidence(take)))


def shown_body(body: RigidBody) -> ShownBody:
    """A body with its surface, where that is known."""
    thing = body.shape
    return ShownBody(body.name) if thing is None else ShownBody(body.name, thing.vertices, thing.faces)


def rig_of_settings(rig: object) -> CameraRig | None:
    """The rig that settings name or hold; None for a path, which is none to follow."""
    return as_rig(rig) if isinstance(rig, dict) or rig in list_rigs() else None
