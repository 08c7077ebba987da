"""Paints textures of skin and glove: colors, roughness and a fine relief, on a map of the anatomy.

The anatomy at each texel is computed once per process, on a right hand of size M with its fingers straight.
The relief is a normal map of nails, tendons, knuckles, creases and grain; it changes neither depth nor
silhouettes.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray
from scipy import ndimage

from handsim.hand.model import HandModel
from handsim.hand.shape import DIGITS, NUM_BONES, named_shape
from handsim.hand.skin import all_weights, vertex_normals
from handsim.kernels import kernel
from render.fields import along_segment, bump, noise, smooth
from render.frames import Bytes, Doubles, Floats, Integers, triple
from render.skin.look import CUFF, Forearm, SkinLook, arm_places
from render.skin.mesh import ARM_ROWS, COLUMNS, RINGS, TILE, PosableSkin, ring_vertices, skin_atlas

if TYPE_CHECKING:
    from handsim.hand.shape import Side

REFERENCE: Final = Forearm(length=0.5)
"""The forearm whose texels are painted; a longer one is stretched."""
# The palm's three lines on the reference hand [mm], (x, y) of the wrist's frame: heart, head, life.
_PALM_LINES: Final = (
    ((66.0, -37.0), (73.0, -27.0), (78.0, -14.0), (83.0, 0.0), (91.0, 12.0)),
    ((72.0, 31.0), (71.0, 20.0), (65.0, 5.0), (56.0, -10.0), (46.0, -24.0)),
    ((71.0, 31.0), (66.0, 18.0), (54.0, 8.0), (38.0, 2.0), (20.0, 1.0), (8.0, 5.0)),
)
_WRIST_LINES: Final = (-0.001, -0.009)  # x of the lines across the palm's side of the wrist [m]
_MAX_SLOPE: Final = 0.9  # largest slope of the relief
_SHADOW_LENGTH: Final = 0.006  # length of skin in the shadow of a sleeve [m]
_SHADOW_STRENGTH: Final = 0.4  # share of the lightness that a sleeve's shadow takes
_FOLD_HEIGHT: Final = 0.001  # height of a sleeve's folds [m]
_KNIT_PERIOD: Final = 0.0034  # period of a glove's knit [m]
_WRIST_CREASE: Final = (-0.012, 0.035)  # distances behind the wrist between which the palm's skin ends [m]
_VEIN_WIDTH: Final = 0.0017  # half width of a vein [m]
_CREASE_UNEVENNESS: Final = np.float32(0.03)  # that of the palm's end over that of the pigment's edge [m]
_GRAIN_HEIGHT: Final = 4.5e-5  # height of the relief that breaks gloss [m]: furrows are 20 to 100 um deep
_GRAIN_SIZES: Final = (0.0032, 0.0016, 0.0009)  # wavelengths of this grain [m]
_GRAIN_FADE: Final = (-0.035, 0.005)  # x between which the grain fades in at the wrist [m]
_GRAIN_ROUGHNESS: Final = np.float32(0.05)  # additional roughness of ridges, which are drier than furrows
_INNER_ARM_PIGMENT: Final = 0.8  # pigment of the inner forearm; that of the back of the hand is 1
GLOVE_COLOR: Final = (0.235, 0.25, 0.29)
"""Color of an average glove, sRGB in [0, 1]."""


class DigitTexels(NamedTuple):
    """The texels (K,) of one digit."""

    texels: Integers  # indices of the texture's N texels
    along: Doubles  # distance from the digit's first joint [m]
    angle: Doubles  # angle about the digit from the middle of its back [rad], positive towards the thumb
    share: Doubles  # share of the skin that moves with the digit
    joints: Doubles  # distances of the digit's other two joints and its tip from the first joint (3,) [m]


class Texels(NamedTuple):
    """All N = width x height texels, row by row from the texture's top; unused ones repeat a used one."""

    positions: Doubles  # positions (N, 3) on the reference hand's skin, in the wrist's frame [m]
    normals: Doubles  # outward unit normals (N, 3)
    dorsal: Doubles  # from -1 in the middle of the palm or of a finger's pad to 1 on the back (N,)
    back: Doubles  # 1 on the back of the hand, 0 on the palm, smooth between (N,)
    facing: Doubles  # cosine between the skin's normal and the back's, of the hand or the digit (N,)
    palm: Doubles  # share of the skin that moves with the palm and no digit (N,)
    digits: tuple[DigitTexels, ...]


@functools.cache
def skin_texels() -> Texels:
    """The anatomy at all texels; cached."""
    model, atlas = HandModel.named("M"), skin_atlas()
    mesh = PosableSkin(model, REFERENCE)
    normals = vertex_normals(mesh.rest, mesh.faces)
    weights = np.zeros((atlas.num_vertices, NUM_BONES))
    hand = all_weights(model.surface.bone_indices, model.surface.bone_weights)
    weights[: atlas.num_hand] = hand[atlas.used]
    weights[atlas.num_hand :, 0] = 1.0
    dorsal = np.einsum("vi,vi->v", normals, weights @ model.rest_transforms[:, :3, 2])
    values = np.concatenate([mesh.rest, normals, dorsal[:, None], weights], axis=1)
    grid = _interpolate_to_texels(values)
    positions, normals, dorsal, weights = grid[:, :3], grid[:, 3:6], grid[:, 6], grid[:, 7:]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    digits = []
    for digit in range(len(DIGITS)):
        first = 1 + 3 * digit
        share = weights[:, first : first + 3].sum(axis=1)
        digit_texels = np.flatnonzero(share > 0.02)
        frame = model.rest_transforms[first]
        local = (positions[digit_texels] - frame[:3, 3]) @ frame[:3, :3]
        angle, joints = np.arctan2(local[:, 1], local[:, 2]), np.cumsum(model.shape.bone_lengths[digit])
        digits.append(DigitTexels(digit_texels, local[:, 0], angle, share[digit_texels], joints))
    # The thumb's back faces sideways, but the part of it on the hand's back does not have the palm's skin.
    facing = np.maximum(dorsal, normals[:, 2])
    back, palm = smooth(facing, -0.25, 0.35), weights[:, 0]
    return Texels(positions, normals, dorsal, back, facing, palm, tuple(digits))


def _interpolate_to_texels(values: Doubles) -> Doubles:
    """Interpolate values (U, C) of the drawn vertices linearly to every texel (N, C)."""
    atlas = skin_atlas()
    width, height = atlas.size
    nodes = atlas.tiles.shape[1]
    across = _interpolation_matrix(nodes, TILE)
    tiles = np.einsum("ri,cj,kijn->krcn", across, across, values[atlas.tiles], optimize=True)
    rows = -(-len(tiles) // COLUMNS)
    filler = np.repeat(tiles[-1:], rows * COLUMNS - len(tiles), axis=0)
    tiles = np.concatenate([tiles, filler]).reshape(rows, COLUMNS, TILE, TILE, -1)
    hand = tiles.swapaxes(1, 2).reshape(rows * TILE, width, -1)
    along = _interpolation_matrix(RINGS + 1, ARM_ROWS)
    about = _interpolation_matrix(len(atlas.wrist) + 1, width)
    rings = ring_vertices(atlas.wrist, atlas.num_hand)
    arm = np.einsum("ri,cj,ijn->rcn", along, about, values[rings], optimize=True)
    return np.concatenate([hand, arm]).reshape(width * height, -1)


def _interpolation_matrix(nodes: int, texels: int) -> Doubles:
    """Matrix (texels, nodes) that interpolates linearly between nodes; the first and last are texels, too."""
    position = np.linspace(0.0, nodes - 1.0, texels)
    low = np.minimum(position.astype(int), nodes - 2)
    matrix = np.zeros((texels, nodes))
    matrix[np.arange(texels), low] = 1.0 - (position - low)
    matrix[np.arange(texels), low + 1] = position - low
    return matrix


def behind_wrist(forearm: Forearm) -> Doubles:
    """Distance (N,) of each texel behind the wrist along this forearm [m]; negative on the hand."""
    width, _ = skin_atlas().size
    behind = -skin_texels().positions[:, 0]
    along = _interpolation_matrix(RINGS + 1, ARM_ROWS) @ arm_places(forearm, RINGS)
    behind[-ARM_ROWS * width :] = np.repeat(along, width)
    return behind


def line_depth(rng: np.random.Generator) -> Floats:
    """Depth (N,) of palm lines, finger creases and knuckle wrinkles at each texel; 1 for a deep line."""
    near, palm_lines, wrist_lines = _palm_and_wrist_lines()
    depth = wrist_lines.copy()
    for line in palm_lines:
        depth[near] = np.maximum(depth[near], np.float32(rng.uniform(0.7, 1.05)) * line)
    for number, digit in enumerate(_digit_lines()):
        joints = digit.joints
        phase = rng.uniform(0.0, 6.0)
        waves = np.float32(0.0006 * np.cos(phase)) * digit.sine
        waves += np.float32(0.0006 * np.sin(phase)) * digit.cosine
        # Palmar creases lie off the joints: Bugbee and Botte 1993, Clin. Orthop. Relat. Res. 296:122.
        creases = [(joints[0] - 0.0025, 1.0), (joints[0] + 0.0004, 0.5)]
        if number:
            creases += [(joints[1] - 0.0075, 0.9), (0.017, 0.9)]
        for position, strength in creases:
            _draw_line(digit.along, waves, digit.pad, position, 0.0009, strength, digit.texels, depth)
        for joint, count, spacing in ((joints[0], 5, 0.0020), (joints[1], 4, 0.0014)):
            places = np.arange(count) - (count - 1) / 2
            positions = joint + spacing * places + rng.normal(0.0, 0.0003, count)
            for place, position in zip(places, positions, strict=True):
                bow = digit.arch * np.float32(place / count * 2.0)  # wrinkles are curved
                _draw_line(digit.along, bow, digit.back, position, 0.0006, 0.4, digit.texels, depth)
    return depth


@kernel
def _draw_line(
    along: Floats,
    bent: Floats,
    share: Floats,
    position: float,
    width: float,
    strength: float,
    texels: Integers,
    depth: Floats,
) -> None:
    """Draw a line of this position and width [m] across a digit into the `depth` (N,) of all texels.

    Of the digit's K texels, `along` is the distance from the first joint, `bent` the offset of the line
    there [m], and `share` a factor on the line's strength.
    """
    for n in range(len(texels)):
        away = (along[n] - position - bent[n]) / width
        if abs(away) < 3.0:
            here = np.float32(strength * share[n] * np.exp(-away * away))
            depth[texels[n]] = max(depth[texels[n]], here)


class _DigitLines(NamedTuple):
    """The K texels of a digit that lines are drawn on."""

    texels: Integers
    joints: Doubles  # distances of its other joints [m]
    along: Floats  # distance from its first joint [m]
    sine: Floats  # sine of three times the angle about it
    cosine: Floats  # cosine of three times the angle about it
    arch: Floats  # offset of curved wrinkles [m]
    pad: Floats  # factor on the strength of creases, on the palm's side
    back: Floats  # factor on the strength of wrinkles, on the back


@functools.cache
def _digit_lines() -> tuple[_DigitLines, ...]:
    texels, lines = skin_texels(), []
    for digit in texels.digits:
        back = texels.back[digit.texels]
        on_back = back * digit.share * smooth(np.cos(digit.angle), -0.1, 0.6)
        waves = np.sin(3.0 * digit.angle), np.cos(3.0 * digit.angle), 0.0015 * np.cos(digit.angle)
        parts = (digit.along, *waves, (1.0 - back) * digit.share, on_back)
        lines.append(_DigitLines(digit.texels, digit.joints, *(one.astype(np.float32) for one in parts)))
    return tuple(lines)


@functools.cache
def _palm_and_wrist_lines() -> tuple[Integers, tuple[Floats, ...], Floats]:
    """Texels of the palm (K,), its lines' depths (K,) there, and the depth (N,) of the wrist's lines."""
    texels = skin_texels()
    back = texels.back
    near = np.flatnonzero((texels.dorsal < 0.1) & (texels.positions[:, 0] > -0.02))
    points = texels.positions[near, :2]
    distances = np.full((len(_PALM_LINES), len(near)), np.inf)
    for number, line in enumerate(_PALM_LINES):
        knots = 1e-3 * np.array(line)
        fine = np.linspace(0.0, len(knots) - 1.0, 10 * len(knots))
        knots = np.stack([np.interp(fine, np.arange(len(knots)), knots[:, i]) for i in range(2)], axis=1)
        knots = ndimage.gaussian_filter1d(knots, 4.0, axis=0, mode="nearest")
        for a, b in itertools.pairwise(knots):
            distances[number] = np.minimum(distances[number], along_segment(points, a, b)[1])
    shares = np.zeros((len(texels.digits), len(back)))
    for share, digit in zip(shares, texels.digits, strict=True):
        share[digit.texels] = digit.share
    on_palm = (1.0 - back[near]) * (1.0 - sum(share[near] for share in shares[1:]))
    lines = tuple((on_palm * bump(distance, 0.0011)).astype(np.float32) for distance in distances)
    depth = np.zeros(len(back))
    for position in _WRIST_LINES:
        depth = np.maximum(depth, 0.35 * bump(texels.positions[:, 0] - position, 0.0009) * (1.0 - back))
    return near, lines, depth.astype(np.float32)


def normal_map(height: NDArray[Any], side: Side) -> UInt8[np.ndarray, "H W 3"]:
    """Normal map in the tangent frame of pyrender's shader: along u, and normal x that."""
    width, rows = skin_atlas().size
    across, down = _differences(height.reshape(rows, width, 1))
    row_scale, skew, column_scale = _tangent_scales()
    first = row_scale * across.ravel()
    second = column_scale * down.ravel() - skew * first
    tilt = np.stack([-first, second if side == "left" else -second], axis=1)
    slope = np.linalg.norm(tilt, axis=1, keepdims=True)
    tilt *= np.minimum(1.0, _MAX_SLOPE / np.maximum(slope, 1e-12))
    normals = np.concatenate([tilt, np.ones((len(tilt), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    encoded: Bytes = np.rint(127.5 * (normals + 1.0)).astype(np.uint8)
    return encoded.reshape(rows, width, 3)


def _differences(grid: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Differences per texel to the right and down within each tile, one-sided on its border."""
    rows, width, channels = grid.shape
    hand = rows - ARM_ROWS
    across, down = np.empty_like(grid), np.empty_like(grid)
    tiles = grid[:hand].reshape(hand // TILE, TILE, width // TILE, TILE, channels)
    across[:hand] = np.gradient(tiles, axis=3).reshape(hand, width, channels)
    down[:hand] = np.gradient(tiles, axis=1).reshape(hand, width, channels)
    across[hand:] = np.gradient(grid[hand:], axis=1)
    down[hand:] = np.gradient(grid[hand:], axis=0)
    return across, down


@functools.cache
def relief() -> Doubles:
    """Height (N,) [m] of the relief of every hand: tendons, knuckles, and hollows between them."""
    texels, shape = skin_texels(), named_shape("M")
    back = smooth(texels.dorsal, -0.25, 0.35)  # the back of each digit, also of the thumb
    positions = texels.positions[:, :2]
    height = np.zeros(len(positions))
    knuckles = shape.knuckles[1:, :2]
    for knuckle in knuckles:
        root = np.array([0.1, 0.35]) * knuckle  # tendons meet at the wrist
        along, aside = along_segment(positions, root, knuckle)
        height += 0.00025 * smooth(along, 0.2, 0.8) * bump(aside, 0.0032)
        height += 0.0005 * bump(np.linalg.norm(positions - knuckle, axis=1), 0.0065)
    for hollow in 0.5 * (knuckles[:-1] + knuckles[1:]) + [0.004, 0.0]:
        height -= 0.0004 * bump(np.linalg.norm(positions - hollow, axis=1), 0.0055)
    height *= back * texels.palm
    for digit in texels.digits:
        for joint, high, wide in zip(digit.joints, (0.0005, 0.0003), (0.006, 0.0045), strict=False):
            knob = high * bump(digit.along - joint, wide) * bump(digit.angle, 1.0)
            height[digit.texels] += knob * back[digit.texels] * digit.share
    return height


@functools.cache
def _tangent_scales() -> tuple[Doubles, Doubles, Doubles]:
    """Factors (N,) that turn height differences between texels into slopes along the tangents.

    They are the factor of differences along rows [1/m], the share of the first slope in the second one (tiles
    are not rectangles), and the factor of differences along columns [1/m].
    """
    width, rows = skin_atlas().size
    texels = skin_texels()
    along_row, along_column = (
        difference.reshape(-1, 3) for difference in _differences(texels.positions.reshape(rows, width, 3))
    )
    normals = texels.normals
    first = along_row - (along_row * normals).sum(axis=1, keepdims=True) * normals
    length = np.maximum(np.linalg.norm(first, axis=1), 2e-5)
    first /= length[:, None]
    second = np.cross(normals, first)
    aside, ahead = (along_column * first).sum(axis=1), (along_column * second).sum(axis=1)
    ahead = np.where(np.abs(ahead) < 2e-5, np.copysign(2e-5, ahead), ahead)
    return 1.0 / length, aside / ahead, 1.0 / ahead


class SkinTexture(NamedTuple):
    """Texture of `DrawnSkin.uv`, its top row first."""

    color: UInt8[np.ndarray, "H W 3"]  # sRGB
    roughness: UInt8[np.ndarray, "H W"]  # roughness of the microfacet model, 255 for 1
    normals: UInt8[np.ndarray, "H W 3"]
    """Relief over the drawn normals, see `render.skin.texture.normal_map`."""


class _Paint(NamedTuple):
    """Color, roughness and height of each texel, which painting changes in place."""

    lab: Floats  # CIELAB (N, 3)
    roughness: Floats
    height: Floats  # height of the relief (N,) [m]


def skin_texture(look: SkinLook, forearm: Forearm | None = None, *, side: Side = "right") -> SkinTexture:
    """Paint a skin; equal looks give equal texels."""
    color, roughness, height = _paint_skin(look, forearm)
    return SkinTexture(color, roughness, normal_map(height, side))


@functools.lru_cache(maxsize=2)  # both hands of a person share the painted skin
def _paint_skin(
    look: SkinLook, forearm: Forearm | None
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"], Floats]:
    """Paint the color, the roughness and the height of the relief of a skin."""
    texels, rng = skin_texels(), np.random.default_rng(look.seed)
    # Pigment fades over the sides of fingers and hand, unevenly; relief ends sooner.
    edge = 0.10 * noise(texels.positions, (0.02, 0.006), rng=rng)
    pigment = smooth(texels.facing.astype(np.float32) + edge, -0.8, 0.55)
    # A palm's skin ends at the wrist's crease: the inner forearm is nearly as dark as the outer.
    behind = smooth(edge * _CREASE_UNEVENNESS - texels.positions[:, 0].astype(np.float32), *_WRIST_CREASE)
    pigment = np.maximum(pigment, np.float32(_INNER_ARM_PIGMENT) * behind)
    # The palm of a dark hand is not redder or yellower than other palms: chroma depends on the pigment.
    bare = np.array([look.palm_lightness, 13.0, 16.5])
    whole = np.array([look.lightness, look.redness, look.yellowness])
    lab = bare.astype(np.float32) + pigment[:, None] * (whole - bare).astype(np.float32)
    blood, knuckles = _blood_color()
    lab += np.float32(look.flush) * blood
    lab[:, 0] += np.float32(look.flush * (-1.5 - 0.06 * max(0.0, 60.0 - look.lightness))) * knuckles
    veins = _veins(rng)
    _add_color(lab, look.veins * veins, (-1.6, -1.6, -2.2))
    blotches = noise(texels.positions, (0.05, 0.018, 0.007, 0.003), rng=rng)
    _add_color(lab, look.blotches * blotches, (1.0, -0.6, 0.2))
    weight = 0.8 + 0.4 * noise(texels.positions, (0.014, 0.005), rng=rng)
    lines = np.clip(line_depth(rng) * np.clip(weight, 0.1, 1.2), 0.0, 1.0)
    # Pigment collects in the lines; their darkness depends on the contrast that the skin allows.
    _add_color(lab, look.creases * lines, (-8.5, 4.5, 0.5))
    height = look.relief * relief() - 0.0003 * look.creases * lines + 0.00008 * look.veins * veins
    grain = noise(texels.positions, _GRAIN_SIZES, rng=rng)
    # The stretched texels of the arm would make streaks of the grain.
    grain *= smooth(texels.positions[:, 0].astype(np.float32), *_GRAIN_FADE)
    height += look.relief * _GRAIN_HEIGHT * grain
    rough = np.minimum(look.roughness + 0.1 * (1.0 - texels.back), 1.0).astype(np.float32)
    rough += _GRAIN_ROUGHNESS * np.clip(grain, -1.5, 1.5)
    paint = _Paint(lab, rough, height.astype(np.float32))
    _paint_nails(paint, look)
    if forearm is not None and forearm.sleeve < forearm.length:
        _paint_sleeve(paint, forearm, rng)
    width, rows = skin_atlas().size
    roughness = np.rint(np.float32(255.0) * paint.roughness).astype(np.uint8).reshape(rows, width)
    return lab_to_srgb(paint.lab.reshape(rows, width, 3)), roughness, paint.height


def _add_color(lab: Floats, share: NDArray[Any], color: tuple[float, float, float]) -> None:
    """Add a color to that of each texel (N, 3), times a factor (N,)."""
    for channel, value in enumerate(color):
        lab[:, channel] += np.float32(value) * share


def lab_to_srgb(lab: NDArray[Any]) -> UInt8[np.ndarray, "H W 3"]:
    """Convert CIELAB colors (D65) to sRGB, clipped to its gamut."""
    rgb = cv2.cvtColor(np.asarray(lab, dtype=np.float32), cv2.COLOR_Lab2RGB)
    return np.asarray(np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8))


@functools.cache
def _blood_color() -> tuple[Floats, Floats]:
    """Color that blood adds to CIELAB (N, 3) at a flush of 1, and darkness of knuckles (N,)."""
    texels = skin_texels()
    back = texels.back
    lab, knuckles = np.zeros((len(back), 3)), np.zeros(len(back))
    for number, digit in enumerate(texels.digits):
        first, middle, end = digit.joints
        digit_texels = digit.texels
        tips = smooth(digit.along, middle, end) * digit.share
        lab[digit_texels] += tips[:, None] * [-1.0, 4.0, 0.0]
        for joint, width in ((0.0, 0.010), (first, 0.0075), (middle, 0.006)):
            if number == 0 and joint == 0.0:
                continue  # the thumb's first joint lies deep under the skin
            knuckle = bump(digit.along - joint, width) * back[digit_texels] * np.abs(np.cos(digit.angle / 2))
            lab[digit_texels] += knuckle[:, None] * [0.0, 1.8, 0.3]
            knuckles[digit_texels] += knuckle
    x, y = 1e3 * texels.positions[:, 0], 1e3 * texels.positions[:, 1]
    palm = 1.0 - back
    hollow = np.exp(-(((x - 50.0) / 22.0) ** 2) - (((y + 2.0) / 14.0) ** 2)) * palm
    lab += hollow[:, None] * [1.0, -3.0, 0.8]
    balls = np.exp(-(((x - 88.0) / 9.0) ** 2)) * palm
    balls += np.exp(-(((x - 35.0) / 22.0) ** 2) - (((y + 30.0) / 11.0) ** 2)) * palm
    lab += balls[:, None] * [-0.5, 2.2, 0.0]
    return lab.astype(np.float32), knuckles.astype(np.float32)


def _veins(rng: np.random.Generator) -> Floats:
    """Draw the visibility (N,) of three veins, which wind along the backs of hand and forearm and fade."""
    near, x, y, back = _vein_texels()
    veins = np.zeros(len(skin_texels().back), dtype=np.float32)
    for start in (0.016, -0.004, -0.022):
        knots = np.linspace(-0.17, 0.09, 9)
        course = start + np.cumsum(rng.normal(0.0, 0.0035, 9)) - 0.006
        away = y - np.interp(x, knots, course).astype(np.float32)
        (close,) = np.nonzero(np.abs(away) < 4.0 * _VEIN_WIDTH)
        rows = near[close]
        shown = back[close] * np.interp(x[close], knots, rng.uniform(-0.4, 1.0, 9)).clip(0.0)
        veins[rows] = np.maximum(veins[rows], shown * bump(away[close], np.float32(_VEIN_WIDTH)))
    return veins


@functools.cache
def _vein_texels() -> tuple[Integers, Floats, Floats, Floats]:
    """Texels (K,) that may have veins, their x and y [m], and their share of the back (K,)."""
    texels = skin_texels()
    x, y, back = (values.astype(np.float32) for values in (*texels.positions[:, :2].T, texels.back))
    near = np.flatnonzero((back > 0.5) & (x > -0.16) & (x < 0.085))
    return near, x[near], y[near], back[near]


@functools.cache
def _nails() -> tuple[tuple[Integers, Floats, Floats, Floats], ...]:
    """Texels (K,) of each nail, and their shares of plate (K,) and fold (K,) and the moon's color (K, 3).

    Shares are from 0 to 1. The color is added to CIELAB and includes that of the free edge.
    """
    nails = []
    for number, digit in enumerate(skin_texels().digits):
        joint, tip = digit.joints[1:]
        start, end = joint + 0.34 * (tip - joint), tip - 0.0012
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        wide = 1.0 if number else 1.12
        a = (digit.along - middle) / half
        b = digit.angle / wide
        where = np.abs(b) < 1.6
        shape = (np.abs(a) ** 3.2 + np.abs(b) ** 3.2) ** (1 / 3.2)
        plate = (1.0 - smooth(shape, 0.88, 1.04)) * where
        fold = bump(shape - 1.07, 0.10) * where * smooth(-a, -0.7, 0.5)  # there is no fold at the tip
        moon = (bump(a + 1.0, 0.42) * bump(b, 0.55))[:, None] * [4.0, -4.0, -1.0]
        moon += smooth(a, 0.72, 0.86)[:, None] * [8.0, -7.0, 1.0]
        near = np.flatnonzero((plate > 0.0) | (fold > 1e-4))
        parts = [part[near].astype(np.float32) for part in (plate, fold, moon)]
        nails.append((digit.texels[near], parts[0], parts[1], parts[2]))
    return tuple(nails)


def _paint_nails(paint: _Paint, look: SkinLook) -> None:
    """Paint nails: plates pinker and smoother than the skin, pale moons, whiter free edges, dark folds."""
    bed = np.array([look.lightness, look.redness, look.yellowness]) * [0.7, 0.5, 0.6]
    bed += np.array([68.0, 12.0, 13.0]) * [0.3, 0.5, 0.4]  # beds hold little pigment, as palms do
    for nail_texels, plate, fold, moon in _nails():
        color = (bed + look.nail).astype(np.float32) + moon
        color += np.float32(look.polish) * (np.array(look.polish_color, dtype=np.float32) - color)
        lab = paint.lab[nail_texels]
        lab += plate[:, None] * (color - lab)
        _add_color(lab, look.creases * fold, (-4.5, 3.0, 0.0))
        paint.lab[nail_texels] = lab
        paint.roughness[nail_texels] += plate * (np.float32(0.28) - paint.roughness[nail_texels])
        paint.height[nail_texels] *= 1.0 - plate
        paint.height[nail_texels] += 0.00016 * plate - 0.0002 * fold


def _paint_sleeve(paint: _Paint, forearm: Forearm, rng: np.random.Generator) -> None:
    """Paint a sleeve over the forearm, with folds as darker and lighter bands."""
    behind = behind_wrist(forearm).astype(np.float32) - np.float32(forearm.sleeve)
    cloth = smooth(behind, 0.0, CUFF)
    color = cv2.cvtColor(np.array([[forearm.sleeve_color]], dtype=np.float32), cv2.COLOR_RGB2Lab)[0, 0]
    folds = noise(skin_texels().positions * [0.5, 1.0, 1.0], (0.03, 0.012), rng=rng)
    for channel in range(3):
        painted = color[channel] + (4.0 * folds if channel == 0 else 0.0)
        paint.lab[:, channel] += cloth * (painted - paint.lab[:, channel])
    inside = smooth(behind, -_SHADOW_LENGTH, 0.0) * (1.0 - smooth(behind, 0.5 * CUFF, CUFF))
    paint.lab[:, 0] *= 1.0 - np.float32(_SHADOW_STRENGTH) * inside
    paint.roughness[:] += cloth * (1.0 - paint.roughness)
    paint.height[:] += cloth * (np.float32(_FOLD_HEIGHT) * folds - paint.height)


@dataclass(frozen=True, slots=True)
class GloveLook:
    """A glove's cloth in plain values."""

    color: tuple[float, float, float] = GLOVE_COLOR  # sRGB in [0, 1]
    cuff: float = 0.04  # end of the cuff, behind the wrist [m]
    roughness: float = 0.85
    wear: float = 1.0  # unevenness of the cloth, 1 for a used glove
    seed: int = 0


def sample_glove_look(*, rng: np.random.Generator) -> GloveLook:
    """Draw a random glove, dark as marker gloves are, so that the markers stand out."""
    gray = rng.uniform(0.05, 0.32)
    return GloveLook(
        triple(np.clip(gray * np.exp(rng.normal(0.0, 0.12, 3)), 0.02, 0.4)),
        float(rng.uniform(0.015, 0.07)),
        float(rng.uniform(0.7, 0.95)),
        float(rng.uniform(0.4, 1.4)),
        int(rng.integers(2**31)),
    )


def glove_texture(
    look: GloveLook, skin: SkinTexture, forearm: Forearm | None = None, *, side: Side = "right"
) -> SkinTexture:
    """Paint a glove over painted skin; only the forearm behind the cuff stays visible."""
    texels, rng = skin_texels(), np.random.default_rng(look.seed)
    width, rows = skin_atlas().size
    arm = REFERENCE if forearm is None else forearm
    behind = behind_wrist(arm)
    lab = cv2.cvtColor(np.array([[look.color]], dtype=np.float32), cv2.COLOR_RGB2Lab)[0, 0]
    cloth = noise(texels.positions, (0.02, 0.006, 0.0025), rng=rng)
    knit = np.sin((2.0 * np.pi / _KNIT_PERIOD) * texels.positions).sum(axis=1)
    hem = bump(behind - look.cuff + 0.004, 0.0015)
    painted = lab + (look.wear * 2.0 * cloth + 1.2 * knit - 5.0 * hem)[:, None] * [1.0, 0.0, 0.0]
    height = look.wear * 1.2e-4 * cloth + 6e-5 * knit - 4e-4 * hem
    cloth_share = 1.0 - smooth(behind, look.cuff, look.cuff + CUFF)
    cloth_share *= 1.0 - smooth(behind, arm.sleeve, arm.sleeve + CUFF)  # a sleeve lies over the cuff
    cloth_share = cloth_share.reshape(rows, width, 1)
    covered = cloth_share > 0.5
    cloth_color = lab_to_srgb(painted.reshape(rows, width, 3)).astype(np.float64)
    rough = np.uint8(round(255.0 * look.roughness))
    return SkinTexture(
        np.rint(skin.color + cloth_share * (cloth_color - skin.color)).astype(np.uint8),
        np.where(covered[..., 0], rough, skin.roughness),
        np.where(covered, normal_map(height, side), skin.normals),
    )
