"""Settings of the online tracker that a user may change.

Everything else that the tracker assumes of hands, gloves and optical systems is a named constant beside the
code that uses it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from handsim.settings import Limits, Settings

SizeChoice = Literal["auto", "XS", "S", "M", "L", "XL"]
"""Size of hands; `auto` measures them."""
HandOrigin = Literal["named", "measured", "calibrated"]
"""Where a hand is from: of a named size, with size and proportions measured, or calibrated."""
_Positive = Annotated[float, Limits(0.0, above=True)]


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """Settings of `track.Tracker`; a tracked take records them.

    Raises:
        ArgumentError: A number is not finite or not positive.
    """

    noun: ClassVar[str] = "setting of the tracker"
    marker_noise: _Positive = 0.001
    """Standard deviation of markers around a fitted pose [m]; about what optical systems and gloves reach."""
    stray_density: _Positive = 2000.0
    """Strays near a hand that could be taken for a marker [1/m^3]: one in a cube of 8 cm."""
    most_rms: _Positive = 0.008
    """RMS distance beyond which a pose is rejected [m]; Han et al. 2018, section 4.4."""
    least_evidence: _Positive = 5.0
    """A hand is initialized from this log-odds for each of its markers on, ten markers counted at most."""
    fewest_labels: Annotated[int, Limits(1)] = 4
    """A pose is reliable with at least this many labeled points."""
    longest_coast: _Positive = 0.1
    """Time for which a pose is predicted without enough labels [s]."""
    doubt_time: _Positive = 0.15
    """Time for which a track that lacks most labels or fits badly is kept before its hand is initialized
    again [s]."""
    longest_review_wait: _Positive = 0.25
    """Longest time until the labeler labels a tracked hand's points again [s]."""
    silence: _Positive = 0.25
    """After this time without a frame a note is given, and labels are forgotten [s]."""
