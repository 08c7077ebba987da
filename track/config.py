"""Settings of the online tracker that a user may change.

Everything else that the tracker assumes of hands, gloves and optical systems is a named constant beside the
code that uses it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final, Literal

from handsim._checks import check_number
from handsim.errors import ArgumentError
from handsim.hand.shape import Side

Size = Literal["auto", "XS", "S", "M", "L", "XL"]
"""Size of hands; auto is measured."""
HandOrigin = Literal["named", "measured", "calibrated"]
"""Where a hand is from: of a named size, with size and proportions measured, or calibrated."""
BOTH: Final[tuple[Side, ...]] = ("right", "left")


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of `track.Tracker`; `dataclasses.asdict` makes JSON of them, and a tracked take records them.

    Raises:
        ArgumentError: A number is not finite or not positive.
    """

    marker_noise: float = 0.001
    """Standard deviation of markers around a fitted pose [m]; optical systems and gloves reach about this."""
    stray_density: float = 2000.0
    """Strays near a hand that could be taken for a marker [1/m^3]: one in a cube of 8 cm."""
    most_rms: float = 0.008
    """RMS distance beyond which a pose is rejected [m]; Han et al. 2018, section 4.4."""
    least_evidence: float = 5.0
    """Log-odds of a hand for each of its markers (at most those of ten), from which on it is initialized."""
    fewest_labels: int = 4
    """Labeled points from which on a pose is reliable."""
    longest_coast: float = 0.1
    """Time for which a pose is predicted without enough labels [s]."""
    doubt_time: float = 0.15
    """Time for which a track that lacks most labels or fits badly is kept, before its hand is initialized
    again [s]."""
    longest_review_wait: float = 0.25
    """Longest time until the labeler labels a tracked hand's points again [s]."""
    silence: float = 0.25
    """Time without a frame that is noted, and that labels do not outlive [s]."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            check_number(item.name, getattr(self, item.name), 0.0, above=True)
        if self.fewest_labels != int(self.fewest_labels):
            raise ArgumentError(f"fewest_labels is {self.fewest_labels:g}, expected a whole number")
