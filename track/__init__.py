"""From unlabeled points to hand motion, online.

`track_capture` tracks the hands of a capture, and `label_capture` labels them frame by frame. A `Tracker`
takes one frame of points at a time and gives a `TrackedFrame`; `measure_hands` measures whom it follows, and
`calibrate` fits hands and gloves to them as a `User`. `open_source` opens a live stream, `ReplayServer` plays
a capture as one, `open_sinks` takes hands to other programs, and a `Recorder` writes the take. `solve_pose`
is the inverse kinematics alone: poses from labeled markers. `doubts_of` and `write_take_page` tell of a take,
`score_glove` and `improve_glove` of a glove that nobody has worn.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from track.capture_calibration import calibrate
    from track.capture_labeling import label_capture
    from track.capture_tracking import track_capture
    from track.config import TrackerConfig
    from track.glove_advice.improving import improve_glove
    from track.glove_advice.scoring import score_glove
    from track.kinematics.pose_solver import solve_pose
    from track.recorder import Recorder
    from track.reports.take_page import write_take_page
    from track.setup import measure_hands
    from track.sinks.addresses import open_sinks
    from track.sinks.message import LiveMessage
    from track.streams.addresses import open_source
    from track.streams.frame_source import StreamedFrame
    from track.streams.natnet_server import ReplayServer
    from track.take_summary import doubts_of
    from track.tracked_frame import TrackedFrame
    from track.tracker import Tracker
    from track.user import User, load_user

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "LiveMessage": "track.sinks.message",
        "Recorder": "track.recorder",
        "ReplayServer": "track.streams.natnet_server",
        "StreamedFrame": "track.streams.frame_source",
        "TrackedFrame": "track.tracked_frame",
        "Tracker": "track.tracker",
        "TrackerConfig": "track.config",
        "User": "track.user",
        "calibrate": "track.capture_calibration",
        "doubts_of": "track.take_summary",
        "improve_glove": "track.glove_advice.improving",
        "label_capture": "track.capture_labeling",
        "load_user": "track.user",
        "measure_hands": "track.setup",
        "open_sinks": "track.sinks.addresses",
        "open_source": "track.streams.addresses",
        "score_glove": "track.glove_advice.scoring",
        "solve_pose": "track.kinematics.pose_solver",
        "track_capture": "track.capture_tracking",
        "write_take_page": "track.reports.take_page",
    },
)

__all__ = [
    "LiveMessage",
    "Recorder",
    "ReplayServer",
    "StreamedFrame",
    "TrackedFrame",
    "Tracker",
    "TrackerConfig",
    "User",
    "__version__",
    "calibrate",
    "doubts_of",
    "improve_glove",
    "label_capture",
    "load_user",
    "measure_hands",
    "open_sinks",
    "open_source",
    "score_glove",
    "solve_pose",
    "track_capture",
    "write_take_page",
]
