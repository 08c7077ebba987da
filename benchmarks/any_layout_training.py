"""Training of the network for any layout, with new random layouts in every batch.

python -m benchmarks.any_layout_training FOLDER [--steps N]

A layout is a choice among many places on the skin, whose positions in many poses of many people are sampled
once. The run writes `any_layout.safetensors` and its card `any_layout.json` into the folder. The figures of
the shipped weights are in train/weights/README.md.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Float16, Int

from benchmarks.record import run
from gloves.fit import wear
from gloves.layout import MOST_MARKERS, MarkerLayout, MarkerPlace
from handsim import __version__
from handsim.errors import LayoutError
from handsim.files.outputs import atomic_write, save_json, written_together
from handsim.hand.shape import BONE_NAMES, PALM, SIDES
from handsim.space.objects import MARKER_RADIUS
from handsim.space.transforms import MIRROR
from track.glove_improvement import sample_places
from train.data.batches import Cloud, Corruption, corrupt, stretched
from train.labelers.layout_labeler import WEIGHTS, layout_step, new_optimizer
from train.labelers.networks import LayoutNetwork, LayoutNetworkConfig, distance_features
from train.labelers.protocol import torch_threads
from train.simulation.training_frames import GenerateSettings, sample_frame_scene, sample_hands

_POSES_PER_PERSON: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class SkinBank:
    """Places on the back and the sides of right hands, and their positions in random poses."""

    places: tuple[MarkerPlace, ...]
    positions: Float16[np.ndarray, "T C 3"]
    """Positions around their mean [m]; left hands are mirrored."""

    def mean_distances(self, num_poses: int = 1000) -> Float[np.ndarray, "C C"]:
        """Mean distance between every two places [m], over some poses."""
        some = self.positions[:: max(1, len(self.positions) // num_poses)].astype(np.float32)
        total = np.zeros((len(self.places), len(self.places)), dtype=np.float32)
        for points in some:
            total += np.linalg.norm(points[:, None] - points, axis=-1)
        return total / len(some)


def sample_skin_bank(num_places: int, num_people: int, *, rng: np.random.Generator) -> SkinBank:
    """Places, and their positions in up to 64 poses of each random person, with one slip of each marker."""
    places = sample_places(num_places, rng=rng)
    gloves = [
        MarkerLayout("places", places[first : first + MOST_MARKERS], MARKER_RADIUS)
        for first in range(0, len(places), MOST_MARKERS)
    ]
    parts: list[Float16[np.ndarray, "T C 3"]] = []
    while len(parts) < num_people:
        positions = _positions(gloves, rng)
        if positions is not None:
            parts.append(positions)
    return SkinBank(places, np.concatenate(parts))


def _positions(gloves: list[MarkerLayout], rng: np.random.Generator) -> Float16[np.ndarray, "T C 3"] | None:
    """Positions of all places on a random person in some poses; None if a place is off the skin."""
    config = GenerateSettings()
    models = sample_hands(config.population, rng=rng)
    scene = sample_frame_scene(models, _POSES_PER_PERSON, config, rng=rng)
    model = scene.hands[0]
    bones = model.forward_kinematics(scene.qpos[0])
    slip, roll = config.slip_along, np.deg2rad(config.slip_around)
    try:
        worn = [wear(glove, model, along=slip, around=roll, rng=rng) for glove in gloves]
    except LayoutError:
        return None
    points = np.concatenate([one.centers(model, bones) for one in worn], axis=1)
    if model.shape.side == SIDES[0]:
        points = points @ MIRROR
    centered: Float16[np.ndarray, "T C 3"] = (points - points.mean(axis=1, keepdims=True)).astype(np.float16)
    return centered


PLACES, PEOPLE = 480, 1600
_LAYOUTS, _CLOUDS = 8, 24  # layouts in a batch; clouds of each layout
_MARKERS: Final = (5, 31)  # range of the number of markers; the upper end is excluded
_WARM_UP: Final = 200  # steps until the peak learning rate is reached
_STRETCH: Final = 0.03  # anisotropy of a hand
_JITTER: Final = 0.0015  # largest jitter of a batch [m]
_GAP: Final = (0.006, 0.014)  # range of the least distance between two markers [m]
_HIDDEN: Final = 0.3  # share of batches in which neighbors are lost together
_HIDDEN_RADIUS: Final = 0.05  # largest radius in which they are lost [m]
_MIN_SEEN: Final = 4  # markers of a cloud that are never lost so
_CONFIG: Final = LayoutNetworkConfig()
_FEATURE_POSES: Final = 3000
_TOLD_EVERY: Final = 100  # steps


class LayoutBatches:
    """Draws random layouts on a bank of places, and corrupted clouds of them."""

    def __init__(self, bank: SkinBank, rng: np.random.Generator) -> None:
        self._bank, self._rng = bank, rng
        self._spacing = bank.mean_distances()
        some = bank.positions[:: max(1, len(bank.positions) // _FEATURE_POSES)].astype(np.float32)
        total = torch.zeros(len(bank.places), len(bank.places), _CONFIG.num_distances)
        for points in some:
            total += distance_features(torch.from_numpy(points)[None], _CONFIG)[0]
        self._features = (total / len(some)).numpy().astype(np.float16)
        self._bones = np.array([BONE_NAMES.index(place.bone) for place in bank.places])

    def draw(self) -> tuple[Cloud, Float[np.ndarray, "G M M K"]]:
        """Clouds [m] of layouts with equally many markers, and the mean distance features of each layout."""
        rng = self._rng
        count = int(rng.integers(*_MARKERS))
        layouts = [self._layout(count) for _ in range(_LAYOUTS)]
        frames = rng.integers(len(self._bank.positions), size=(_LAYOUTS, _CLOUDS))
        markers = np.concatenate(
            [
                self._bank.positions[rows][:, layout].astype(np.float64)
                for rows, layout in zip(frames, layouts, strict=True)
            ]
        )
        markers = stretched(markers, _STRETCH, rng=rng)
        if rng.random() < _HIDDEN:
            markers = self._hide_neighbors(markers)
        occlude = (0, round(count / 4), round(count / 4), round(count / 3))[int(rng.integers(4))]
        ghosts = (0, 2, 2, 3)[int(rng.integers(4))]
        cloud = corrupt(markers, Corruption(occlude, ghosts, _JITTER * rng.uniform()), rng=rng)
        return cloud, np.array([self._features[np.ix_(layout, layout)] for layout in layouts], np.float32)

    def _layout(self, count: int) -> Int[np.ndarray, "M"]:
        """Places of a random layout, spread evenly or unevenly over the bones, with a gap between them."""
        rng, bones = self._rng, self._bones
        while True:
            share = rng.dirichlet(np.full(bones.max() + 1, rng.choice([0.3, 1.0, 4.0])))
            share[PALM] *= rng.uniform(1.0, 6.0)
            weight = np.maximum((share / np.maximum(np.bincount(bones), 1))[bones], 1e-9)
            gap = rng.uniform(*_GAP)
            chosen: list[int] = []
            for place in rng.choice(len(bones), len(bones), replace=False, p=weight / weight.sum()):
                if all(self._spacing[place, other] > gap for other in chosen):
                    chosen.append(int(place))
                if len(chosen) == count:
                    return np.array(chosen)

    def _hide_neighbors(self, markers: Float[np.ndarray, "B M 3"]) -> Float[np.ndarray, "B M 3"]:
        """Clouds [m] without most markers around a random one, as if another hand hid them."""
        rng, (batch, count, _) = self._rng, markers.shape
        center = markers[np.arange(batch), rng.integers(count, size=batch)][:, None]
        radius = rng.uniform(0.0, _HIDDEN_RADIUS, size=(batch, 1))
        lost = (np.linalg.norm(markers - center, axis=-1) < radius) & (rng.random((batch, count)) < 0.8)
        lost[lost.sum(axis=1) > count - _MIN_SEEN] = False
        return np.where(lost[..., None], np.nan, markers)


class LayoutTraining:
    """The state of a training run."""

    def __init__(self, steps: int, config: LayoutNetworkConfig = _CONFIG) -> None:
        torch.manual_seed(0)
        self.steps, self.done = steps, 0
        self.network = LayoutNetwork(config)
        self.optimizer = new_optimizer(self.network)

    def step(self, cloud: Cloud, layouts: Float[np.ndarray, "G M M K"]) -> tuple[float, float]:
        """Make a gradient step, and return the loss and the share of markers labeled right before it."""
        progress = self.done / self.steps
        rate = min(1.0, (self.done + 1) / _WARM_UP) * (0.01 + 0.495 * (1.0 + np.cos(np.pi * progress)))
        loss, scores = layout_step(self.network, self.optimizer, rate, cloud, torch.from_numpy(layouts))
        self.done += 1
        markers = torch.from_numpy(cloud.present & (cloud.truth >= 0))
        right = (scores.argmax(-1) == torch.from_numpy(cloud.truth))[markers].float().mean()
        return loss, float(right)


def save_layout_network(folder: Path, network: LayoutNetwork, num_clouds: int) -> None:
    """Write the network in half precision, and its card."""
    from safetensors.torch import save

    tensors = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    card = {
        "network": dataclasses.asdict(network.config),
        "clouds": num_clouds,
        "trained_on": "simulated poses in random layouts",
        "handsim": __version__,
        "license": "apache-2.0",
    }
    with written_together():
        with atomic_write(folder / WEIGHTS) as temporary:
            temporary.write_bytes(save(tensors))
        save_json(folder / "any_layout.json", card)


def main(out: Path, steps: int = 9000) -> None:
    """Train until the last step, and write the network into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    training = LayoutTraining(steps)
    bank = sample_skin_bank(PLACES, PEOPLE, rng=np.random.default_rng(11))
    batches = LayoutBatches(bank, np.random.default_rng([11, 0]))
    figures, began = [], time.monotonic()
    with torch_threads(1):
        while training.done < steps:
            figures.append(training.step(*batches.draw()))
            if training.done % _TOLD_EVERY == 0:
                loss, right = np.mean(figures, axis=0)
                print(f"{training.done}: loss {loss:.3f}, {100.0 * right:.2f} % right, "
                      f"{time.monotonic() - began:.0f} s", flush=True)  # fmt: skip
                figures = []
    save_layout_network(out, training.network, steps * _LAYOUTS * _CLOUDS)


if __name__ == "__main__":
    run(main, __doc__)
