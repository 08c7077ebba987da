"""Training of the network for any layout: every batch holds new random layouts, none of them twice.

python -m train.any_layout.layout_training FOLDER [--steps N]

It writes `any_layout.safetensors` and its card `any_layout.json` into the folder, and goes on from the
checkpoint there. The figures of the shipped weights are in train/weights/README.md.
"""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, Int

from handsim.files.outputs import atomic_write
from handsim.hand.shape import PALM
from train.any_layout.layout_labeler import save_layout_network
from train.any_layout.layout_network import LayoutNetwork, LayoutNetworkConfig, distance_features, layout_loss
from train.any_layout.skin_bank import SkinBank, sample_skin_bank
from train.data.augmentation import Cloud, Corruption, corrupt
from train.data.batches import stretched
from train.threads import torch_threads

PLACES, PEOPLE = 480, 1600
_LAYOUTS, _CLOUDS = 8, 24  # of a batch; clouds of each layout
_MARKERS: Final = (5, 31)  # of a layout: least, and one more than most
_PEAK_RATE, _WARM_UP = 2e-3, 200  # learning rate; steps until it is reached
_STRETCH: Final = 0.03  # anisotropy of a hand
_JITTER: Final = 0.0015  # of a batch, at most [m]
_GAP: Final = (0.006, 0.014)  # least distance of two markers [m]
_HIDDEN: Final = 0.3  # share of batches in which neighbors are lost together
_HIDDEN_RADIUS: Final = 0.05  # [m]
_LEAST_SEEN: Final = 4  # markers
_CONFIG: Final = LayoutNetworkConfig()
_FEATURE_POSES: Final = 3000
_SAVED_EVERY, _TOLD_EVERY = 500, 100  # steps


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
        self._bones = bank.bones

    def draw(self) -> tuple[Cloud, Float[np.ndarray, "G M M K"]]:
        """Clouds [m] of some layouts with equally many markers, and what is known of each layout."""
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
        """Places of a random layout, evenly or unevenly over the bones, and not too near to each other."""
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
        """Most markers around a random one are lost, as behind another hand."""
        rng, (batch, count, _) = self._rng, markers.shape
        center = markers[np.arange(batch), rng.integers(count, size=batch)][:, None]
        radius = rng.uniform(0.0, _HIDDEN_RADIUS, size=(batch, 1))
        lost = (np.linalg.norm(markers - center, axis=-1) < radius) & (rng.random((batch, count)) < 0.8)
        lost[lost.sum(axis=1) > count - _LEAST_SEEN] = False
        return np.where(lost[..., None], np.nan, markers)


class LayoutTraining:
    """Network and optimizer of a run.

    Args:
        steps: Steps of the run.
    """

    def __init__(self, steps: int, config: LayoutNetworkConfig = _CONFIG) -> None:
        torch.manual_seed(0)
        self.steps, self.done = steps, 0
        self.network = LayoutNetwork(config)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=_PEAK_RATE, weight_decay=1e-4, fused=True
        )

    def step(self, cloud: Cloud, layouts: Float[np.ndarray, "G M M K"]) -> tuple[float, float]:
        """Make one gradient step; returns the loss before it, and the share of markers labeled right."""
        progress = self.done / self.steps
        rate = min(1.0, (self.done + 1) / _WARM_UP) * (0.01 + 0.495 * (1.0 + np.cos(np.pi * progress)))
        for group in self.optimizer.param_groups:
            group["lr"] = float(_PEAK_RATE * rate)
        points = torch.from_numpy(cloud.points.astype(np.float32))
        present, truth = torch.from_numpy(cloud.present), torch.from_numpy(cloud.truth)
        found = self.network(points, present, torch.from_numpy(layouts))
        loss = layout_loss(found, truth, present)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.done += 1
        markers = present & (truth >= 0)
        right = (found[-1].points.argmax(-1) == truth)[markers].float().mean()
        return float(loss.detach()), float(right)

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        buffer = io.BytesIO()
        torch.save(
            {
                "network": self.network.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "done": self.done,
            },
            buffer,
        )
        with atomic_write(path) as temporary:
            temporary.write_bytes(buffer.getbuffer())

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one."""
        if path.is_file():
            content: dict[str, Any] = torch.load(path, weights_only=True)
            self.network.load_state_dict(content["network"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.done = int(content["done"])


def main() -> None:
    """Train until the last step."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=9000, help=f"of {_LAYOUTS * _CLOUDS} clouds")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    training, checkpoint = LayoutTraining(options.steps), options.out / "checkpoint.pt"
    training.restore(checkpoint)
    bank = sample_skin_bank(PLACES, PEOPLE, rng=np.random.default_rng(11))
    batches = LayoutBatches(bank, np.random.default_rng([11, training.done]))
    figures, began = [], time.monotonic()
    with torch_threads(1):
        while training.done < options.steps:
            figures.append(training.step(*batches.draw()))
            if training.done % _TOLD_EVERY == 0:
                loss, right = np.mean(figures, axis=0)
                print(f"{training.done}: loss {loss:.3f}, {100.0 * right:.2f} % right, "
                      f"{time.monotonic() - began:.0f} s", flush=True)  # fmt: skip
                figures = []
            if training.done % _SAVED_EVERY == 0 or training.done == options.steps:
                training.save(checkpoint)
    save_layout_network(options.out, training.network, training.steps * _LAYOUTS * _CLOUDS)


if __name__ == "__main__":
    main()
