"""The upper body of the person whose hands are drawn: a clothed trunk, a neck, and a head with a simple face.

Shapes are shares of the stature. Lengths and the breadths of hips and shoulders are those of Drillis and
Contini (1966), Body segment parameters; other breadths, depths and girths are near the means of ANSUR II
(2012). Bodies are behind hands and out of focus, so that colors of vertices do without a texture.
"""

from __future__ import annotations

import functools
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from handsim.hand.skin import vertex_normals
from render.fields import bump, noise, smooth
from render.frames import Doubles, Floats, Integers
from render.painting.figures import SCATTER, Appearance, Drawn, Material, linear
from render.painting.rasterizer import Triangles
from render.painting.shading import MIRRORED
from render.skin.look import SkinLook
from render.user_body import UserBody

_AROUND: Final = 56  # vertices of a ring
_HEIGHTS: Final = np.array(
    [
        *np.linspace(-0.82, -0.33, 6),
        *(-0.303, -0.299),  # the hem
        *np.linspace(-0.27, -0.06, 8),
        *np.linspace(-0.05, 0.055, 18),
        *np.linspace(0.058, 0.184, 36),
        *(0.1855, 0.186),
    ]
)
"""Heights of rings above the neck."""
_TRUNK: Final = np.array(
    [
        [-0.82, 0.086, 0.055],
        [-0.5, 0.099, 0.068],
        [-0.4, 0.102, 0.07],
        [-0.29, 0.1, 0.068],
        [-0.21, 0.092, 0.065],
        [-0.12, 0.095, 0.07],
        [-0.06, 0.098, 0.06],
        [-0.02, 0.09, 0.044],
        [0.015, 0.06, 0.03],
    ]
)
"""Sections of the trunk: height above the neck, half of the breadth, half of the depth."""
_SHOULDERS: Final = (np.array([[-0.118, -0.004, -0.014], [0.118, -0.004, -0.014]]), 0.032)
"""Axis and radius of a capsule through both shoulders."""
_NECK: Final = (np.array([[0.0, -0.014, -0.02], [0.0, -0.002, 0.1]]), 0.034)
_HEADS: Final = (
    ((0.0, 0.002, 0.126), (0.043, 0.055, 0.06)),
    ((0.0, 0.018, 0.092), (0.034, 0.037, 0.038)),
    ((0.0, 0.056, 0.1), (0.0075, 0.013, 0.011)),
    ((0.043, -0.002, 0.11), (0.006, 0.01, 0.017)),
    ((-0.043, -0.002, 0.11), (0.006, 0.01, 0.017)),
)
"""Centers and half axes of skull, jaw, nose and ears."""
_SQUARE: Final = 2.5  # exponent of these, which are fuller than ellipsoids (2)
_ARM: Final = np.array(
    [
        [0.1, -0.004, -0.014, 0.03],
        [0.132, -0.016, -0.07, 0.034],
        [0.14, -0.03, -0.18, 0.028],
        [0.11, -0.07, -0.2, 0.028],
        [0.06, -0.09, -0.19, 0.026],
        [0.0, -0.09, -0.18, 0.02],
    ]
)
"""Course and radii of a right arm whose hand is behind the back, as are those that a take does not have."""
_ARM_RINGS: Final = 24
_TO_ELBOW: Final = 0.15  # length of a forearm; longer sleeves cover it
_EYES: Final = 0.117  # height of the eyes
_HAIR: Final = ((18.0, 1.0, 2.0), (22.0, 6.0, 8.0), (32.0, 10.0, 16.0), (55.0, 8.0, 26.0), (62.0, 0.0, 3.0))
"""CIELAB of hair: black to gray."""
_HEM: Final = -0.3  # height of the end of a shirt
_EASE: Final = 0.005  # distance of cloth from the body
_FOLD: Final = 0.0022  # height of its folds
_THICK: Final = 0.005  # thickness of hair


def person_figure(user: UserBody, look: Appearance) -> Drawn:
    """The upper body of a person, as a surface out of focus that casts no shadow."""
    rng = np.random.default_rng(look.skin.seed)
    shape, faces = _surface()
    folds = noise(shape * [1.0, 1.0, 0.7], (0.06, 0.022), rng=rng)
    colors, cloth, hair = _colors(shape, look, folds, rng)
    raised = cloth * (_EASE + _FOLD * folds) + hair * (_THICK + 0.5 * _FOLD * folds)
    shape = shape + raised[:, None] * vertex_normals(shape, faces)
    for mirror in (1.0, -1.0):
        if mirror not in user.mirrors:
            arm, more = _hidden_arm(mirror)
            shown = np.full((len(arm), 1), look.forearm.sleeve < _TO_ELBOW * user.stature)
            shown |= np.arange(len(arm))[:, None] < len(arm) // 3
            rows = np.where(shown, linear(look.forearm.sleeve_color), _skin_color(look.skin))
            faces = np.concatenate([faces, more + len(shape)])
            shape = np.concatenate([shape, arm])
            colors = np.concatenate([colors, np.insert(rows, 3, 1.0, axis=1).astype(np.float32)])
    vertices = user.neck + user.stature * shape @ user.directions
    ids = (np.zeros(len(faces), dtype=np.uint8) for _ in range(3))
    triangles = Triangles(vertices, faces, vertex_normals(vertices, faces), *ids)
    colors[:, :3] += 0.4 * MIRRORED  # of chalk; these factors dim mirrored light, too
    return Drawn(triangles, colors, None, _material, faces[:0], out_of_focus=True)


def _hidden_arm(mirror: float) -> tuple[Doubles, Integers]:
    """Vertices (V, 3) and closed triangles (F, 3) of an arm of the right (1) or the left (-1) side."""
    from scipy.interpolate import PchipInterpolator

    course = PchipInterpolator(np.linspace(0.0, 1.0, len(_ARM)), _ARM)
    along = np.linspace(0.0, 1.0, _ARM_RINGS)
    rows, ahead = course(along), course(along, 1)[:, :3]
    aside = np.cross(ahead, [0.0, 1.0, -1.0])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(ahead, aside)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    turns = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    way = np.cos(turns)[:, None] * aside[:, None] + np.sin(turns)[:, None] * other[:, None]
    rings = (rows[:, None, :3] + rows[:, None, 3:] * way) * [mirror, 1.0, 1.0]
    return _closed(rings[:: int(mirror)])


@functools.cache
def _material() -> Material:
    return Material(np.ones(3), 1.0, scatter=np.array(SCATTER))  # as a sleeve's


@functools.cache
def _surface() -> tuple[Doubles, Integers]:
    """Vertices (V, 3) to the right, ahead and upwards from the neck, and closed triangles (F, 3)."""
    heights = _HEIGHTS
    turns = np.arange(_AROUND) * (2.0 * np.pi / _AROUND)
    way = np.stack([np.sin(turns), np.cos(turns), 0.0 * turns], axis=1)
    middle = np.stack(
        [0.0 * heights, np.interp(heights, [-0.02, 0.02, 0.1], [0.0, -0.012, 0.004]), heights], 1
    )
    far = np.linspace(0.2, 0.004, 50)
    tried = middle[:, None, None] + far[:, None] * way[:, None]
    inside = _distance(tried) < 0.0
    first = np.where(inside.any(axis=2), inside.argmax(axis=2), -1)
    low, high = far[first], far[first - (first > 0)]
    for _ in range(12):
        half = 0.5 * (low + high)
        deep = _distance(middle[:, None] + half[..., None] * way) < 0.0
        low, high = np.where(deep, half, low), np.where(deep, high, half)
    low[first < 0] = 1e-4
    vertices, faces = _closed(middle[:, None] + low[..., None] * way)
    for array in (vertices, faces):
        array.setflags(write=False)
    return vertices, faces


def _closed(rings: Doubles) -> tuple[Doubles, Integers]:
    """Vertices (V, 3) and closed triangles (F, 3) of rings (K, R, 3) that run clockwise from above."""
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    at = np.arange(rings.size // 3).reshape(len(rings), -1)
    on = np.roll(at, -1, axis=1)
    below, above = np.full(at.shape[1], at.size), np.full(at.shape[1], at.size + 1)
    sides = (at[:-1], at[1:], on[:-1]), (on[:-1], at[1:], on[1:])
    corners = (*sides, (below, at[0], on[0]), (above, on[-1], at[-1]))
    return vertices, np.concatenate([np.stack(one, axis=-1).reshape(-1, 3) for one in corners])


def _distance(points: Doubles) -> Doubles:
    """Distance (...) of points (..., 3) from the body's surface, negative inside, about exact near it."""
    x, y, z = np.moveaxis(points, -1, 0)
    wide, deep = (np.interp(z, _TRUNK[:, 0], column) for column in _TRUNK[:, 1:].T)
    trunk = (np.sqrt((x / wide) ** 2 + (y / deep) ** 2) - 1.0) * np.minimum(wide, deep)
    trunk = np.maximum(trunk, z - _TRUNK[-1, 0])
    body = _joined(_joined(trunk, _capsule(points, *_SHOULDERS), 0.03), _capsule(points, *_NECK), 0.035)
    head = np.full(x.shape, np.inf)
    for center, half in _HEADS:
        scaled = np.abs((points - center) / half) ** _SQUARE
        ball = (scaled.sum(axis=-1) ** (1.0 / _SQUARE) - 1.0) * min(half)
        head = ball if np.isinf(head).all() else _joined(head, ball, 0.012)
    return _joined(body, head, 0.01)


def _capsule(points: Doubles, axis: Doubles, radius: float) -> Doubles:
    """Distances (...) of points (..., 3) from the surface of a capsule, negative inside."""
    way = axis[1] - axis[0]
    along = np.clip((points - axis[0]) @ way / (way @ way), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - axis[0] - along[..., None] * way, axis=-1) - radius)


def _joined(one: Doubles, other: Doubles, width: float) -> Doubles:
    """Distance from two surfaces with a hollow of this width filled between them."""
    near = np.maximum(width - np.abs(one - other), 0.0) / width
    return np.asarray(np.minimum(one, other) - 0.25 * width * near**2)


def _colors(
    shape: Doubles, look: Appearance, folds: Floats, rng: np.random.Generator
) -> tuple[Floats, Doubles, Doubles]:
    """Linear colors (V, 4) of the body's vertices, and how much of each is cloth and hair (V,)."""
    x, y, z = shape.T
    skin, up, aside = look.skin, z - _EYES, np.abs(x)
    light, red, yellow = skin.lightness, skin.redness, skin.yellowness
    colors = np.tile(_skin_color(skin), (len(shape), 1))

    def put(share: Doubles, color: Doubles) -> None:
        colors[:] += share[:, None] * (color - colors)

    strands = _rgb(_HAIR[rng.integers(2 if light < 45.0 else len(_HAIR))])
    face, dim, lips = (
        smooth(y, 0.02, 0.035),
        _rgb((light - 20.0, red, yellow)),
        _rgb((light - 12.0, red + 14.0, yellow)),
    )
    for wide, high, place, above, most, color in (
        (0.014, 0.014, 0.026, -0.03, 0.4, _rgb((light - 3.0, red + 8.0, yellow))),  # cheeks
        (0.011, 0.008, 0.018, 0.001, 0.5, dim),  # sockets, brows, eyes, nostrils, mouth
        (0.010, 0.0035, 0.019, 0.0125, 0.8, strands),
        (0.0065, 0.0032, 0.018, 0.0, 0.9, _rgb((18.0, 3.0, 4.0))),
        (0.004, 0.003, 0.004, -0.026, 0.5, dim),
        (0.013, 0.004, 0.0, -0.041, 0.75, lips),
    ):
        put(most * face * bump(aside - place, wide) * bump(up - above, high), color)
    line, nape = 0.158 + 0.05 * aside + rng.uniform(-0.006, 0.006), rng.uniform(0.05, 0.105)
    behind = smooth(0.016 - y - 0.25 * (0.11 - z).clip(0.0), -0.006, 0.006) * smooth(z, nape, nape + 0.012)
    hair = np.maximum(smooth(z - line, -0.006, 0.006), behind)
    put(hair, strands)
    colors *= (
        1.0 + 0.2 * hair * folds - 0.4 * bump(z - 0.05, 0.022) * smooth(0.05 - np.hypot(x, y), 0.0, 0.01)
    )[:, None]  # chins shade necks
    open_neck = smooth(z - 0.015 + 0.6 * (y + 0.012), -0.0015, 0.0015)
    open_neck *= smooth(0.054 - np.hypot(x, y + 0.012), -0.0015, 0.0015)
    cloth = (1.0 - open_neck) * smooth(0.05 - z, 0.0, 0.001) * smooth(z, _HEM - 0.002, _HEM)
    shirt = cv2.cvtColor(np.array([[look.forearm.sleeve_color]], np.float32), cv2.COLOR_RGB2Lab)[0]
    put(cloth, _rgb(shirt + 4.0 * folds[:, None] * np.eye(3)[0]))
    legs = np.array([rng.uniform(12.0, 45.0), rng.uniform(-3.0, 6.0), rng.uniform(-20.0, 8.0)])
    legs = legs - 12.0 * (bump(x, 0.006) * smooth(-z, 0.36, 0.4))[:, None] * np.eye(3)[0]
    put(smooth(_HEM - z, 0.0, 0.002), _rgb(legs))
    rgba = np.concatenate([colors.clip(0.0, 1.0), np.ones((len(shape), 1))], axis=1)
    return rgba.astype(np.float32), cloth, hair


def _skin_color(skin: SkinLook) -> Doubles:
    return _rgb((skin.lightness, skin.redness, skin.yellowness))


def _rgb(lab: ArrayLike) -> Doubles:
    """Linear light (..., 3) of colors in CIELAB."""
    colors = np.atleast_2d(np.asarray(lab, dtype=np.float32)) * np.float32(1.0)
    colors[:, 0] = colors[:, 0].clip(4.0, 100.0)
    return linear(cv2.cvtColor(colors[None], cv2.COLOR_Lab2RGB)[0].clip(0.0, 1.0).astype(np.float64))
