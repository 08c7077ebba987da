"""From unlabeled points to hand motion, online.

`track_capture` tracks the hands of a capture, and `label_capture` labels them frame by frame. A `Tracker`
takes one frame of points at a time and gives a `TrackedFrame`; `measure_hands` measures whom it follows, and
`calibrate` fits hands and gloves to them as a `User`. `open_source` opens a live stream, `ReplayServer` plays
a capture as one, `open_sinks` takes hands to other programs, and a `Recorder` writes the take. `solve_pose`
is the inverse kinematics alone: poses from labeled markers. `doubts_of` tells of a take,
`score_glove` and `improve_glove` of a glove that nobody has worn.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from gloves.takes.status import Status
    from track.bodies.rigid_body import RigidTemplate
    from track.calibration.user_calibration import Calibration, HeldOut, Touch
    from track.capture_calibration import calibrate
    from track.capture_labeling import label_capture
    from track.capture_tracking import track_capture
    from track.config import TrackerConfig
    from track.glove_advice.improvement import Worth
    from track.glove_advice.improving import ImprovedGlove, improve_glove
    from track.glove_advice.layout_score import LayoutScore
    from track.glove_advice.scoring import score_glove
    from track.glove_advice.trials import Trial
    from track.kinematics.pose_solver import PoseFit, solve_pose
    from track.recorder import Recorder
    from track.settings import TrackSettings
    from track.setup import measure_hands
    from track.sinks.addresses import SinkGroup, open_sinks
    from track.sinks.message import LiveBody, LiveHand, LiveHeader, LiveMessage, LiveSink
    from track.streams.addresses import open_source
    from track.streams.frame_source import StreamedFrame
    from track.streams.live_stream import LiveStream
    from track.streams.natnet_server import PointFrames, ReplayServer
    from track.take_summary import Doubt, doubts_of
    from track.tracked_frame import TrackedBody, TrackedFrame, TrackedHand
    from track.tracker import Tracker
    from track.user import User, load_user

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Calibration": "track.calibration.user_calibration",
        "Doubt": "track.take_summary",
        "HeldOut": "track.calibration.user_calibration",
        "ImprovedGlove": "track.glove_advice.improving",
        "LayoutScore": "track.glove_advice.layout_score",
        "LiveBody": "track.sinks.message",
        "LiveHand": "track.sinks.message",
        "LiveHeader": "track.sinks.message",
        "LiveMessage": "track.sinks.message",
        "LiveSink": "track.sinks.message",
        "LiveStream": "track.streams.live_stream",
        "PointFrames": "track.streams.natnet_server",
        "PoseFit": "track.kinematics.pose_solver",
        "Recorder": "track.recorder",
        "ReplayServer": "track.streams.natnet_server",
        "RigidTemplate": "track.bodies.rigid_body",
        "SinkGroup": "track.sinks.addresses",
        "Status": "gloves.takes.status",
        "StreamedFrame": "track.streams.frame_source",
        "Touch": "track.calibration.user_calibration",
        "TrackSettings": "track.settings",
        "TrackedBody": "track.tracked_frame",
        "TrackedFrame": "track.tracked_frame",
        "TrackedHand": "track.tracked_frame",
        "Tracker": "track.tracker",
        "TrackerConfig": "track.config",
        "Trial": "track.glove_advice.trials",
        "User": "track.user",
        "Worth": "track.glove_advice.improvement",
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
    },
)

__all__ = [
    "Calibration",
    "Doubt",
    "HeldOut",
    "ImprovedGlove",
    "LayoutScore",
    "LiveBody",
    "LiveHand",
    "LiveHeader",
    "LiveMessage",
    "LiveSink",
    "LiveStream",
    "PointFrames",
    "PoseFit",
    "Recorder",
    "ReplayServer",
    "RigidTemplate",
    "SinkGroup",
    "Status",
    "StreamedFrame",
    "Touch",
    "TrackSettings",
    "TrackedBody",
    "TrackedFrame",
    "TrackedHand",
    "Tracker",
    "TrackerConfig",
    "Trial",
    "User",
    "Worth",
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
]
