"""Takes whose numbers somebody altered are refused in one sentence, or exported without a warning."""

from __future__ import annotations

import contextlib
import json
import warnings

import numpy as np
import pytest

from gloves.takes.take import Take, load_take
from handsim.errors import CaptureError, HandSimError
from handsim.hand.shape import HAND_DTYPE
from train.simulation.takes import simulate_take

VALUES = (np.nan, np.inf, 0.0, 1e-200, 1e200, -1.0, 100.0)
FRAMES = ("qpos", "body_poses", "points", "times", "body_markers", "attachment_normals")
SHAPES = [name for name in HAND_DTYPE.names if name != "left"]


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take("hand-controller", num_frames=5)


def refused_or_exported(folder, arrays) -> None:
    np.savez(folder / "altered.npz", **arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with contextlib.suppress(HandSimError):
            take = load_take(folder / "altered.npz")
            for ending in (".glb", ".bvh", ".mot", ".openxr.json"):
                take.export(folder / f"altered{ending}")


@pytest.fixture
def arrays(take, tmp_path):
    take.save(tmp_path / "take.npz")
    return dict(np.load(tmp_path / "take.npz"))


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", SHAPES)
def test_hands(arrays, tmp_path, name, value):
    arrays["hands"][name][0] = value
    refused_or_exported(tmp_path, arrays)


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", FRAMES)
def test_frames(arrays, tmp_path, name, value):
    arrays[name][-1] = value
    refused_or_exported(tmp_path, arrays)


@pytest.mark.parametrize("rate", [1e-300, 1e-3, 1e9, 1e300])
def test_rates(arrays, tmp_path, rate):
    header = json.loads(str(arrays["header"])) | {"rate": rate}
    arrays["header"] = np.array(json.dumps(header))
    refused_or_exported(tmp_path, arrays)


@pytest.mark.parametrize("name", ["qpos", "body_poses"])
def test_orientations_have_unit_length(arrays, tmp_path, name):
    arrays[name][..., 3:7] *= 1.000001  # as rounded
    np.savez(tmp_path / "rounded.npz", **arrays)
    load_take(tmp_path / "rounded.npz")
    arrays[name][..., 3:7] *= 1e-200
    np.savez(tmp_path / "tiny.npz", **arrays)
    with pytest.raises(CaptureError, match=r"tiny\.npz: not a take, or a damaged one"):
        load_take(tmp_path / "tiny.npz")
