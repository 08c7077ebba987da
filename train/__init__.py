"""From simulated captures to a trained labeler.

`generate_dataset` writes a training set, `train_labeler` trains a network on it, `load_labeler` reads a
shipped or trained one, `evaluate_labeler` counts its errors. `simulate_take` simulates a capture with its
truth. `score_rig` and `plan_rig` forecast what cameras see before they are mounted.
"""

import os
from typing import TYPE_CHECKING

from handsim import __version__ as __version__  # the first import: it warns about a package of the same name
from handsim._imports import lazy_exports

if TYPE_CHECKING:
    from train.data.batches import Cloud as Cloud
    from train.data.batches import Corruption as Corruption
    from train.data.batches import OwnCorruption as OwnCorruption
    from train.data.batches import corrupt as corrupt
    from train.data.cloud_stream import CloudStream as CloudStream
    from train.data.shards import Dataset as Dataset
    from train.data.shards import MappedRows as MappedRows
    from train.evaluation import LabelingReport as LabelingReport
    from train.evaluation import evaluate_labeler as evaluate_labeler
    from train.evaluation import evaluate_labels as evaluate_labels
    from train.forecast.rig_forecast import CameraLoss as CameraLoss
    from train.forecast.rig_forecast import ErrorEllipsoid as ErrorEllipsoid
    from train.forecast.rig_forecast import Forecast as Forecast
    from train.forecast.rig_plan import RigPlan as RigPlan
    from train.forecast.rig_plan import plan_rig as plan_rig
    from train.forecast.rig_score import RigScore as RigScore
    from train.forecast.rig_score import VolumeMap as VolumeMap
    from train.forecast.rig_score import score_rig as score_rig
    from train.forecast.settings import PlanRigSettings as PlanRigSettings
    from train.forecast.settings import ScoreRigSettings as ScoreRigSettings
    from train.labelers.protocol import Labeler as Labeler
    from train.labelers.protocol import Labeling as Labeling
    from train.labelers.storage import load_labeler as load_labeler
    from train.loop import train_labeler as train_labeler
    from train.settings import CNNConfig as CNNConfig
    from train.settings import EvaluateSettings as EvaluateSettings
    from train.settings import SetLabelerConfig as SetLabelerConfig
    from train.settings import TrainSettings as TrainSettings
    from train.simulation.generation import generate_dataset as generate_dataset
    from train.simulation.measured_room import MeasuredRoom as MeasuredRoom
    from train.simulation.measured_room import measure_room as measure_room
    from train.simulation.room import OpticsOptions as OpticsOptions
    from train.simulation.room import StrayOptions as StrayOptions
    from train.simulation.room_like import RoomLike as RoomLike
    from train.simulation.room_like import room_like as room_like
    from train.simulation.takes import SimulateSettings as SimulateSettings
    from train.simulation.takes import simulate_take as simulate_take
    from train.simulation.training_frames import GenerateSettings as GenerateSettings
    from train.simulation.training_frames import SceneMix as SceneMix

__getattr__, __dir__ = lazy_exports(__name__)

# Threads of torch that wait for one another sleep: spinning takes nearly half of the cores' time from
# training and from others. It holds for a torch that is loaded from here on.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
