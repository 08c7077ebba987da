"""Training of the hand detector on drawn pictures, and on labeled photographs of your own.

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
    HandDetector,
    Place,
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
_SAMPLES_A_SCENE: Final = 18  # squares that the keypoint network sees for each drawn picture
_FINDER_SHARE: Final = 0.5  # samples of the finder over those of the keypoint network
_SPREAD: Final = 0.06  # of the heat around a keypoint [share of the side]
_RATE, _ADAPTING_RATE = 2e-3, 6e-4  # largest learning rates: from scratch, and from given weights
_LEARNED: Final = 0.8  # share of the photographs that train a network; the others judge it
_JUDGED: Final = 4  # batches of photographs on which it is judged
_SMALLEST: Final = 14.0  # longer side of a hand that the finder learns [px of what it sees]
_ASPECTS: Final = (0.75, 0.75, 0.5625, 1.0)  # shorter side of a picture over the longer one
# share of the squares that imitate the first look, half of them turned at random; in others fingers point up
_FIRST_LOOK: Final = 0.35
_OPSET: Final = 17
_HALF: Final = "_half"  # ending of the names of weights of half precision
VIEW_SIZE: Final = 320  # longer side of a stored picture [px]
WIDE: Final = 192  # of a stored square around a hand [px]: it can be turned and shifted
WIDE_ROOM: Final = 2.4  # side of that square over the hand's longer side
SCENES: Final = 128  # pictures that are drawn together
_GLOVES: Final = ("dense19", "starter15", "sparse13", "starter30", "tips8", "dfki13", "starter10")
_CAMERAS: Final = ("vga", "vga_wide", "vga", "sr300", "kinect2", "d435")
_SITTING: Final = 16  # pictures of each person
_FEWEST_SEEN: Final = 4  # keypoints of a hand that must be seen
_EMPTY: Final = 0.35  # share of the scenes that also give a square without a hand
# share of the drawn pictures that keep their own background, where there are photographs for others
_KEEPS_BACKGROUND: Final = 0.5
_DYED: Final = 0.6  # share of the other hands whose color is any

Network = FinderNetwork | KeypointNetwork
Targets = tuple[torch.Tensor, ...]
Loss = Callable[[Any, Targets], torch.Tensor]
Batch = tuple[torch.Tensor, Targets]
"""Pictures (B, 3, S, S) and what is learned of them in one step."""


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
            Images without an annotation are pictures without hands: what the detector finds there teaches
            what is none, and half of the drawn hands are laid over them. If no image has a hand, keypoints
            stay as they are.
        samples: Number of squares that the keypoint network learns from; the finder learns from half
            as many pictures.
        seed: Seed of pictures, of initial weights and of all random choices.

    Returns:
        The folder, for `HandDetector.load`.

    Raises:
        HandSimError: The start or the photographs cannot be read, or onnx is missing.
    """
    check_count("samples", samples, BATCH, 1_000_000_000)
    import_extra("onnx", "training a detector", "onnx")  # missed before the work, not after it
    torch.manual_seed(seed)
    networks: dict[str, Network] = {FINDER: FinderNetwork(), KEYPOINTS: KeypointNetwork()}
    places: Callable[[Bytes], list[Place]] = _nowhere
    if start is not None:
        begun = WEIGHTS if start == "shipped" else Path(start)
        places = HandDetector.load(begun)._places  # refuses damaged weights
        for name, network in networks.items():
            _load_folded(network, begun / name)
    rng = np.random.default_rng(seed)
    mine = lessons_of([] if photographs is None else read_scenes(Path(photographs)), places, rng=rng)
    ends = [math.ceil(_LEARNED * len(some)) for some in mine]
    own, held = zip(*((some[:end], some[end:]) for some, end in zip(mine, ends, strict=True)), strict=True)
    drawn = lessons_of(_drawn(max(1, round(samples / _SAMPLES_A_SCENE / SCENES)), seed), rng=rng)
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
        network, judged = networks[name], [batch(unseen, [], one) for one in rng.spawn(_JUDGED) if unseen]
        handless = start is not None and backgrounds and not any(len(one.sides) for one in mine[0])
        if handless and isinstance(network, KeypointNetwork):
            network.keep_keypoints()
        given = {key: value.clone() for key, value in network.state_dict().items()}
        before = _mean_loss(network, judged, loss)
        fit(network, functools.partial(batch, lessons, backgrounds), loss, count, seed, rate)
        after = _mean_loss(network, judged, loss)
        if judged:
            _tell(f"{name}: loss {before:.3f} of photographs that are held out, then {after:.3f}\n")
        if not after <= before or not all(one.isfinite().all() for one in network.state_dict().values()):
            network.load_state_dict(given)
        export(network, Path(out) / name)
    return Path(out)


def _drawn(shards: int, seed: int) -> Iterator[Scene]:
    """Drawn pictures, whose number is told."""
    for number in range(shards):
        yield from draw_scenes(number, seed=seed)
        _tell(f"\r{SCENES * (number + 1)} of {SCENES * shards} pictures are drawn")
    _tell("\n")


def _tell(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)


class Scene(NamedTuple):
    """A picture of hands, or of none."""

    picture: Bytes  # (H, W, 3) sRGB
    keypoints: Doubles  # (N, 21, 2) [px]; NaN for those without a label
    sides: NDArray[np.int8]  # (N,) 0 left, 1 right, -1 unknown
    mask: Bytes | None = None  # (H, W) 255 where a drawn picture shows hands and arms


class Lesson(NamedTuple):
    """A scene as it is kept."""

    file: Bytes  # JPEG
    keypoints: Doubles  # as in `Scene`
    sides: NDArray[np.int8]
    mask: Bytes | None  # PNG

    @classmethod
    def of(cls, scene: Scene, matrix: Doubles, size: tuple[int, int], hands: Sequence[int]) -> Lesson:
        """What a matrix (2, 3) moves into a picture of a width and height, compressed, with these hands."""
        file = np.frombuffer(encode_jpeg(cut(scene.picture, matrix, size), quality=88), np.uint8)
        keypoints = scene.keypoints[hands] @ matrix[:, :2].T + matrix[:, 2]
        mask = None if scene.mask is None else cv2.imencode(".png", cut(scene.mask, matrix, size))[1]
        return cls(file, keypoints, scene.sides[hands], None if mask is None else np.asarray(mask, np.uint8))

    def picture(self) -> Bytes:
        """The decoded picture (H, W, 3) in sRGB."""
        bgr = cv2.imdecode(self.file, cv2.IMREAD_COLOR)
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def staged(self, backgrounds: Sequence[Lesson], rng: np.random.Generator) -> Bytes:
        """The picture; half of the drawn hands are before a photograph, in gloves of any color."""
        picture = self.picture()
        if self.mask is None or not backgrounds or rng.random() < _KEEPS_BACKGROUND:
            return picture
        background, size = backgrounds[int(rng.integers(len(backgrounds)))].picture(), picture.shape[1::-1]
        turn = _turn(rng, 10.0, max(np.array(size) / background.shape[1::-1]) * rng.uniform(0.8, 2.5))
        shift = 0.5 * np.array(size) - turn @ (np.array(background.shape[1::-1]) * rng.uniform(0.3, 0.7, 2))
        behind = cut(background, np.column_stack([turn, shift]), size)
        mask = cv2.imdecode(self.mask, cv2.IMREAD_GRAYSCALE)
        share, before = cv2.GaussianBlur(mask, (3, 3), 0.7)[..., None] / 255.0, picture.astype(np.float64)
        if rng.random() < _DYED:
            light = before.mean(axis=2, keepdims=True)
            before = light / max(float(np.average(light, weights=share + 1e-6)), 1.0) * rng.uniform(8, 235, 3)
        return np.asarray(np.clip(share * before + (1.0 - share) * behind, 0.0, 255.0), np.uint8)


def _nowhere(_: Bytes) -> list[Place]:
    """No places: what is found before anything is learned."""
    return []


def lessons_of(
    scenes: Iterable[Scene],
    places: Callable[[Bytes], list[Place]] = _nowhere,
    *,
    rng: np.random.Generator,
) -> tuple[list[Lesson], list[Lesson]]:
    """Whole pictures for the finder, and squares with and without a hand for the keypoint network.

    In pictures without hands the squares are the `places` that look like hands, and as many others.
    """
    views, squares = [], []
    for scene in scenes:
        height, width = scene.picture.shape[:2]
        scale, count = VIEW_SIZE / max(height, width), len(scene.sides)
        size = round(scale * width), round(scale * height)
        views.append(Lesson.of(scene, scale * np.eye(2, 3), size, range(count)))
        for number, points in enumerate(scene.keypoints):
            squares.append(_square(scene, points[np.isfinite(points[:, 0])], [number]))
        empty = [] if count else [place.corners for place in places(scene.picture)]
        others = [_empty_place(scene, rng) for _ in range(len(empty) + 1)]
        empty += [one for one in others if one is not None and (not count or rng.random() < _EMPTY)]
        squares += [_square(scene, corners, []) for corners in empty]
    return views, squares


def _square(scene: Scene, points: Doubles, hands: list[int]) -> Lesson:
    """The square around points, with these hands."""
    return Lesson.of(scene, square_around(points, WIDE_ROOM, WIDE), (WIDE, WIDE), hands)


def _empty_place(scene: Scene, rng: np.random.Generator) -> Doubles | None:
    """Corners (2, 2) of a square [px] whose middle is not in a hand; None where there is no room."""
    limit = np.array(scene.picture.shape[1::-1])
    for _ in range(10):
        center, side = rng.uniform(0.0, limit), limit.min() * rng.uniform(0.1, 0.6)
        low, high = np.nanmin(scene.keypoints, axis=1), np.nanmax(scene.keypoints, axis=1)
        room = np.maximum(0.25 * side, 0.25 * (high - low).max(axis=1, keepdims=True))
        if not ((center > low - room) & (center < high + room)).all(axis=1).any():
            return np.array([center - 0.5 * side, center + 0.5 * side])
    return None


def draw_scenes(number: int, *, seed: int) -> Iterator[Scene]:
    """Some drawn pictures of one or two hands, in gloves or bare, seen by one kind of camera."""
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
        seen = visible.reshape(-1, NUM_KEYPOINTS).sum(axis=1) >= _FEWEST_SEEN
        picture = np.ascontiguousarray(one.get("noisy_rgb", one["rgb"]).numpy().transpose(1, 2, 0))
        sides = one["side"].numpy().astype(np.int8).reshape(-1)
        mask = np.uint8(255) * (one["ids"].numpy() > 0)
        yield Scene(picture, keypoints[seen], sides[seen], mask)


def _two_hands(count: int, rng: np.random.Generator) -> Doubles:
    """Poses (T, 2, 27) of right and left hands that are turned anyhow, near one another."""
    poses = np.empty((count, 2, NUM_QPOS))
    for number, side in enumerate(SIDES[::-1]):
        poses[:, number] = sample_poses(HandModel.named("M", side=side), count, rng=rng)
        poses[:, number, 3:7] = Rotation.random(count, rng=rng).as_quat()[:, [3, 0, 1, 2]]
    away = rng.normal(size=(count, 3))
    away *= rng.uniform(0.14, 0.45, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    poses[:, 0, :3], poses[:, 1, :3] = 0.0, away
    return poses


def read_scenes(file: Path) -> Iterator[Scene]:
    """Your own photographs with the hands of a file of COCO keypoints, and those without any, by name."""
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
            layer.eval()  # given weights hold its figures already
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
            _tell(f"{step + 1} of {steps} steps, loss {np.mean(losses[-200:]):.3f}\n")
    network.eval()
    return losses


def _mean_loss(network: Network, batches: Sequence[Batch], loss: Loss) -> float:
    """The loss of some batches without training."""
    network.eval()
    with torch.no_grad():
        return sum(loss(network(pictures), targets).item() for pictures, targets in batches) / _JUDGED


def recolored(picture: Bytes, rng: np.random.Generator) -> Bytes:
    """A picture in other light, from another camera: colors, contrast, blur, shake, noise, few pixels."""
    size = picture.shape[1::-1]
    if rng.random() < 0.25:
        small = tuple(max(8, int(side * rng.uniform(0.35, 0.9))) for side in size)
        picture = cv2.resize(cv2.resize(picture, small, interpolation=cv2.INTER_AREA), size)
    if rng.random() < 0.3:
        picture = cv2.GaussianBlur(picture, (5, 5), rng.uniform(0.3, 1.5))
    elif rng.random() < 0.3:
        picture = cv2.filter2D(picture, -1, _shake(rng))
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


def _shake(rng: np.random.Generator) -> Floats:
    """The kernel of a camera or a hand that moves along a line while the shutter is open."""
    kernel, angle = np.zeros((9, 9), np.float32), rng.uniform(0.0, np.pi)
    away = rng.uniform(1.0, 4.0) * np.array([np.cos(angle), np.sin(angle)])
    start, end = np.rint([4.0 - away, 4.0 + away]).astype(int).tolist()
    cv2.line(kernel, start, end, (1.0,))
    return np.asarray(kernel / kernel.sum())


def _turn(rng: np.random.Generator, deviation: float, scale: float = 1.0) -> Doubles:
    """A random matrix (2, 2): a rotation of this standard deviation [deg], a scale, and often a mirror."""
    turn = cv2.getRotationMatrix2D((0, 0), rng.normal(0.0, deviation), scale)[:, :2]
    return np.asarray(turn * [rng.choice((-1.0, 1.0)), 1.0])


def keypoint_batch(
    lessons: Sequence[Lesson], backgrounds: Sequence[Lesson], rng: np.random.Generator
) -> Batch:
    """Pictures of single hands, and some of none. Targets: keypoints [share of the side], presence, palm.

    The palm faces the camera (1), or does not (0), or that is not known (-1). Mirrored pictures have the same
    answer, which is learned long before the side.
    """
    pictures, points = [], np.full((BATCH, NUM_KEYPOINTS, 2), np.nan, np.float32)
    presence, palms = np.zeros(BATCH, np.float32), np.full(BATCH, -1.0, np.float32)
    for number in range(BATCH):
        lesson = lessons[int(rng.integers(len(lessons)))]
        wide, is_hand = lesson.staged(backgrounds, rng), len(lesson.sides) > 0
        keypoints = lesson.keypoints[0] if is_hand else np.full((NUM_KEYPOINTS, 2), np.nan)
        labeled = keypoints[np.isfinite(keypoints[:, 0])]
        first_look = rng.random() < _FIRST_LOOK or len(labeled) < len(keypoints)
        turn = _turn(rng, 1e3 if first_look and rng.random() < 0.5 else 17.0)
        if not first_look:
            turn = turn @ upright(keypoints)
        middle = np.array([[0.3, 0.3], [0.7, 0.7]]) * wide.shape[0]
        room = ROOM * rng.uniform(0.78, 1.3)
        matrix = square_around(labeled if len(labeled) else middle, room, turn=turn)
        matrix[:, 2] += rng.normal(0.0, 0.06 * CROP_SIZE, 2)
        image = cut(wide, matrix, (CROP_SIZE, CROP_SIZE))
        if rng.random() < 0.15:  # A patch of one color is before the hand.
            (left, top), (width, height) = rng.integers(0, CROP_SIZE - 16, 2), rng.integers(12, 48, 2)
            image[top : top + height, left : left + width] = rng.integers(0, 256, 3)
        pictures.append(normalized(recolored(image, rng)))
        points[number] = (keypoints @ matrix[:, :2].T + matrix[:, 2]) / CROP_SIZE
        if is_hand and lesson.sides[0] >= 0 and np.isfinite(spread := palm_spread(keypoints)):
            palms[number] = (spread > 0.0) == (lesson.sides[0] == 1)
        presence[number] = is_hand
    told = (torch.from_numpy(points), torch.from_numpy(presence), torch.from_numpy(palms))
    return torch.from_numpy(np.stack(pictures)), told


def keypoint_loss(found: tuple[torch.Tensor, torch.Tensor], targets: Targets) -> torch.Tensor:
    """How little heat is near the keypoints, how far off its mean is, and errors of presence and palm."""
    heat, told = (one.float() for one in found)
    points, presence, palms = targets
    at = (torch.arange(HEAT_SIZE) + 0.5) / HEAT_SIZE
    places = torch.stack(torch.meshgrid(at, at, indexing="xy"), dim=-1).reshape(-1, 2)
    counts = ((points > 0.0) & (points < 1.0)).all(dim=2)  # inside and labeled
    points = torch.where(counts[..., None], points, torch.zeros_like(points))
    near = torch.exp(-(torch.cdist(points, places.expand(len(points), -1, -1)) ** 2) / (2 * _SPREAD**2))
    near = near / near.sum(dim=2, keepdim=True).clamp(min=1e-6)
    flat = heat.flatten(2)
    mean = flat.softmax(dim=2) @ places
    each = -(near * flat.log_softmax(dim=2)).sum(dim=2) + 10.0 * (mean - points).abs().mean(dim=2)
    loss = (each * counts).sum() / counts.sum().clamp(min=1)
    loss = loss + functional.binary_cross_entropy_with_logits(told[:, 0], presence)
    wrong = functional.binary_cross_entropy_with_logits(told[:, 1], palms.clamp(min=0.0), reduction="none")
    known = palms >= 0.0
    return loss + (wrong * known).sum() / known.sum().clamp(min=1)


def finder_batch(lessons: Sequence[Lesson], backgrounds: Sequence[Lesson], rng: np.random.Generator) -> Batch:
    """Pictures, turned, cut and scaled; targets: cells (4, S/8, S/8) as the network's, and their weight."""
    cells = FINDER_SIZE // CELL
    pictures, targets = [], np.zeros((BATCH, 5, cells, cells), np.float32)
    for target in targets:
        lesson = lessons[int(rng.integers(len(lessons)))]
        picture = lesson.staged(backgrounds, rng)
        long, short = FINDER_SIZE, round(FINDER_SIZE * rng.choice(_ASPECTS))
        width, height = (long, short) if rng.random() < 0.75 else (short, long)
        turn = _turn(rng, 14.0, FINDER_SIZE / VIEW_SIZE * rng.uniform(0.75, 1.7))
        middle = 0.5 * np.array(picture.shape[1::-1]) * rng.uniform(0.6, 1.4, 2)
        shift = 0.5 * np.array([width, height]) - turn @ middle
        square = np.zeros((3, FINDER_SIZE, FINDER_SIZE), np.float32)
        image = cut(picture, np.column_stack([turn, shift]), (width, height))
        square[:, :height, :width] = normalized(recolored(image, rng))
        pictures.append(square)
        for points in lesson.keypoints:
            labeled = points[np.isfinite(points[:, 0])]
            if len(labeled):
                _mark(target, labeled @ turn.T + shift, (width, height))
    return torch.from_numpy(np.stack(pictures)), (torch.from_numpy(targets),)


def _mark(target: Floats, points: Doubles, size: tuple[int, int]) -> None:
    """Write a hand into the cells (5, S/8, S/8): heat, offset, size, weight."""
    low, high = points.min(axis=0), points.max(axis=0)
    center, longer = 0.5 * (low + high), float((high - low).max())
    if longer < _SMALLEST or (center < 0.0).any() or (center >= size).any():
        return
    column, row = (int(value // CELL) for value in center)
    spread = max(0.6, 0.09 * longer / CELL)
    rows, columns = np.mgrid[: target.shape[1], : target.shape[2]]
    heat = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2.0 * spread**2))
    mine = (heat > target[0]) & (heat > 0.5)
    target[0] = np.maximum(target[0], heat)
    target[1][mine] = center[0] / CELL - 0.5 - columns[mine]
    target[2][mine] = center[1] / CELL - 0.5 - rows[mine]
    target[3][mine] = np.log(longer / CELL)
    target[4][mine] = heat[mine]


def finder_loss(found: torch.Tensor, targets: Targets) -> torch.Tensor:
    """Focal loss of the centers (Law and Deng 2018), and errors of offset and size at them."""
    cells, target = found.float(), targets[0]
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
        warnings.simplefilter("ignore")  # the newer exporter needs another package
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
    """Read the weights of an exported network, whose normalizations are part of its convolutions."""
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
