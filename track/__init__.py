"""From unlabeled points to hand motion, online.

A `Tracker` takes one frame of points at a time and gives a `TrackedFrame`; `track_capture` runs it over a
capture and returns a `gloves.Take`, `track_stream` over a live stream from `open_source`; `open_sinks` takes
the hands to other programs. `calibrate` fits hand and glove to their user. `solve_pose` is the inverse
kinematics alone: poses from labeled markers.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from track.calibration.user_calibration import calibrate
    from track.capture_tracking import track_capture, track_stream
    from track.config import TrackerConfig
    from track.kinematics.pose_solver import solve_pose
    from track.sinks.addresses import open_sinks
    from track.sinks.message import LiveMessage
    from track.streams.addresses import open_source
    from track.streams.frame_source import StreamedFrame
    from track.tracked_frame import TrackedFrame
    from track.tracker import Tracker
    from track.user import load_user

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "LiveMessage": "track.sinks.message",
        "StreamedFrame": "track.streams.frame_source",
        "TrackedFrame": "track.tracked_frame",
        "Tracker": "track.tracker",
        "TrackerConfig": "track.config",
        "calibrate": "track.calibration.user_calibration",
        "load_user": "track.user",
        "open_sinks": "track.sinks.addresses",
        "open_source": "track.streams.addresses",
        "solve_pose": "track.kinematics.pose_solver",
        "track_capture": "track.capture_tracking",
        "track_stream": "track.capture_tracking",
    },
)

__all__ = [
    "LiveMessage",
    "StreamedFrame",
    "TrackedFrame",
    "Tracker",
    "TrackerConfig",
    "__version__",
    "calibrate",
    "load_user",
    "open_sinks",
    "open_source",
    "solve_pose",
    "track_capture",
    "track_stream",
]
