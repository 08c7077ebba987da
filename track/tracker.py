"""The online tracker: points of a frame in, hands out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from track.hand_memory import HandMemory
from track.inverse_kinematics import PoseFit
from track.matching import gains, match
from track.tracked_frame import Status, TrackedFrame, TrackedHand
from track.user import UserHand

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy.typing import NDArray

MOST_RMS: Final = 0.008
"""RMS distance [m] beyond which a pose is thrown away; Han et al. 2018, section 4.4."""
_FEWEST: Final = 6
_LONGEST_COAST: Final = 0.1  # [s] without enough markers
_SURPRISE: Final = 0.006  # [m] by which the coming pose may be wrong where a label is carried over by its ID
_FIT: Final = 0.0015  # [m] by which a fitted pose may be


class Tracker:
    def __init__(self, hands: Sequence[UserHand], finder) -> None:
        self.memories = [HandMemory(hand) for hand in hands]
        self._finder = finder
        sizes = [hand.attachment.layout.num_markers for hand in hands]
        self._first = np.cumsum([0, *sizes])
        self._labels: dict[int, int] = {}
        self._attempt = 0

    def step(self, points, ids, time: float) -> TrackedFrame:
        count = len(points)
        labels = np.array([self._labels.get(i, -1) for i in ids.tolist()], dtype=np.int64) if count else np.zeros(0, dtype=np.int64)
        confidence = np.ones(count)
        fits: list[PoseFit | None] = [None] * len(self.memories)
        starts = [m.predict(time) if m.qpos is not None else None for m in self.memories]
        places = np.full((self._first[-1], 3), np.nan)
        spreads = np.full(self._first[-1], 1.0)
        for h, memory in enumerate(self.memories):
            part = slice(self._first[h], self._first[h + 1])
            if starts[h] is None:
                labels[(labels >= part.start) & (labels < part.stop)] = -1
                continue
            places[part], spreads[part] = memory.expect(starts[h], time)
        self._drop(labels, points, places, spreads, _SURPRISE)
        for h, memory in enumerate(self.memories):
            if starts[h] is None: continue
            part = slice(self._first[h], self._first[h + 1])
            fits[h] = self._fit(h, labels, points, starts[h], time)
            if fits[h] is not None:
                places[part], spreads[part] = memory.expect(fits[h].qpos[0], time)
        known = self._drop(labels, points, places, spreads, _FIT)
        free = np.flatnonzero(labels < 0)
        missing = np.setdiff1d(np.flatnonzero(np.isfinite(places[:, 0])), labels)
        new = np.zeros(len(self.memories), dtype=bool)
        if len(free) and len(missing):
            found, sure = match(gains(points[free], places[missing], spreads[missing]))
            labels[free[found >= 0]] = missing[found[found >= 0]]
            confidence[free] = sure
            for h in range(len(new)):
                new[h] = ((missing[found[found >= 0]] >= self._first[h]) & (missing[found[found >= 0]] < self._first[h + 1])).any()
        for h, memory in enumerate(self.memories):
            if starts[h] is not None and (new[h] or h in known):
                fits[h] = self._fit(h, labels, points, starts[h], time)
        hands = []
        for h, memory in enumerate(self.memories):
            part = slice(self._first[h], self._first[h + 1])
            mine = (labels >= part.start) & (labels < part.stop)
            fit = fits[h]
            if fit is not None and mine.sum() >= _FEWEST and fit.rms[0] <= MOST_RMS:
                memory.carry_on(fit, time)
                hands.append(self._hand(h, Status.TRACKED, fit, time))
                continue
            if memory.qpos is not None and time - memory.time > _LONGEST_COAST:
                memory.qpos = None
            if memory.qpos is None:
                labels[mine] = -1
            hands.append(self._hand(h, Status.LOST if memory.qpos is None else Status.COASTING, None, time))
        lost = [h for h, m in enumerate(self.memories) if m.qpos is None]
        if lost:
            free = np.flatnonzero(labels < 0)
            for h, fit, own in self._finder.find(points[free], lost, free):
                part = slice(self._first[h], self._first[h + 1])
                labels[free[own >= 0]] = own[own >= 0] + part.start
                self.memories[h].begin(fit, time)
                hands[h] = self._hand(h, Status.FOUND, fit, time)
        self._labels = {i: int(l) for i, l in zip(ids.tolist(), labels.tolist()) if l >= 0 and i >= 0}
        return TrackedFrame(time, tuple(hands), labels, confidence)

    def _drop(self, labels, points, places, spreads, slack):
        """Take labels away from points too far from where their marker is expected."""
        named = np.flatnonzero(labels >= 0)
        if not len(named):
            return set()
        mine = labels[named]
        off = ((points[named] - places[mine]) ** 2).sum(axis=1)
        wrong = ~(off < 16.0 * (spreads[mine] ** 2 + slack**2))
        hit = {int(np.searchsorted(self._first, label, side="right")) - 1 for label in mine[wrong]}
        labels[named[wrong]] = -1
        return hit

    def _fit(self, h, labels, points, start, time):
        targets = np.full((self._first[h + 1] - self._first[h], 3), np.nan)
        mine = (labels >= self._first[h]) & (labels < self._first[h + 1])
        if mine.sum() < 4:
            return None
        targets[labels[mine] - self._first[h]] = points[mine]
        return self.memories[h].fit(targets, start, time)

    def _hand(self, h, status, fit, time):
        memory = self.memories[h]
        M = self._first[h + 1] - self._first[h]
        qpos = np.full(27, np.nan) if memory.qpos is None else memory.qpos
        return TrackedHand(memory.hand.side, status, qpos, float(fit.rms[0]) if fit else np.nan, np.full((M, 3), np.nan), np.zeros(0, dtype=int))
