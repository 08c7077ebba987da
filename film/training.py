"""Trains the hand detector on drawn pictures and on labeled photographs of your own.

    python -m film.training OUT [--samples 192000 --seed 0] [--start FOLDER] [--photographs FILE]

OUT gets the weights that `HandDetector.load` reads.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import nn
from torch.nn import functional

from film.detector import (
    CELL,
    CROP_SIZE,
    FINDER,
    FINDER_SIZE,
    HEAT_SIZE,
    KEYPOINTS,
    ROOM,
    WEIGHTS,
    Candidate,
    HandDetector,
    cut,
    normalized,
    palm_spread,
    square_around,
    upright,
)
from film.network import FinderNetwork, KeypointNetwork
from handsim._checks import check_count
from handsim._plugins import import_extra
from handsim._process import torch_kept
from handsim._version import full_version
from handsim.files.models import DIGEST, stamp_model
from handsim.files.outputs import atomic_write
from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_KEYPOINTS, NUM_QPOS, SIDES
from poses import sample_poses
from render.config import RenderConfig
from render.formats.records import encode_jpeg
from render.frames import Bytes, Doubles, Floats
from render.photographs import read_photograph
from render.stream import LabeledHand, PictureStream, load_labeled_photographs

BATCH: Final = 32
BF16: Final = any(torch.cpu.get_capabilities().get(name) for name in ("amx_bf16", "avx512_bf16"))
_SAMPLES_A_SCENE: Final = 18  # number of squares that the keypoint network sees for each drawn picture
_FINDER_SHARE: Final = 0.5  # samples of the finder over those of the keypoint network
_HEAT_SPREAD: Final = 0.06  # spread of the heat around a keypoint [share of the side]
_RATE, _ADAPTING_RATE = 2e-3, 6e-4  # largest learning rates: from scratch, and from given weights
_TRAINING_SHARE: Final = 0.8  # share of the photographs that train a network; the others evaluate it
_EVALUATION_BATCHES: Final = 4  # number of batches of photographs that evaluate it
_SMALLEST_HAND: Final = 14.0  # [px] least longer side of a hand in the finder's input
_ASPECTS: Final = (0.75, 0.75, 0.5625, 1.0)  # shorter side of a picture over the longer one
_FIRST_LOOK_SHARE: Final = 0.35
"""Share of the squares that imitate the first look, half of them rotated at random; in others fingers point
up."""
_OPSET: Final = 17
_HALF: Final = "_half"  # suffix of the names of weights of half precision
VIEW_SIZE: Final = 320  # [px] longer side of a stored picture
SQUARE_SIZE: Final = 192  # [px] side of a stored square around a hand, with room to rotate and shift it
SQUARE_ROOM: Final = 2.4  # side of that square over the hand's longer side
SCENES: Final = 128  # number of pictures that are drawn together
_GLOVES: Final = ("dense19", "starter15", "sparse13", "starter30", "tips8", "dfki13", "starter10")
_CAMERAS: Final = ("vga", "vga_wide", "vga", "sr300", "kinect2", "d435")
_SITTING: Final = 16  # number of pictures of each person
_FEWEST_VISIBLE: Final = 4  # least number of visible keypoints of a hand that is learned
_EMPTY_SHARE: Final = 0.35  # share of the scenes that also give a square without a hand
_KEPT_BACKGROUND_SHARE: Final = 0.5
"""Share of the drawn pictures that keep their background although photographs could replace it."""
_DYED_SHARE: Final = 0.6  # share of the hands before a photograph that get a random color

Network = FinderNetwork | KeypointNetwork
Targets = tuple[torch.Tensor, ...]
Loss = Callable[[Any, Targets], torch.Tensor]
Batch = tuple[torch.Tensor, Targets]
"""Pictures (B, 3, S, S) and their targets for one training step."""


@torch_kept()
def train_detector(
    out: str | Path,
    *,
    start: str | Path | None = None,
    photographs: str | Path | None = None,
    samples: int = 192_000,
    seed: int = 0,
) -> Path:
    """Train a hand detector on drawn pictures.

    Args:
        out: Folder of the weights.
        start: Folder of weights to begin with, or `shipped`; random ones when not given.
        photographs: File of COCO keypoints [px] of your own photographs (21 a hand, in our order), which are
            beside it or in a folder `images` there. Half of the samples are then taken from them. About
            the last fifth by name is held out; a network that did better there before is left as it was.
            Images without an annotation are pictures without hands: candidates of the detector in them are
            learned as negatives, and half of the drawn hands are laid over them. If no image has a hand, the
            locations of keypoints are not trained.
        samples: Number of squares that the keypoint network learns from; the finder learns from half
            as many pictures.
        seed: Seed of pictures, of initial weights and of all random choices.

    Returns:
        The folder, for `HandDetector.load`.

    Raises:
        HandSimError: The start or the photographs cannot be read, or onnx is missing.
    """
    check_count("samples", samples, BATCH, 1_000_000_000)
    import_extra("onnx", "training a detector", "onnx")  # fails before the training, not after it
    torch.manual_seed(seed)
    networks: dict[str, Network] = {FINDER: FinderNetwork(), KEYPOINTS: KeypointNetwork()}
    candidates: Callable[[Bytes], list[Candidate]] = _no_candidates
    if start is not None:
        folder = WEIGHTS if start == "shipped" else Path(start)
        candidates = HandDetector.load(folder)._candidates  # refuses damaged weights
        for name, network in networks.items():
            _load_folded(network, folder / name)
    rng = np.random.default_rng(seed)
    all_own = lessons_of([] if photographs is None else read_scenes(Path(photographs)), candidates, rng=rng)
    ends = [math.ceil(_TRAINING_SHARE * len(some)) for some in all_own]
    own, held = zip(*((some[:end], some[end:]) for some, end in zip(all_own, ends, strict=True)), strict=True)
    drawn = lessons_of(_drawn_scenes(max(1, round(samples / _SAMPLES_A_SCENE / SCENES)), seed), rng=rng)
    # Photographs are repeated until half of the samples are taken from them.
    views, squares = (
        some + max(1, len(some) // max(1, len(others))) * others
        for some, others in zip(drawn, own, strict=True)
    )
    backgrounds = [one for one in own[0] if not len(one.sides)]
    rate, steps = _RATE if start is None else _ADAPTING_RATE, max(1, round(samples / BATCH))
    kinds = (
        (FINDER, finder_batch, finder_loss, max(1, round(_FINDER_SHARE * steps)), views, held[0]),
        (KEYPOINTS, keypoint_batch, keypoint_loss, steps, squares, held[1]),
    )
    for name, batch, loss, count, lessons, unseen in kinds:
        network = networks[name]
        evaluated = [batch(unseen, [], one) for one in rng.spawn(_EVALUATION_BATCHES) if unseen]
        handless = start is not None and backgrounds and not any(len(one.sides) for one in all_own[0])
        if handless and isinstance(network, KeypointNetwork):
            network.keep_keypoints()
        initial = {key: value.clone() for key, value in network.state_dict().items()}
        before = _mean_loss(network, evaluated, loss)
        fit(network, functools.partial(batch, lessons, backgrounds), loss, count, seed, rate)
        after = _mean_loss(network, evaluated, loss)
        if evaluated:
            _report(f"{name}: loss {before:.3f} of photographs that are held out, then {after:.3f}\n")
        if not after <= before or not all(one.isfinite().all() for one in network.state_dict().values()):
            network.load_state_dict(initial)
        export(network, Path(out) / name)
    return Path(out)


def _drawn_scenes(shards: int, seed: int) -> Iterator[Scene]:
    """Draw pictures, and report their number."""
    for number in range(shards):
        yield from draw_scenes(number, seed=seed)
        _report(f"\r{SCENES * (number + 1)} of {SCENES * shards} pictures are drawn")
    _report("\n")


def _report(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)


class Scene(NamedTuple):
    """A picture of hands, or of none."""

    picture: Bytes  # sRGB (H, W, 3)
    keypoints: Doubles  # keypoints (N, 21, 2) [px]; NaN for those without a label
    sides: NDArray[np.int8]  # side (N,) of each hand: 0 left, 1 right, -1 unknown
    mask: Bytes | None = None  # 255 where a drawn picture shows hands and arms (H, W)


class Lesson(NamedTuple):
    """A compressed picture from which a network learns."""

    file: Bytes  # JPEG
    keypoints: Doubles  # as in `Scene`
    sides: NDArray[np.int8]
    mask: Bytes | None  # PNG

    @classmethod
    def of(cls, scene: Scene, matrix: Doubles, size: tuple[int, int], hands: Sequence[int]) -> Lesson:
        """Warp a scene by a matrix (2, 3) into a picture of a width and height, and keep these hands."""
        file = np.frombuffer(encode_jpeg(cut(scene.picture, matrix, size), quality=88), np.uint8)
        keypoints = scene.keypoints[hands] @ matrix[:, :2].T + matrix[:, 2]
        mask = None if scene.mask is None else cv2.imencode(".png", cut(scene.mask, matrix, size))[1]
        return cls(file, keypoints, scene.sides[hands], None if mask is None else np.asarray(mask, np.uint8))

    def picture(self) -> Bytes:
        """The decoded picture (H, W, 3) in sRGB."""
        bgr = cv2.imdecode(self.file, cv2.IMREAD_COLOR)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def staged(self, backgrounds: Sequence[Lesson], rng: np.random.Generator) -> Bytes:
        """Decode the picture; half of the drawn hands get a photograph behind them, and a random color."""
        picture = self.picture()
        if self.mask is None or not backgrounds or rng.random() < _KEPT_BACKGROUND_SHARE:
            return picture
        background, size = backgrounds[int(rng.integers(len(backgrounds)))].picture(), picture.shape[1::-1]
        whole = np.array(background.shape[1::-1])
        linear = _random_similarity(rng, 10.0, max(np.array(size) / whole) * rng.uniform(0.8, 2.5))
        shift = 0.5 * np.array(size) - linear @ (whole * rng.uniform(0.3, 0.7, 2))
        behind = cut(background, np.column_stack([linear, shift]), size)
        mask = cv2.imdecode(self.mask, cv2.IMREAD_GRAYSCALE)
        share, before = cv2.GaussianBlur(mask, (3, 3), 0.7)[..., None] / 255.0, picture.astype(np.float64)
        if rng.random() < _DYED_SHARE:
            light = before.mean(axis=2, keepdims=True)
            before = light / max(float(np.average(light, weights=share + 1e-6)), 1.0) * rng.uniform(8, 235, 3)
        return np.asarray(np.clip(share * before + (1.0 - share) * behind, 0.0, 255.0), np.uint8)


def _no_candidates(_: Bytes) -> list[Candidate]:
    """The candidates of a detector that is not trained yet."""
    return []


def lessons_of(
    scenes: Iterable[Scene],
    candidates: Callable[[Bytes], list[Candidate]] = _no_candidates,
    *,
    rng: np.random.Generator,
) -> tuple[list[Lesson], list[Lesson]]:
    """Whole pictures for the finder, and squares with and without a hand for the keypoint network.

    In pictures without hands the squares are the `candidates` of a detector and about as many random ones.
    """
    views, squares = [], []
    for scene in scenes:
        height, width = scene.picture.shape[:2]
        scale, count = VIEW_SIZE / max(height, width), len(scene.sides)
        size = round(scale * width), round(scale * height)
        views.append(Lesson.of(scene, scale * np.eye(2, 3), size, range(count)))
        for number, points in enumerate(scene.keypoints):
            squares.append(_square(scene, points[np.isfinite(points[:, 0])], [number]))
        empty = [] if count else [one.corners for one in candidates(scene.picture)]
        others = [_empty_corners(scene, rng) for _ in range(len(empty) + 1)]
        empty += [one for one in others if one is not None and (not count or rng.random() < _EMPTY_SHARE)]
        squares += [_square(scene, corners, []) for corners in empty]
    return views, squares


def _square(scene: Scene, points: Doubles, hands: list[int]) -> Lesson:
    """Cut out the square around points, and keep these hands."""
    matrix = square_around(points, SQUARE_ROOM, SQUARE_SIZE)
    return Lesson.of(scene, matrix, (SQUARE_SIZE, SQUARE_SIZE), hands)


def _empty_corners(scene: Scene, rng: np.random.Generator) -> Doubles | None:
    """Corners (2, 2) of a random square [px] whose middle is not in a hand; None where there is no room."""
    limit = np.array(scene.picture.shape[1::-1])
    for _ in range(10):
        center, side = rng.uniform(0.0, limit), limit.min() * rng.uniform(0.1, 0.6)
        low, high = np.nanmin(scene.keypoints, axis=1), np.nanmax(scene.keypoints, axis=1)
        room = np.maximum(0.25 * side, 0.25 * (high - low).max(axis=1, keepdims=True))
        if not ((center > low - room) & (center < high + room)).all(axis=1).any():
            return np.array([center - 0.5 * side, center + 0.5 * side])
    return None


def draw_scenes(number: int, *, seed: int) -> Iterator[Scene]:
    """Draw pictures of one or two hands, in gloves or bare, with one camera preset."""
    rng = np.random.default_rng([seed, number])
    config = RenderConfig(passes=("rgb", "ids"), dress="glove" if number % 2 else "skin")
    stream = PictureStream(
        poses=_two_hands(SCENES, rng) if number % 3 == 2 else None,
        config=config,
        camera=_CAMERAS[rng.integers(len(_CAMERAS))],
        fill=(0.45, 1.0) if number % 3 == 2 else (0.12, 0.85),
        people=SCENES // _SITTING,
        sitting=_SITTING,
        glove=_GLOVES[rng.integers(len(_GLOVES))],
        seed=int(rng.integers(2**31)),
    )
    for one in itertools.islice(stream, SCENES):
        keypoints, visible = one["keypoints"].numpy(), one["visible"].numpy()
        keypoints = keypoints.astype(np.float64).reshape(-1, NUM_KEYPOINTS, 2)
        seen = visible.reshape(-1, NUM_KEYPOINTS).sum(axis=1) >= _FEWEST_VISIBLE
        picture = np.ascontiguousarray(one.get("noisy_rgb", one["rgb"]).numpy().transpose(1, 2, 0))
        sides = one["side"].numpy().astype(np.int8).reshape(-1)
        mask = np.uint8(255) * (one["ids"].numpy() > 0)
        yield Scene(picture, keypoints[seen], sides[seen], mask)


def _two_hands(count: int, rng: np.random.Generator) -> Doubles:
    """Random poses (T, 2, 27) of a right and a left hand near each other, in any orientation."""
    poses = np.empty((count, 2, NUM_QPOS))
    for number, side in enumerate(SIDES[::-1]):
        poses[:, number] = sample_poses(HandModel.named("M", side=side), count, rng=rng)
        poses[:, number, 3:7] = Rotation.random(count, rng=rng).as_quat()[:, [3, 0, 1, 2]]
    offset = rng.normal(size=(count, 3))
    offset *= rng.uniform(0.14, 0.45, (count, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    poses[:, 0, :3], poses[:, 1, :3] = 0.0, offset
    return poses


def read_scenes(file: Path) -> Iterator[Scene]:
    """Read the photographs that a file of COCO keypoints names, with hands and without, sorted by name."""
    hands, empty = load_labeled_photographs(file)
    by_file: dict[Path, list[LabeledHand]] = {path: [] for path in empty}
    for hand in hands:
        by_file.setdefault(hand.file, []).append(hand)
    for path, labeled in sorted(by_file.items()):
        keypoints = np.array([hand.keypoints for hand in labeled]).reshape(-1, NUM_KEYPOINTS, 2)
        sides = np.array([hand.side for hand in labeled], dtype=np.int8)
        yield Scene(read_photograph(path), keypoints, sides)


def fit(
    network: Network,
    make: Callable[[np.random.Generator], Batch],
    loss: Loss,
    steps: int,
    seed: int,
    rate: float = _RATE,
) -> list[float]:
    """Train a network on the batches that `make` draws; return the losses of all steps."""
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=0.01, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps + 1, pct_start=0.15)
    network.train()
    for layer in network.modules():
        if rate == _ADAPTING_RATE and isinstance(layer, nn.BatchNorm2d):
            layer.eval()  # because given weights include the batch statistics
    losses: list[float] = []
    for step in range(steps):
        pictures, targets = make(np.random.default_rng([seed, step]))
        with torch.autocast("cpu", torch.bfloat16, enabled=BF16):
            found = network(pictures.contiguous(memory_format=torch.channels_last))
        value = loss(found, targets)
        optimizer.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(value.item())
        if (step + 1) % max(1, steps // 20) == 0:
            _report(f"{step + 1} of {steps} steps, loss {np.mean(losses[-200:]):.3f}\n")
    network.eval()
    return losses


def _mean_loss(network: Network, batches: Sequence[Batch], loss: Loss) -> float:
    """Mean loss of some batches without training."""
    network.eval()
    with torch.no_grad():
        losses = [loss(network(pictures), targets).item() for pictures, targets in batches]
    return sum(losses) / _EVALUATION_BATCHES


def recolored(picture: Bytes, rng: np.random.Generator) -> Bytes:
    """Augment a picture with other colors, contrast, blur, motion blur, noise and resolution."""
    size = picture.shape[1::-1]
    if rng.random() < 0.25:
        small = tuple(max(8, int(side * rng.uniform(0.35, 0.9))) for side in size)
        picture = cv2.resize(cv2.resize(picture, small, interpolation=cv2.INTER_AREA), size)
    if rng.random() < 0.3:
        picture = cv2.GaussianBlur(picture, (5, 5), rng.uniform(0.3, 1.5))
    elif rng.random() < 0.3:
        picture = cv2.filter2D(picture, -1, _motion_blur(rng))
    levels = np.linspace(0.0, 1.0, 256)[:, None] ** rng.uniform(0.7, 1.4)
    levels = levels * rng.uniform(0.82, 1.18, 3) * rng.uniform(0.8, 1.2) + rng.uniform(-0.06, 0.06)
    table = np.clip(255.0 * levels, 0.0, 255.0).astype(np.uint8)[:, None]
    picture = cv2.LUT(picture, table)
    if rng.random() < 0.1:
        picture = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    if rng.random() < 0.3:
        noise = rng.standard_normal(picture.shape, dtype=np.float32) * rng.uniform(2.0, 10.0)
        picture = np.clip(picture + noise, 0.0, 255.0).astype(np.uint8)
    return np.asarray(picture)


def _motion_blur(rng: np.random.Generator) -> Floats:
    """A blur kernel (9, 9) of a random motion along a line while the shutter is open."""
    kernel, angle = np.zeros((9, 9), np.float32), rng.uniform(0.0, np.pi)
    half = rng.uniform(1.0, 4.0) * np.array([np.cos(angle), np.sin(angle)])
    start, end = np.rint([4.0 - half, 4.0 + half]).astype(int).tolist()
    cv2.line(kernel, start, end, (1.0,))
    return np.asarray(kernel / kernel.sum())


def _random_similarity(rng: np.random.Generator, deviation: float, scale: float = 1.0) -> Doubles:
    """A random matrix (2, 2): a rotation of this standard deviation [deg], a scale, and often a mirror."""
    matrix = cv2.getRotationMatrix2D((0, 0), rng.normal(0.0, deviation), scale)[:, :2]
    return np.asarray(matrix * [rng.choice((-1.0, 1.0)), 1.0])


def keypoint_batch(
    lessons: Sequence[Lesson], backgrounds: Sequence[Lesson], rng: np.random.Generator
) -> Batch:
    """Squares with one hand or none, and as targets keypoints [share of the side], presence and palm.

    The palm faces the camera (1), does not (0), or is unknown (-1). A mirrored picture has the same value,
    so that the network learns it long before the side.
    """
    pictures, points = [], np.full((BATCH, NUM_KEYPOINTS, 2), np.nan, np.float32)
    presence, palms = np.zeros(BATCH, np.float32), np.full(BATCH, -1.0, np.float32)
    for number in range(BATCH):
        lesson = lessons[int(rng.integers(len(lessons)))]
        wide, is_hand = lesson.staged(backgrounds, rng), len(lesson.sides) > 0
        keypoints = lesson.keypoints[0] if is_hand else np.full((NUM_KEYPOINTS, 2), np.nan)
        labeled = keypoints[np.isfinite(keypoints[:, 0])]
        first_look = rng.random() < _FIRST_LOOK_SHARE or len(labeled) < len(keypoints)
        rotation = _random_similarity(rng, 1e3 if first_look and rng.random() < 0.5 else 17.0)
        if not first_look:
            rotation = rotation @ upright(keypoints)
        middle = np.array([[0.3, 0.3], [0.7, 0.7]]) * wide.shape[0]
        room = ROOM * rng.uniform(0.78, 1.3)
        matrix = square_around(labeled if len(labeled) else middle, room, rotation=rotation)
        matrix[:, 2] += rng.normal(0.0, 0.06 * CROP_SIZE, 2)
        image = cut(wide, matrix, (CROP_SIZE, CROP_SIZE))
        if rng.random() < 0.15:  # A patch of one color occludes the hand.
            (left, top), (width, height) = rng.integers(0, CROP_SIZE - 16, 2), rng.integers(12, 48, 2)
            image[top : top + height, left : left + width] = rng.integers(0, 256, 3)
        pictures.append(normalized(recolored(image, rng)))
        points[number] = (keypoints @ matrix[:, :2].T + matrix[:, 2]) / CROP_SIZE
        if is_hand and lesson.sides[0] >= 0 and np.isfinite(spread := palm_spread(keypoints)):
            palms[number] = (spread > 0.0) == (lesson.sides[0] == 1)
        presence[number] = is_hand
    return torch.from_numpy(np.stack(pictures)), tuple(map(torch.from_numpy, (points, presence, palms)))


def keypoint_loss(outputs: tuple[torch.Tensor, torch.Tensor], targets: Targets) -> torch.Tensor:
    """Cross-entropy of the heat, error of its mean, and cross-entropies of presence and palm."""
    heat, logits = (one.float() for one in outputs)
    points, presence, palms = targets
    centers = (torch.arange(HEAT_SIZE) + 0.5) / HEAT_SIZE
    cells = torch.stack(torch.meshgrid(centers, centers, indexing="xy"), dim=-1).reshape(-1, 2)
    counts = ((points > 0.0) & (points < 1.0)).all(dim=2)  # inside and labeled
    points = torch.where(counts[..., None], points, torch.zeros_like(points))
    near = torch.exp(-(torch.cdist(points, cells.expand(len(points), -1, -1)) ** 2) / (2 * _HEAT_SPREAD**2))
    near = near / near.sum(dim=2, keepdim=True).clamp(min=1e-6)
    flat = heat.flatten(2)
    mean = flat.softmax(dim=2) @ cells
    each = -(near * flat.log_softmax(dim=2)).sum(dim=2) + 10.0 * (mean - points).abs().mean(dim=2)
    loss = (each * counts).sum() / counts.sum().clamp(min=1)
    loss = loss + functional.binary_cross_entropy_with_logits(logits[:, 0], presence)
    wrong = functional.binary_cross_entropy_with_logits(logits[:, 1], palms.clamp(min=0.0), reduction="none")
    known = palms >= 0.0
    return loss + (wrong * known).sum() / known.sum().clamp(min=1)


def finder_batch(lessons: Sequence[Lesson], backgrounds: Sequence[Lesson], rng: np.random.Generator) -> Batch:
    """Rotated and cropped pictures, and as targets the network's cells (4, S/8, S/8) and their weight."""
    cells = FINDER_SIZE // CELL
    pictures, targets = [], np.zeros((BATCH, 5, cells, cells), np.float32)
    for target in targets:
        lesson = lessons[int(rng.integers(len(lessons)))]
        picture = lesson.staged(backgrounds, rng)
        long, short = FINDER_SIZE, round(FINDER_SIZE * rng.choice(_ASPECTS))
        width, height = (long, short) if rng.random() < 0.75 else (short, long)
        linear = _random_similarity(rng, 14.0, FINDER_SIZE / VIEW_SIZE * rng.uniform(0.75, 1.7))
        middle = 0.5 * np.array(picture.shape[1::-1]) * rng.uniform(0.6, 1.4, 2)
        shift = 0.5 * np.array([width, height]) - linear @ middle
        square = np.zeros((3, FINDER_SIZE, FINDER_SIZE), np.float32)
        image = cut(picture, np.column_stack([linear, shift]), (width, height))
        square[:, :height, :width] = normalized(recolored(image, rng))
        pictures.append(square)
        for points in lesson.keypoints:
            labeled = points[np.isfinite(points[:, 0])]
            if len(labeled):
                _write_hand(target, labeled @ linear.T + shift, (width, height))
    return torch.from_numpy(np.stack(pictures)), (torch.from_numpy(targets),)


def _write_hand(target: Floats, points: Doubles, size: tuple[int, int]) -> None:
    """Write a hand into the cells (5, S/8, S/8): heat, offset, size, weight."""
    low, high = points.min(axis=0), points.max(axis=0)
    center, longer = 0.5 * (low + high), float((high - low).max())
    if longer < _SMALLEST_HAND or (center < 0.0).any() or (center >= size).any():
        return
    column, row = (int(value // CELL) for value in center)
    spread = max(0.6, 0.09 * longer / CELL)
    rows, columns = np.mgrid[: target.shape[1], : target.shape[2]]
    heat = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2.0 * spread**2))
    own = (heat > target[0]) & (heat > 0.5)
    target[0] = np.maximum(target[0], heat)
    target[1][own] = center[0] / CELL - 0.5 - columns[own]
    target[2][own] = center[1] / CELL - 0.5 - rows[own]
    target[3][own] = np.log(longer / CELL)
    target[4][own] = heat[own]


def finder_loss(outputs: torch.Tensor, targets: Targets) -> torch.Tensor:
    """Focal loss of the centers (Law and Deng 2018), plus errors of offset and size at them."""
    cells, target = outputs.float(), targets[0]
    heat, truth, weight = cells[:, 0], target[:, 0], target[:, 4]
    hit = -((1.0 - heat.sigmoid()) ** 2) * functional.logsigmoid(heat)
    false = -((1.0 - truth) ** 4) * heat.sigmoid() ** 2 * functional.logsigmoid(-heat)
    count = (truth == 1.0).sum().clamp(min=1)
    loss = torch.where(truth == 1.0, hit, false).sum() / count
    off = (cells[:, 1:4] - target[:, 1:4]).abs() * torch.tensor([0.3, 0.3, 1.0])[:, None, None]
    return loss + (off.sum(dim=1) * weight).sum() / weight.sum().clamp(min=1.0)


def export(network: Network, path: Path) -> None:
    """Write a network as an ONNX file with weights of half precision."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    is_finder = isinstance(network, FinderNetwork)
    size, outputs = (FINDER_SIZE, ["cells"]) if is_finder else (CROP_SIZE, ["heat", "logits"])
    stored = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # because the newer exporter needs another package
        torch.onnx.export(
            network.eval(),
            (torch.zeros(1, 3, size, size),),
            stored,  # type: ignore[arg-type]  # which it accepts
            input_names=["picture"],
            output_names=outputs,
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(stored.getvalue())
    for tensor in model.graph.initializer:
        values, name = numpy_helper.to_array(tensor), tensor.name
        if values.dtype == np.float32 and values.ndim > 1:
            tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), name + _HALF))
            cast = helper.make_node("Cast", [name + _HALF], [name], to=TensorProto.FLOAT)
            model.graph.node.insert(0, cast)
    helper.set_model_props(model, {"handsim.version": full_version(), DIGEST: "0" * 64})
    onnx.checker.check_model(model, full_check=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(stamp_model(model.SerializeToString()))


def _load_folded(network: Network, path: Path) -> None:
    """Load the weights of an exported network, whose convolutions include the batch normalizations."""
    import onnx
    from onnx import numpy_helper

    graph = onnx.load_model(path).graph
    arrays = {one.name.removesuffix(_HALF): numpy_helper.to_array(one) for one in graph.initializer}
    stored = (
        [torch.tensor(np.float32(arrays[name])) for name in node.input[1:]]
        for node in graph.node
        if node.op_type in ("Conv", "Gemm")
    )
    layers: list[Any] = [
        one for one in network.modules() if isinstance(one, nn.Conv2d | nn.Linear | nn.BatchNorm2d)
    ]
    for layer, norm in itertools.zip_longest(layers, layers[1:]):
        if isinstance(layer, nn.BatchNorm2d):
            continue
        weight, bias = next(stored)
        layer.weight.data.copy_(weight)
        if layer.bias is None:
            norm.running_var.fill_(1.0 - norm.eps)
        (norm if layer.bias is None else layer).bias.data.copy_(bias)


if __name__ == "__main__":
    import tyro

    print(tyro.cli(train_detector, config=(tyro.conf.PositionalRequiredArgs,)))
