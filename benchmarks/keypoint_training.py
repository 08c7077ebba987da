"""The network of `keypoint_network.py`: pictures to learn from, training, photographs to be tried on.

PCK@0.1 is the share of keypoints that are found within a tenth of the longer side of their hand's box.

MediaPipe's keypoints are not ours: they lie a share of the way from each of ours to the one before it in its
finger, and from our wrist to the middle finger's knuckle. `SHARES` has the medians of what MediaPipe finds on
215 drawn hands, those of the fingers together; no photograph was used.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn
from torch.nn import functional

from handsim import HandModel
from poses import load_gestures, sample_poses
from render import RenderConfig, RenderedFrame, ViewConfig
from render.film.network import Residual, convolution
from render.film.training import BF16
from render.session import Drawing
from render.subject import subject_of_poses

SIZE = 128  # of a crop [px]
HEAT = 16  # cells of a heat map, each way
SPREAD = 0.06  # of the heat around a keypoint [share of the side]
NEAR = 0.2  # of the heat that a keypoint is the mean of, around the peak [share of the side]
VIEW = ViewConfig(placement="orbit", distance=(0.45, 0.8))
CONFIG = RenderConfig(passes=("rgb", "ids"), view=VIEW, vary="frame", frames_per_shard=8)


class Pictures(NamedTuple):
    """Square crops around hands, and the keypoints in them."""

    crops: np.ndarray
    """(N, 160, 160, 3) sRGB, as `draw` cuts them: wider than the network sees."""
    points: np.ndarray
    """(N, 21, 2) [px]."""
    sizes: np.ndarray
    """Longer side of each hand's box (N,) [px]."""


WIDE = 160  # of a stored crop [px]
BEFORE = np.array([9, 0, 1, 2, 3, 0, 5, 6, 7, 0, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19])
FINGER = (0.0, 0.06, 0.17, 0.32)
SHARES = np.array([0.09, 0.0, 0.18, 0.33, 0.41, *FINGER, *FINGER, *FINGER, *FINGER])
MEDIAPIPE = np.eye(21) + SHARES[:, None] * (np.eye(21)[BEFORE] - np.eye(21))  # from our keypoints
A_PERSON = 10  # photographs in a row, one of each digit
LABELED_SHARE = 0.25  # of the samples, as `PictureStream` has it


def some_poses(count: int, rng: np.random.Generator) -> np.ndarray:
    """Poses (T, 27): half random ones, half named gestures, a little changed; fingers point up mostly."""
    model = HandModel.named("M")
    qpos = sample_poses(model, count, rng=rng)
    gestures = list(load_gestures().values())
    for row in np.flatnonzero(rng.random(count) < 0.5):
        angles = gestures[rng.integers(len(gestures))] + rng.normal(0.0, np.deg2rad(4.0), 20)
        qpos[row, 7:] = np.clip(angles, *model.skeleton.ranges.T)
    up = Rotation.from_euler("y", -90.0, degrees=True)  # fingers lie along the wrist's x
    tilt = Rotation.from_rotvec(np.deg2rad(30.0) * rng.normal(size=(count, 3)) * [1.0, 1.0, 0.0])
    turned = Rotation.from_euler("z", rng.uniform(0.0, 360.0, (count, 1)), degrees=True) * tilt * up
    qpos[:, :3] = 0.0
    qpos[:, 3:7] = turned.as_quat()[:, [3, 0, 1, 2]]
    return qpos


def frames(count: int, rng: np.random.Generator, config: RenderConfig) -> Iterator[RenderedFrame]:
    """Right hands, then left hands, of another person every few pictures, seen from everywhere."""
    for side in ("right", "left"):
        qpos, step = some_poses(count // 2, rng), config.frames_per_shard
        person = np.arange(len(qpos)) // step
        model = HandModel.named("M", side=side)
        subject = subject_of_poses(
            qpos, model=model, people=len(qpos), person=person, glove="dense19", seed=config.seed
        )
        drawing = Drawing(subject, config.resolved())
        for shard, chosen in enumerate(drawing.shards()):
            yield from drawing.frames(shard, enumerate(chosen))


def draw(count: int, seed: int, config: RenderConfig = CONFIG) -> Pictures:
    """Draw hands of many people from everywhere, and cut them out."""
    rng, found = np.random.default_rng(seed), []
    for frame in frames(count, rng, replace(config, seed=seed)):
        picture = frame.rgb if frame.noisy.rgb is None else frame.noisy.rgb
        found.append(cut_out(picture, frame.hands[0].keypoints, rng))
    return Pictures(*(np.stack(values) for values in zip(*found, strict=True)))


def cut_out(picture: np.ndarray, pixels: np.ndarray, rng: np.random.Generator) -> tuple:
    """A square around a hand with room for shifts and turns."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    side = (high - low).max() * rng.uniform(1.5, 2.4)
    scale = WIDE / side
    matrix = np.array([[scale, 0.0, 0.0], [0.0, scale, 0.0]])
    matrix[:, 2] = WIDE / 2 - scale * (low + high) / 2
    crop = cv2.warpAffine(np.ascontiguousarray(picture), matrix, (WIDE, WIDE), borderMode=cv2.BORDER_REFLECT)
    points = pixels @ matrix[:, :2].T + matrix[:, 2]
    return crop, points, float(np.ptp(points, axis=0).max())


def batches(
    pictures: Pictures, size: int, rng: np.random.Generator, labeled: Pictures | None = None
) -> Iterator[tuple]:
    """Endless batches: turned, shifted, scaled, mirrored, in other colors; labeled photographs among them."""
    while True:
        images, targets = [], []
        for _ in range(size):
            drawn = labeled is None or rng.random() >= LABELED_SHARE
            source = pictures if drawn else labeled
            number = rng.integers(len(source.crops))
            turn, scale = rng.uniform(-40.0, 40.0), rng.uniform(0.75, 1.15)
            matrix = cv2.getRotationMatrix2D((WIDE / 2, WIDE / 2), turn, scale)
            matrix[:, 2] += rng.uniform(-10.0, 10.0, 2) - (WIDE - SIZE) / 2
            image = cv2.warpAffine(source.crops[number], matrix, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT)
            points = source.points[number] @ matrix[:, :2].T + matrix[:, 2]
            if rng.random() < 0.5:
                image, points = image[:, ::-1], [SIZE - 1, 0] + points * [-1, 1]
            image = image * rng.uniform(0.7, 1.3, 3) * rng.uniform(0.8, 1.2) + rng.uniform(-15.0, 15.0)
            if rng.random() < 0.5:
                image = cv2.GaussianBlur(np.ascontiguousarray(image), (5, 5), rng.uniform(0.3, 1.5))
            images.append(np.clip(image, 0.0, 255.0))
            targets.append(points)
        yield to_input(np.stack(images)), torch.from_numpy(np.stack(targets).astype(np.float32)) / SIZE


def to_input(images: np.ndarray) -> torch.Tensor:
    """Pictures (B, 128, 128, 3) as a tensor (B, 3, 128, 128), each of mean 0 and deviation 1."""
    tensor = torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2), dtype=np.float32))
    tensor = (tensor - tensor.mean((1, 2, 3), keepdim=True)) / (tensor.std((1, 2, 3), keepdim=True) + 1.0)
    return tensor.to(memory_format=torch.channels_last)


class KeypointNetwork(nn.Module):
    """Heat maps of 21 keypoints; a keypoint is the mean place of its map around the peak."""

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        w = width
        self.fine = nn.Sequential(
            *(nn.Conv2d(3, w, 8, 4, 2, bias=False), nn.BatchNorm2d(w), nn.ReLU(), Residual(w)),
            *(*convolution(w, 2 * w, 2), Residual(2 * w), Residual(2 * w)),
        )
        self.coarse = nn.Sequential(
            *(*convolution(2 * w, 4 * w, 2), Residual(4 * w), Residual(4 * w)),
            *(*convolution(4 * w, 8 * w, 2), Residual(8 * w), Residual(8 * w)),
            nn.Conv2d(8 * w, 2 * w, 1),
        )
        self.head = nn.Sequential(*convolution(4 * w, 4 * w), Residual(4 * w), nn.Conv2d(4 * w, 21, 1))
        at = (torch.arange(HEAT) + 0.5) / HEAT
        self.register_buffer(
            "places", torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Keypoints (B, 21, 2) of pictures (B, 3, 128, 128), shares of the side.

        A map that is torn between two fingers has its mean between them; the higher peak is one of them.
        """
        heat = self.heat(x)
        peaks = self.places[heat.argmax(dim=2)]
        is_far = torch.cdist(peaks, self.places.expand(len(x), -1, -1)) > NEAR
        return heat.masked_fill(is_far, -torch.inf).softmax(dim=2) @ self.places

    def loss(self, x: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """How little of the heat is near the keypoints, and how far its mean is from them."""
        heat = self.heat(x)
        near = torch.exp(-(torch.cdist(points, self.places.expand(len(x), -1, -1)) ** 2) / (2 * SPREAD**2))
        near = near / near.sum(dim=2, keepdim=True).clamp(min=1e-6)
        found = heat.softmax(dim=2) @ self.places
        return -(near * heat.log_softmax(dim=2)).sum(dim=2).mean() + 10.0 * (found - points).abs().mean()

    def heat(self, x: torch.Tensor) -> torch.Tensor:
        """Heat (B, 21, cells) before it is made a share of 1."""
        with torch.autocast("cpu", torch.bfloat16, enabled=BF16):
            fine = self.fine(x)
            coarse = functional.interpolate(self.coarse(fine), size=HEAT, mode="bilinear")
            heat = self.head(torch.cat([fine, coarse], dim=1))
        return heat.flatten(2).float()


def train(
    pictures: Pictures, samples: int, seed: int = 0, labeled: Pictures | None = None, batch: int = 64
) -> KeypointNetwork:
    """Train a network on pictures, and on labeled photographs where there are any."""
    torch.manual_seed(seed)
    network = KeypointNetwork().to(memory_format=torch.channels_last)
    steps = max(1, samples // batch)
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=0.01, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps + 1)
    source, start, mean = batches(pictures, batch, np.random.default_rng(seed), labeled), time.time(), 0.0
    for step in range(1, steps + 1):
        images, targets = next(source)
        loss = network.loss(images, targets)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        mean += (loss.item() - mean) / min(step, 200)
        if step % max(1, steps // 10) == 0:
            seconds = time.time() - start
            print(f"{step * batch} samples, loss {mean:.2f}, {seconds:.0f} s")
    return network.eval()


@torch.inference_mode()
def find(network: KeypointNetwork, pictures: np.ndarray) -> np.ndarray:
    """Keypoints (N, 21, 2) in pictures (N, 128, 128, 3) [px]."""
    parts = [pictures[first : first + 64] for first in range(0, len(pictures), 64)]
    return SIZE * np.concatenate([network(to_input(part)).numpy() for part in parts])


def load_photos(folder: Path, reference: Path) -> Pictures:
    """Photographs that the reference is sure of, as the network sees them, as they were taken."""
    entries = {name: one for name, one in json.loads(reference.read_text()).items() if one["score"] > 0.9}
    crops, points, sizes = [], [], []
    for name, one in sorted(entries.items(), key=lambda entry: Path(entry[0]).name):
        image = cv2.imread(str(folder / name))[..., ::-1]
        scale = SIZE / max(image.shape[:2])
        crops.append(cv2.resize(np.ascontiguousarray(image), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC))
        points.append(scale * np.array(one["points"]))
        sizes.append(np.ptp(points[-1], axis=0).max())
    return Pictures(np.stack(crops), np.stack(points), np.array(sizes))


def split(photos: Pictures, count: int) -> tuple[Pictures, Pictures]:
    """About so many photographs of some people, evenly taken from all, and those of others.

    People were photographed one after the other, ten times each but for a few: nine of ten blocks of ten show
    two people, so the blocks before and after those that are taken are left out.
    """
    block = np.arange(len(photos.crops)) // A_PERSON
    taken = np.linspace(0, block[-1], count // A_PERSON + 2)[1:-1].round()
    away = np.abs(block[:, None] - taken).min(axis=1, initial=np.inf)
    return (
        Pictures(*(values[away == 0] for values in photos)),
        Pictures(*(values[away > 1] for values in photos)),
    )


def pck(found: np.ndarray, pictures: Pictures) -> float:
    """PCK@0.1 of keypoints (N, 21, 2)."""
    off = np.linalg.norm(found - pictures.points, axis=2)
    return float((off < 0.1 * pictures.sizes[:, None]).mean())


def labeled_as_ours(photos: Pictures) -> Pictures:
    """Photographs with MediaPipe's keypoints as stored crops with ours."""
    edge = (WIDE - SIZE) // 2
    wide = [cv2.copyMakeBorder(crop, *(4 * [edge]), cv2.BORDER_REFLECT) for crop in photos.crops]
    return Pictures(np.stack(wide), np.linalg.inv(MEDIAPIPE) @ photos.points + edge, photos.sizes)


def middle_of(pictures: Pictures) -> Pictures:
    """What the network sees of stored crops."""
    edge = (WIDE - SIZE) // 2
    return Pictures(pictures.crops[:, edge:-edge, edge:-edge], pictures.points - edge, pictures.sizes)
