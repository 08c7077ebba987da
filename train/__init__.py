"""From simulated captures to a trained labeler.

`generate_dataset` writes a training set, `train_labeler` trains a network on it, `load_labeler` reads a
shipped or trained one, `evaluate_labeler` counts its errors. `simulate_take` simulates a capture with its
truth. `score_rig` and `plan_rig` tell of cameras before they hang.
"""

import os
from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from train.config import CNNConfig, SetLabelerConfig, TrainConfig
    from train.data.augmentation import Cloud, Corruption, corrupt
    from train.data.cloud_stream import CloudStream
    from train.data.own_corruption import OwnCorruption
    from train.data.shards import Dataset, MappedRows
    from train.evaluate import evaluate_labeler
    from train.glove_labeler import load_labeler
    from train.labeler_evaluation import Report
    from train.labelers.protocol import Labeler, Labeling
    from train.loop import train_labeler
    from train.rig_advice.forecast import CameraLoss, ErrorEllipsoid, Forecast
    from train.rig_advice.planning import RigPlan, plan_rig
    from train.rig_advice.rig_score import RigScore, VolumeMap
    from train.rig_advice.scoring import score_rig
    from train.simulation.generation import generate_dataset
    from train.simulation.takes import simulate_take

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "CNNConfig": "train.config",
        "CameraLoss": "train.rig_advice.forecast",
        "Cloud": "train.data.augmentation",
        "CloudStream": "train.data.cloud_stream",
        "Corruption": "train.data.augmentation",
        "Dataset": "train.data.shards",
        "ErrorEllipsoid": "train.rig_advice.forecast",
        "Forecast": "train.rig_advice.forecast",
        "Labeler": "train.labelers.protocol",
        "Labeling": "train.labelers.protocol",
        "MappedRows": "train.data.shards",
        "OwnCorruption": "train.data.own_corruption",
        "Report": "train.labeler_evaluation",
        "RigPlan": "train.rig_advice.planning",
        "RigScore": "train.rig_advice.rig_score",
        "SetLabelerConfig": "train.config",
        "TrainConfig": "train.config",
        "VolumeMap": "train.rig_advice.rig_score",
        "corrupt": "train.data.augmentation",
        "evaluate_labeler": "train.evaluate",
        "generate_dataset": "train.simulation.generation",
        "load_labeler": "train.glove_labeler",
        "plan_rig": "train.rig_advice.planning",
        "score_rig": "train.rig_advice.scoring",
        "simulate_take": "train.simulation.takes",
        "train_labeler": "train.loop",
    },
)

__all__ = [
    "CNNConfig",
    "CameraLoss",
    "Cloud",
    "CloudStream",
    "Corruption",
    "Dataset",
    "ErrorEllipsoid",
    "Forecast",
    "Labeler",
    "Labeling",
    "MappedRows",
    "OwnCorruption",
    "Report",
    "RigPlan",
    "RigScore",
    "SetLabelerConfig",
    "TrainConfig",
    "VolumeMap",
    "__version__",
    "corrupt",
    "evaluate_labeler",
    "generate_dataset",
    "load_labeler",
    "plan_rig",
    "score_rig",
    "simulate_take",
    "train_labeler",
]

# Threads of torch that wait for one another sleep: spinning takes nearly half of the cores' time from
# training and from others. It holds for a torch that is loaded from here on.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
