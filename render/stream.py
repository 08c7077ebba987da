"""`PictureStream`: pictures without end for a training loop of torch, drawn when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike, NDArray
from torch.utils.data import IterableDataset

from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim._checks import as_numbers, check_choice, check_count, check_number, check_type
from handsim._process import SharedStream, with_own_numerics
from handsim.errors import ArgumentError, DatasetError, PoseError, errors_of
from handsim.files.inputs import load_json
from handsim.hand.model import HandModel, hand_keypoints
from handsim.hand.shape import NUM_KEYPOINTS, NUM_QPOS, SIDES, HandShape, Side, pack_hand, sample_shape
from handsim.space.camera import PRESETS, Camera, preset
from poses import PoseSampler, sample_poses
from poses.shapes import load_sampler, mixed_angles
from render.conditions import sample_conditions
from render.config import RenderConfig, SpawnKey, resolve
from render.formats.records import labeled_keypoints
from render.frames import Doubles, HandTruth, Integers, RenderedFrame
from render.photographs import read_photograph
from render.studio import Moment, Studio
from render.subject import Model, Subject, models_of, subject_of, subject_of_poses
from render.viewpoints import SHIFT_SHARE, around_hands, crop_around

_FEWEST_KEYPOINTS: Final = 3  # least number of labeled keypoints of a hand that can be cut out
_PICTURE, _PERSON, _PHOTOGRAPH = 0, 1, 2  # second number of a stream's spawn keys
_CROPPED: Final = 0.5  # hands' share of the whole picture over their share of the crop
_SIDE_CHOICES: Final = (*SIDES, "either")


class LabeledHand(NamedTuple):
    """One labeled hand."""

    file: Path
    keypoints: Float[np.ndarray, "21 2"]
    """[px] from the photograph's corner; NaN for those without a label."""
    visible: Bool[np.ndarray, "21"]
    side: int  # 0 left, 1 right, -1 unknown


def load_labeled_photographs(file: str | Path) -> tuple[list[LabeledHand], list[Path]]:
    """The hands of a file of COCO keypoints, 21 each in our order, and its pictures without an annotation.

    Pictures are beside the file or in `images`.
    """
    path = Path(file)
    content = load_json(path)
    try:
        names = {image["id"]: image["file_name"] for image in content["images"]}
        labels = [(names[one["image_id"]], one) for one in content["annotations"] if "keypoints" in one]
    except (KeyError, TypeError) as error:
        raise DatasetError(
            f"{path}: not COCO keypoints ({error}), expected images with `file_name` and annotations with "
            "`image_id` and `keypoints`"
        ) from error
    hands = [_labeled_hand(path, name, label) for name, label in labels]
    kept = [hand for hand in hands if np.isfinite(hand.keypoints[:, 0]).sum() >= _FEWEST_KEYPOINTS]
    annotated = {one.get("image_id") for one in content["annotations"]}
    empty = [_photograph(path, name) for number, name in names.items() if number not in annotated]
    if not kept and not empty:
        raise DatasetError(f"{path}: no hand with {_FEWEST_KEYPOINTS} labeled keypoints or more")
    return kept, empty


def _photograph(path: Path, name: str) -> Path:
    """A picture that a file of COCO keypoints names."""
    places = (path.parent / name, path.parent / "images" / name)
    photograph = next((one for one in places if one.is_file()), None)
    if photograph is None:
        raise DatasetError(f"{path}: no photograph {name} beside it or in its folder images")
    return photograph


def _labeled_hand(path: Path, name: str, label: dict[str, Any]) -> LabeledHand:
    with errors_of(path, DatasetError):
        pixels, flags = labeled_keypoints(label)
    side = label.get("side")
    return LabeledHand(
        _photograph(path, name),
        np.where(flags[:, None] > 0.0, pixels, np.nan),
        flags > 1.0,
        SIDES.index(side) if side in SIDES else -1,
    )


def cut_out(
    hand: LabeledHand, size: int, share: float, *, rng: np.random.Generator
) -> dict[str, NDArray[np.generic]]:
    """Cut a square of `size` pixels out of a photograph; a hand's keypoints span a share of it.

    The photograph's border is repeated outside of it. Keypoints and box are in pixels of the square.
    """
    photograph = read_photograph(hand.file)
    low, high = np.nanmin(hand.keypoints, axis=0), np.nanmax(hand.keypoints, axis=0)
    side = max(float((high - low).max()), 1.0) / share
    corner = 0.5 * (low + high - side) + SHIFT_SHARE * rng.uniform(-0.5, 0.5, 2) * (side - (high - low))
    scale = size / side
    shift = -scale * corner + 0.5 * (scale - 1.0)  # OpenCV counts from the centers of pixels
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    if scale < 0.5:  # otherwise fine detail would become noise
        photograph = cv2.GaussianBlur(photograph, (0, 0), 0.4 / scale)
    square = cv2.warpAffine(photograph, matrix, (size, size), borderMode=cv2.BORDER_REPLICATE)
    return {
        "rgb": np.moveaxis(square, 2, 0),
        "keypoints": (hand.keypoints - corner) * scale,
        "visible": hand.visible.copy(),
        "box": np.array([*(low - corner), *(high - low)]) * scale,
        "side": np.array(hand.side, dtype=np.int64),
    }


TakeSource = Take | str | Path


class _Sitting(NamedTuple):
    """One person's pictures."""

    studio: Studio
    subject: Subject
    frames: Integers  # frames of the take, in the order in which they are drawn
    person: int


class PictureStream(SharedStream, IterableDataset[dict[str, torch.Tensor]]):
    """Random pictures of hands with their truth, without end.

    Picture k depends on the seed and k alone. `people` people take turns: picture k shows number k modulo
    `people`, and each of them is replaced by somebody new after `sitting` pictures. Light, background,
    viewpoint and sensors change with every picture.

    It yields dicts of tensors, which the default collate of a `DataLoader` stacks:

    | key | shape and type | what |
    |---|---|---|
    | `rgb`, `noisy_rgb` | (3, H, W) uint8 | sRGB: perfect, and from the simulated sensor |
    | `depth`, `noisy_depth` | (H, W) float32 | along the camera's axis [m], walls included; 0: nothing |
    | `normals` | (3, H, W) float32 | in the camera's axes, 0: nothing |
    | `ids`, `parts`, `markers` | (H, W) uint8 | hand or body, bone, marker; see `RenderedFrame` |
    | `keypoints` | (21, 2) float32 | [px] from the picture's corner, in the picture or not |
    | `keypoints_camera` | (21, 3) float32 | in the camera's axes [m] |
    | `visible` | (21,) bool | whether nothing hides them |
    | `box` | (4,) float32 | left, top, width, height of what is seen [px]; NaN: nothing |
    | `qpos` | (27,) float32 | wrist in the world [m], wxyz; joint angles [rad] |
    | `shape` | (68,) float32 | the numbers of `HandShape`, lengths in [m] |
    | `side` | () int64 | 0 left, 1 right |
    | `K`, `T_world_camera` | (3, 3), (4, 4) float32 | of the camera |
    | `person`, `tone` | () int64, () float32 | who it is; typology angle of the skin [deg], NaN in gloves |
    | `drawn` | () bool | whether it is drawn; False for a photograph of yours |
    | `number` | () int64 | k |

    Pictures of two hands have an axis of hands in the place of the dots: `keypoints` is (2, 21, 2), and so on
    for all that belongs to a hand. The hands are in the order of the poses or the take; one that is absent is
    NaN, and not visible.

    With `photographs`, some of the pictures are your own labeled photographs. All pictures have then what
    photographs have: `rgb` (of the simulated sensor, where there is one), `keypoints` (NaN: no label),
    `visible`, `box`, `side` (-1: unknown), `drawn` and `number`.

    Args:
        sampler: Draws joint angles (T, 20) [rad] or whole poses (T, 27) of one hand, which are made valid: a
            function like `PoseSampler`, its `module:name`, or its entry point. By default handsim's own.
        poses: Poses to draw from at random instead, as `render.draw` takes them.
        takes: Takes to draw frames from at random instead, or their paths.
        model: The hand, or both; another adult with every person when not given. Takes have their own.
        side: Which hand pictures of one hand show, where no model says it: left, right or either.
        config: What is drawn. Of its view only the name of the camera counts; people and light change as
            told above; a depth sensor `auto` is a D435, as hands are near.
        camera: Camera of your own, whose lens, matrix and size count and which is placed around the hand; or
            the name of a preset.
        crop: Size of the picture in pixels [px]: a square around the hand, cut out of what the camera sees by
            a camera of its own, without resampling. The whole picture when not given.
        fill: Least and greatest share of the picture's shorter side that the hand's keypoints span.
        people: Number of people who take turns.
        sitting: Pictures of one person.
        glove: Marker layout on the hands, where the config dresses them in gloves.
        batch: Number of pictures in a row that one worker draws. The batches of a `DataLoader` of this batch
            size are then the same with any number of workers; else it is the pictures, in another order.
            Ranks of torch.distributed take turns like this too, or those that torchrun, srun or mpirun state.
        photographs: File of COCO keypoints of your own photographs (21 a hand, in our order), which are
            beside it or in a folder `images` there; it takes a `crop`.
        photograph_share: Share of the pictures that are photographs.
        start: Number of the first picture, the same for all ranks.
        seed: Seed of all random choices; the config's when not given.

    Raises:
        HandSimError: The arguments do not fit together, a take cannot be drawn, or a sampler returned
            something else than poses.
    """

    def __init__(
        self,
        *,
        sampler: PoseSampler | str | None = None,
        poses: ArrayLike | None = None,
        takes: TakeSource | Sequence[TakeSource] | None = None,
        model: Model | tuple[Model, Model] | None = None,
        side: Literal["left", "right", "either"] = "either",
        config: RenderConfig | None = None,
        camera: Camera | str | None = None,
        crop: int | None = None,
        fill: tuple[float, float] = (0.35, 0.75),
        people: int = 16,
        sitting: int = 128,
        glove: MarkerLayout | str = "dense19",
        batch: int = 1,
        photographs: str | Path | None = None,
        photograph_share: float = 0.25,
        start: int = 0,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        if sum(given is not None for given in (sampler, poses, takes)) > 1:
            raise ArgumentError("expected one of sampler, poses and takes")
        check_type("side", side, str, "left, right or either")
        check_choice(side, _SIDE_CHOICES, noun="side")
        counts = {"people": people, "sitting": sitting, "batch": batch, "start": start}
        for name, count in counts.items():
            check_count(name, count, 0 if name == "start" else 1)
        check_type("fill", fill, (tuple, list), "two numbers")
        if len(fill) != 2 or not 0.05 <= fill[0] <= fill[1] <= 1.0:
            raise ArgumentError(f"fill is {fill}, expected two numbers from 0.05 to 1, the smaller first")
        self.config = resolve(config, {} if seed is None else {"seed": seed}, near=True)
        self.seed = self.config.seed
        self._camera = _checked_camera(self.config.view.camera if camera is None else camera, crop)
        self._crop, self._fill = crop, fill
        self._people, self._sitting, self._batch, self._start = people, sitting, batch, start
        self._model, self._side, self._glove = model, side, glove
        self._sampler = mixed_angles if sampler is None else load_sampler(sampler)
        self._poses = None if poses is None else _checked_poses(poses)
        if takes is not None:
            check_type("takes", takes, (Take, str, Path, list, tuple), "a Take or its path, or several")
        given = (takes,) if isinstance(takes, Take | str | Path) else takes or ()
        self._takes = [
            subject_of(take, model=model, seed=self.seed).upright(self.config.up) for take in given
        ]
        if len({len(one.take.hands) for one in self._takes}) > 1:
            raise ArgumentError("the takes have different numbers of hands, expected the same in all")
        if self.config.shutter is not None and not self._takes:
            raise ArgumentError("poses without times have no motion to blur; leave out the shutter")
        check_number("photograph_share", photograph_share, 0.0, 1.0)
        self._photographs = None if photographs is None else load_labeled_photographs(photographs)[0]
        self._photograph_share = photograph_share
        two = bool(self._takes and len(self._takes[0].take.hands) > 1)
        two |= self._poses is not None and self._poses.ndim == 3
        if self._photographs == []:
            raise DatasetError(f"{photographs}: no picture with a hand, expected labeled ones")
        if photographs is not None and (crop is None or two or "rgb" not in self.config.passes):
            raise ArgumentError("photographs go with a crop, colors, and pictures of one hand")
        cv2.setNumThreads(1)  # forked workers would wait for the threads of this process forever

    @with_own_numerics
    def __iter__(self) -> Iterator[dict[str, torch.Tensor]]:
        mine, shares = self.share()
        if cv2.getNumThreads() > 1:  # this is a spawned worker
            cv2.setNumThreads(1)
        sitting: dict[int, tuple[int, _Sitting]] = {}
        first = self._start + mine * self._batch
        while True:
            for number in range(first, first + self._batch):
                rng = SpawnKey.STREAM.rng(self.seed, _PHOTOGRAPH, number)
                if self._photographs is not None and rng.random() < self._photograph_share:
                    assert self._crop is not None
                    hand = self._photographs[rng.integers(len(self._photographs))]
                    cut = cut_out(hand, self._crop, float(rng.uniform(*self._fill)), rng=rng)
                    yield _tensors(cut | {"drawn": np.array(False), "number": np.array(number)})
                    continue
                place, turn = number % self._people, number // self._people
                turn += place * self._sitting // self._people  # so that people do not change all at once
                person, rank = divmod(turn, self._sitting)
                if place not in sitting or sitting[place][0] != person:
                    sitting[place] = person, self._new_sitting(person * self._people + place)
                picture = self._picture(number, sitting[place][1], rank)
                yield picture if self._photographs is None else _as_photographs(picture)
            first += shares * self._batch

    def _new_sitting(self, person: int) -> _Sitting:
        """A new person, with poses for all of their pictures."""
        rng = SpawnKey.STREAM.rng(self.seed, _PERSON, person)
        if self._takes:
            subject = self._takes[rng.integers(len(self._takes))]
            frames = np.flatnonzero(np.isfinite(subject.take.qpos[..., 0]).any(axis=1))
            frames = rng.choice(frames, self._sitting)
        else:
            subject, frames = self._sample_subject(rng), np.arange(self._sitting)
        hands = subject.take.hands_at(int(frames[0]))  # A person has one pair of hands.
        frames = np.resize([n for n in frames if subject.take.hands_at(int(n)) is hands], len(frames))
        studio = Studio(hands, self.config, subject.take.bodies, rng=rng)
        return _Sitting(studio, subject, frames, person)

    def _sample_subject(self, rng: np.random.Generator) -> Subject:
        """Poses for all pictures of a new person."""
        side: Side = SIDES[rng.integers(2)] if self._side == "either" else self._side
        while True:
            shape = sample_shape(side=side, rng=rng)
            model: Model | tuple[Model, Model] = HandModel(shape) if self._model is None else self._model
            try:
                if self._poses is None:
                    qpos = sample_poses(models_of(model, 1)[0], self._sitting, self._sampler, rng=rng)
                else:
                    qpos = self._poses[rng.integers(len(self._poses), size=self._sitting)]
                break
            except PoseError:  # the fingers of the drawn hand are too thick for its breadth
                if self._model is not None:
                    raise
        if qpos.ndim == 3 and self._model is None:
            model = HandModel(shape.with_side("right"))  # the other hand is its mirror image
        return subject_of_poses(qpos, model=model, glove=self._glove)

    def _picture(self, number: int, sitting: _Sitting, rank: int) -> dict[str, torch.Tensor]:
        rng = SpawnKey.STREAM.rng(self.seed, _PICTURE, number)
        take, shown = sitting.subject.take, int(sitting.frames[rank])
        moment, worn = Moment(take, shown), take.hands_at(shown)
        there = moment.hands()
        keypoints = [hand_keypoints(worn[n].model, pose[None])[0] for n, pose in there.items()]
        points, wrists = np.concatenate(keypoints), np.stack(list(there.values()))
        for _ in range(20):  # until the camera is outside of all surfaces
            share = float(rng.uniform(*self._fill))
            if self._crop is None:
                camera = around_hands(self._camera, points, wrists, share, rng=rng)
            else:
                wide = around_hands(self._camera, points, wrists, share * _CROPPED, rng=rng)
                camera = crop_around(wide, points, share, self._crop, rng=rng)
            with_arms = sitting.studio.with_arms(moment, [camera])
            if sitting.studio.is_clear(with_arms, [camera]):
                break
        skin = sitting.studio.skin
        eye = camera.T_world_camera[:3, 3]
        around = None if camera.lens.kind == "pinhole" else np.stack([eye, points.mean(axis=0)])
        chosen = sample_conditions(self.config, camera.T_world_camera[:3, :3], camera.size, around, rng=rng)
        frame = sitting.studio.photograph(with_arms, camera, chosen.reseeded(rng), recorded=False)
        truth = dict(zip(there, frame.hands, strict=True))
        hands = [_hand_arrays(truth.get(n), camera, fit.shape) for n, fit in enumerate(worn)]
        merged = {name: np.stack([hand[name] for hand in hands]) for name in hands[0]}
        if len(hands) == 1:
            merged = {name: array[0] for name, array in merged.items()}
        tone = np.nan if skin is None else skin.typology_angle
        about = {"person": sitting.person, "tone": tone, "drawn": True, "number": number}
        placed = {"K": camera.K, "T_world_camera": camera.T_world_camera}
        scalars = {name: np.array(value) for name, value in about.items()}
        return _tensors(_picture_arrays(frame) | merged | placed | scalars)


def _as_photographs(picture: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The arrays of a drawn picture that a labeled photograph has, too."""
    kept = {name: picture[name] for name in ("keypoints", "visible", "box", "side", "drawn", "number")}
    return {"rgb": picture.get("noisy_rgb", picture["rgb"])} | kept


def _checked_camera(camera: Camera | str, crop: int | None) -> Camera:
    """The camera that is placed around hands."""
    check_type("camera", camera, (Camera, str), "a Camera or the name of a preset", PRESETS)
    found = preset(camera) if isinstance(camera, str) else camera
    if crop is not None:
        check_type("crop", crop, (int, np.integer), "a number of pixels")
    if crop is not None and (crop < 16 or found.lens.kind != "pinhole"):
        raise ArgumentError(
            f"crop is {crop} and the camera's lens '{found.lens.kind}', expected 16 pixels or more of a "
            "pinhole camera"
        )
    return found


def _checked_poses(poses: ArrayLike) -> Doubles:
    """A user's poses, one in each row."""
    rows = as_numbers("poses", poses)
    if rows.ndim not in {2, 3} or not len(rows):
        raise ArgumentError(f"poses has shape {rows.shape}, expected (T, 20), (T, 27) or (T, 2, 27)")
    return rows


def _picture_arrays(frame: RenderedFrame) -> dict[str, NDArray[np.generic]]:
    """The pictures of a frame, colors and normals with their channels first."""
    ideal, noisy = frame.ideal, frame.noisy
    arrays = {name: getattr(ideal, name) for name in ("rgb", "depth", "normals", "parts", "markers")}
    arrays |= {"noisy_rgb": noisy.rgb, "noisy_depth": noisy.depth, "ids": ideal.instances}
    return {
        name: np.moveaxis(array, 2, 0) if array.ndim == 3 else array
        for name, array in arrays.items()
        if array is not None
    }


def _hand_arrays(hand: HandTruth | None, camera: Camera, shape: HandShape) -> dict[str, NDArray[np.generic]]:
    """The arrays of one hand; NaN for one that is absent."""
    if hand is None:
        nothing = np.full((NUM_KEYPOINTS, 3), np.nan)
        found = {"keypoints": nothing[:, :2], "keypoints_camera": nothing, "box": nothing[:4, 0]}
        found |= {"visible": np.zeros(NUM_KEYPOINTS, dtype=bool), "qpos": np.full(NUM_QPOS, np.nan)}
    else:
        found = {name: getattr(hand, name) for name in ("keypoints", "visible", "box", "qpos")}
        found["keypoints_camera"] = camera.local(hand.keypoints_world)
    numbers = np.concatenate([np.ravel(value) for value in pack_hand(shape)[1:]])
    return found | {"shape": numbers, "side": np.array(SIDES.index(shape.side))}


def _tensors(arrays: dict[str, NDArray[np.generic]]) -> dict[str, torch.Tensor]:
    """Tensors that share the memory of their arrays; float64 becomes float32, which is a copy."""
    return {
        name: torch.from_numpy(np.asarray(array, dtype=np.float32 if array.dtype == np.float64 else None))
        for name, array in arrays.items()
    }
