"""From unlabeled points to hand motion, online.

A `Tracker` takes one frame of points at a time and gives a `TrackedFrame`; `track_capture` runs it over a
capture and returns a `TrackedTake`. `calibrate` fits hand and glove to their user. `solve_pose` is the
inverse kinematics alone: poses from labeled markers.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from gloves.takes.tracked_take import TrackedTake, load_tracked_take
    from track.calibration.user_calibration import calibrate
    from track.capture_tracking import track_capture
    from track.config import TrackerConfig
    from track.kinematics.pose_solver import solve_pose
    from track.tracked_frame import TrackedFrame
    from track.tracker import Tracker
    from track.user import load_user

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "TrackedFrame": "track.tracked_frame",
        "TrackedTake": "gloves.takes.tracked_take",
        "Tracker": "track.tracker",
        "TrackerConfig": "track.config",
        "calibrate": "track.calibration.user_calibration",
        "load_tracked_take": "gloves.takes.tracked_take",
        "load_user": "track.user",
        "solve_pose": "track.kinematics.pose_solver",
        "track_capture": "track.capture_tracking",
    },
)

__all__ = [
    "TrackedFrame",
    "TrackedTake",
    "Tracker",
    "TrackerConfig",
    "__version__",
    "calibrate",
    "load_tracked_take",
    "load_user",
    "solve_pose",
    "track_capture",
]
