"""From unlabeled points to hand motion, online.

`track_capture` tracks the hands of a capture, and `label_capture` labels them frame by frame. A `Tracker`
takes one frame of points at a time and returns a `TrackedFrame`; `measure_hands` measures hands for it, and
`calibrate` fits hands and gloves to their user as a `User`. `open_source` opens a live stream, `ReplayServer`
plays a capture as one, `open_sinks` sends hands to other programs, and a `Recorder` writes the take.
`solve_pose` is the inverse kinematics alone: poses from labeled markers. `find_suspect_spans` lists the
doubtful frames of a take. `learn_glove` learns a glove from labeled captures, and `prove_glove` tries it on
the rest of them. `score_glove` and `improve_glove` judge and improve one by simulation.
"""

from typing import TYPE_CHECKING

from handsim import __version__ as __version__  # the first import: it warns about a package of the same name
from handsim._imports import lazy_exports

if TYPE_CHECKING:
    from gloves.takes.points import Status as Status
    from track.alternatives.alternatives import Alternative as Alternative
    from track.bodies.rigid_body import RigidTemplate as RigidTemplate
    from track.calibration.user_calibration import Calibration as Calibration
    from track.calibration.user_calibration import HeldOut as HeldOut
    from track.calibration.user_calibration import Touch as Touch
    from track.captures import calibrate as calibrate
    from track.captures import label_capture as label_capture
    from track.captures import measure_hands as measure_hands
    from track.captures import track_capture as track_capture
    from track.config import TrackerConfig as TrackerConfig
    from track.frames import StreamedFrame as StreamedFrame
    from track.frames import TrackedBody as TrackedBody
    from track.frames import TrackedFrame as TrackedFrame
    from track.frames import TrackedHand as TrackedHand
    from track.gloves.glove_improvement import ImprovedGlove as ImprovedGlove
    from track.gloves.glove_improvement import Worth as Worth
    from track.gloves.glove_improvement import improve_glove as improve_glove
    from track.gloves.glove_score import LayoutScore as LayoutScore
    from track.gloves.glove_score import Trial as Trial
    from track.gloves.glove_score import score_glove as score_glove
    from track.gloves.learned_glove import LearnedGlove as LearnedGlove
    from track.gloves.learned_glove import TrialHand as TrialHand
    from track.gloves.learned_glove import learn_glove as learn_glove
    from track.gloves.proof import Proof as Proof
    from track.gloves.proof import prove_glove as prove_glove
    from track.gloves.settings import LearnSettings as LearnSettings
    from track.kinematics.pose_solver import PoseFit as PoseFit
    from track.kinematics.pose_solver import solve_pose as solve_pose
    from track.kinematics.pose_spread import HandErrors as HandErrors
    from track.output.live_message import LiveBody as LiveBody
    from track.output.live_message import LiveHand as LiveHand
    from track.output.live_message import LiveHeader as LiveHeader
    from track.output.live_message import LiveMessage as LiveMessage
    from track.output.live_message import LiveSink as LiveSink
    from track.output.recorder import Recorder as Recorder
    from track.output.sinks import SinkGroup as SinkGroup
    from track.output.sinks import open_sinks as open_sinks
    from track.settings import CalibrateSettings as CalibrateSettings
    from track.settings import LabelSettings as LabelSettings
    from track.settings import TrackSettings as TrackSettings
    from track.streams import ReplaySettings as ReplaySettings
    from track.streams.frame_source import FrameSource as FrameSource
    from track.streams.live_stream import LiveStream as LiveStream
    from track.streams.live_stream import open_source as open_source
    from track.streams.natnet import ReplayServer as ReplayServer
    from track.takes.take_faults import SuspectSpan as SuspectSpan
    from track.takes.take_summary import find_suspect_spans as find_suspect_spans
    from track.tracker import Tracker as Tracker
    from track.user import User as User
    from track.user import load_user as load_user
    from train.forecast.settings import ImproveGloveSettings as ImproveGloveSettings
    from train.forecast.settings import ScoreGloveSettings as ScoreGloveSettings

__getattr__, __dir__ = lazy_exports(__name__)
