"""A wrong type for any argument of any public function ends in one sentence that names the argument."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from typing import get_args, get_type_hints

import numpy as np
import pytest

from gloves import Capture
from handsim import HandModel, HandSimError
from train import Corruption, SimulateSettings

PACKAGES = ("handsim", "poses", "gloves", "train")
WRONG = (5, None, [1, 2], {"a": 1}, object(), 2.5, "no such thing", b"bytes", HandSimError)
RNG = np.random.default_rng(0)
QPOS = np.zeros((1, 27)) + np.eye(27)[3]
CAPTURE = Capture(("a",), np.zeros((1, 1, 3)) + 0.1, 100.0)


def flat(model: HandModel, num_poses: int, *, rng: np.random.Generator) -> np.ndarray:
    return np.zeros((num_poses, 20))


VALID: dict[str, dict[str, object]] = {
    "handsim.join_qpos": {"angles": np.zeros((1, 20))},
    "handsim.load_rig": {"rig": "six"},
    "handsim.look_at": {"position": (0, 0, 1), "target": (0, 0, 0)},
    "handsim.sample_shape": {"side": "right", "rng": RNG},
    "handsim.write_page": {"path": "page.html", "thing": None},
    "poses.load_gestures": {},
    "poses.sample_motion": {"model": "M", "duration": 0.1, "rng": RNG},
    "poses.sample_poses": {"model": "M", "num_poses": 1, "sampler": flat, "rng": RNG},
    "poses.validate": {"model": "M", "qpos": QPOS},
    "gloves.attach": {"layout": "tips8", "model": "M"},
    "gloves.load_layout": {"glove": "tips8"},
    "gloves.load_take": {"path": "gone.npz"},
    "gloves.read_capture": {"capture": CAPTURE},
    "gloves.write_capture": {"path": "out.trc", "capture": CAPTURE},
    "train.corrupt": {"markers": np.zeros((1, 5, 3)), "corruption": Corruption(), "rng": RNG},
    "train.evaluate_labeler": {"labeler": "dense19", "truth": np.zeros((1, 19, 3))},
    "train.evaluate_labels": {"labeled": CAPTURE, "truth": "gone.truth.npz"},
    "train.generate_dataset": {"out": "set", "glove": "tips8", "rig": "six", "num_frames": 10, "seed": 0},
    "train.load_labeler": {"glove": "dense19"},
    "train.measure_room": {"captures": CAPTURE},
    "train.plan_rig": {"cameras": 2, "room": (2.4, 1.8, 2.2), "glove": "tips8", "seed": 0},
    "train.room_like": {"captures": CAPTURE, "settings": SimulateSettings("free")},
    "train.score_rig": {"rig": "six", "glove": "tips8", "num_frames": 60, "seed": 0},
    "train.simulate_take": {"kind": "free", "glove": "tips8", "rig": "six", "num_frames": 2, "seed": 0},
    "train.train_labeler": {"dataset": "set", "out": "run"},
}  # fmt: skip
"""Public functions with arguments that would do; each is then exchanged for wrong ones."""


def functions() -> dict[str, object]:
    found = {}
    for package in PACKAGES:
        module = importlib.import_module(package)
        for name in module.__all__:
            if inspect.isfunction(getattr(module, name)):
                found[f"{package}.{name}"] = getattr(module, name)
    return found


def test_every_public_function_stands_in_the_table():
    assert sorted(functions()) == sorted(VALID)


CASES = [
    pytest.param(name, argument, wrong, id=f"{name}-{argument}-{type(wrong).__name__}")
    for name, valid in VALID.items()
    for argument in valid
    for wrong in WRONG
]


@pytest.mark.parametrize(("name", "argument", "wrong"), CASES)
def test_a_wrong_type_is_told_in_one_sentence(name, argument, wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function = functions()[name]
    default = default_of(function, argument)
    if wrong is default or (wrong is None and default is None):
        pytest.skip("the default")
    if is_right(name, argument, wrong):
        pytest.skip("a value that fits")
    with pytest.raises(HandSimError) as error:
        function(**{**VALID[name], argument: wrong})
    said = str(error.value)
    assert said and "\n" not in said, said
    assert not list(tmp_path.iterdir()), "nothing is written"


def default_of(function, argument: str) -> object:
    """The default of an argument, or of the field of settings that it stands for."""
    parameters = inspect.signature(function).parameters
    if argument in parameters:
        return parameters[argument].default
    settings, _ = get_args(get_type_hints(function)["settings"])
    return next(field.default for field in dataclasses.fields(settings) if field.name == argument)


def is_right(name, argument, wrong) -> bool:
    """Whether a value is a right one after all: numbers where numbers are wanted, any text for a folder."""
    number = isinstance(wrong, int | float)
    return (
        (number and argument in ("duration",))
        or (isinstance(wrong, int) and argument in ("num_poses", "num_frames", "seed", "every", "cameras"))
        or (isinstance(wrong, str) and argument == "out")
        or (argument == "path" and name == "gloves.load_take" and isinstance(wrong, str))
    )
