from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gloves import Attachment, load_layout
from gloves.fit import attach_markers
from handsim import Camera, HandModel, join_qpos, look_at
from handsim.hand.model import hand_keypoints
from handsim.hand.shape import Side
from handsim.space.camera import pinhole
from render import BodyTruth, HandTruth, Pictures, RenderedFrame
from render.frames import PARTS_A_HAND

SIZE = (96, 72)
EYE = np.array([0.2, -0.55, 0.35])


@pytest.fixture(scope="session")
def model() -> HandModel:
    return HandModel.named("M")


@pytest.fixture(scope="session")
def attachment(model: HandModel) -> Attachment:
    return attach_markers(load_layout("dense19"), model)


MakeFrame = Callable[..., RenderedFrame]


@pytest.fixture
def camera() -> Camera:
    """A small pinhole camera whose axes are no axes of the world."""
    return pinhole("small", SIZE, 80.0, (47.3, 36.9)).at(look_at(EYE, np.array([0.07, 0.0, 0.02])))


@pytest.fixture
def make_frame(camera: Camera) -> MakeFrame:
    """Makes frames without OpenGL: every vertex of the skin is a small square in the pictures."""

    def make(
        number: int = 0,
        sides: tuple[Side, ...] = ("right",),
        *,
        camera: Camera = camera,
        noisy: bool = False,
        away: bool = False,
    ) -> RenderedFrame:
        rng = np.random.default_rng([number, len(sides)])
        hands, pictures = [], _blank(camera.size, rng)
        for place, side in enumerate(sides):
            hands.append(_hand(pictures, camera, place, side, rng, away=away))
        nothing = Pictures()
        sensed = Pictures(rgb=255 - pictures.rgb, depth=(1.01 * pictures.depth).astype(np.float32))
        body = BodyTruth("pen", look_at(np.array([0.1, 0.2, 0.3]), np.zeros(3)))
        return RenderedFrame(
            number=number,
            time=number / 60,
            camera=camera,
            hands=tuple(hands),
            bodies=(body,),
            ideal=pictures,
            noisy=sensed if noisy else nothing,
            points=rng.normal(size=(4, 3)),
            labels=np.array([1, 0, -1, 1]),
            label_names=("first", "second"),
            choices={"light": {"strength": np.float64(1.5), "direction": (0.0, 1.0, np.nan)}},
        )

    return make


def _blank(size: tuple[int, int], rng: np.random.Generator) -> Pictures:
    shape = size[::-1]
    return Pictures(
        rgb=np.full((*shape, 3), rng.integers(0, 255, 3), dtype=np.uint8),
        depth=np.zeros(shape, dtype=np.float32),
        normals=np.zeros((*shape, 3), dtype=np.float32),
        parts=np.zeros(shape, dtype=np.uint8),
        instances=np.zeros(shape, dtype=np.uint8),
        markers=np.zeros(shape, dtype=np.uint8),
    )


def _hand(
    pictures: Pictures, camera: Camera, place: int, side: Side, rng: np.random.Generator, *, away: bool
) -> HandTruth:
    model = HandModel.named("M", side=side)
    turn = rng.normal(size=(1, 4))
    spot = np.array([[9.0 if away else 0.02, 0.12 * place - 0.04, 0.0]])
    qpos = join_qpos(rng.uniform(-0.1, 0.6, (1, 20)), position=spot, quaternion=turn / np.linalg.norm(turn))
    vertices = model.skin(qpos)[0].astype(np.float32)
    bones = model.surface.bone_indices[:, 0]
    pixels = np.floor(np.nan_to_num(camera.project(vertices), nan=-9.0)).astype(int)
    depth = camera.local(vertices)[:, 2]
    mine = np.zeros(camera.size[::-1], dtype=bool)
    inside = ((pixels >= 1) & (pixels < np.array(camera.size) - 1)).all(axis=1)
    drawn = np.argsort(np.where(inside, -depth, np.inf))[: inside.sum()]  # the nearest last, which stays
    columns, rows = pixels[drawn].T[..., None, None]
    square = np.arange(-1, 2)
    patch = rows + square[:, None], columns + square
    bone = bones[drawn][:, None, None]
    pictures.rgb[patch] = np.stack(np.broadcast_arrays(200, 120 + 2 * bone, 90), axis=-1)
    pictures.depth[patch] = depth[drawn][:, None, None]
    pictures.normals[patch] = (0.6, 0.0, -0.8)
    pictures.parts[patch] = 1 + bone + PARTS_A_HAND * place
    pictures.instances[patch] = 1 + place
    mine[patch] = True
    rows, columns = np.nonzero(mine)
    box = np.full(4, np.nan)
    if rows.size:
        box = np.array([columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1], dtype=float)
    keypoints = hand_keypoints(model, qpos)[0]
    places = camera.project(keypoints)
    inside = ((places >= 0) & (places < camera.size)).all(axis=1)
    return HandTruth(
        shape=model.shape,
        qpos=qpos[0],
        keypoints=places,
        keypoints_world=keypoints,
        visible=inside & (np.arange(21) % 3 > 0),
        box=box,
        mask=mine,
        vertices=vertices,
        marker_names=("first", "second") if place == 0 else (),
        markers=keypoints[[5, 9]] if place == 0 else np.empty((0, 3)),
    )
