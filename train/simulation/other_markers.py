"""Markers of others in a take: on the wearer's arms and body, on a thing in the hand, on somebody beside.

They belong to no hand, so that their truth is -1. They move as bodies do: rigidly with a bone, a thing or a
person.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float

from poses.motion.wrist_paths import WristConfig, wrist_path
from train.simulation.motion import SceneMotion

MOST_OTHERS: Final = 60
"""Markers of others at most."""
_STRAIGHT: Final = 0.6  # share of the hand's own direction in the forearm's
_SHOULDER: Final = (0.45, 0.18, 0.25)  # [m] behind the hands, to the side and above them
_WRIST: Final = ((0.03, 0.028, 0.02), (0.035, -0.028, 0.02))  # [m] behind the wrist, across, above
_ALONG_FOREARM: Final = ((0.12, 0.0, 0.03), (0.26, 0.03, 0.02), (0.2, -0.03, 0.02))
_THING: Final = ((0.10, 0.0, -0.06), (0.14, 0.03, -0.09), (0.17, -0.02, -0.07), (0.21, 0.01, -0.12))  # [m]
_HEAD: Final = (
    (0.09, 0.0, 0.25),
    (-0.09, 0.0, 0.25),
    (0.0, 0.08, 0.27),
    (0.0, -0.08, 0.2),
)  # [m] on its middle
_BACK: Final = ((-0.12, 0.05, -0.1), (-0.12, -0.05, -0.25))
_PERSON: Final = 1.2  # [m] to the one beside
_SWAY: Final = 0.03  # [m]
_BODY_SIZE: Final = (0.3, 0.3, 0.7)  # [m] half sides of the box of the other person's markers


def other_markers(scene: SceneMotion, count: int, *, rng: np.random.Generator) -> Float[np.ndarray, "T Q 3"]:
    """So many markers of others [m], those nearest to the hands first.

    Wrists, elbows and shoulders come first, then a thing in a hand, then head and back, then another person.

    Args:
        count: Markers.
    """
    wrists = np.stack([hand.qpos[:, :3] for hand in scene.hands], axis=1)
    ahead = np.stack(
        [hand.fit.model.forward_kinematics(hand.qpos)[:, 0, :3, :3] for hand in scene.hands], axis=1
    )
    middle = wrists.mean(axis=(0, 1))
    front = ahead[..., 0].mean(axis=(0, 1)) * [1.0, 1.0, 0.0] + [1e-6, 0.0, 0.0]
    front /= np.linalg.norm(front)
    trunk = np.stack([front, [-front[1], front[0], 0.0], [0.0, 0.0, 1.0]], axis=1)
    sway = _path(scene, middle, _SWAY, rng) - middle
    back, side, above = _SHOULDER
    arms, bodies = [], []
    for number, hand in enumerate(scene.hands):
        lateral = -side if hand.fit.side == "right" else side
        shoulder = middle + trunk @ [-back, lateral, above] + sway
        arms.append(_arm(wrists[:, number], ahead[:, number], shoulder))
        bodies.append(shoulder[:, None])
    thing = wrists[:, :1] + np.einsum(
        "tij,kj->tki", ahead[:, 0], np.array(_THING) + rng.normal(0.0, 0.01, (4, 3))
    )
    torso = middle + np.array([*_HEAD, *_BACK]) @ trunk.T + trunk @ [-back, 0.0, above] + sway[:, None]
    own = [*[part[:, :3] for part in arms], *bodies, *[part[:, 3:] for part in arms], thing, torso]
    markers = np.concatenate(own, axis=1)
    left = max(0, count - markers.shape[1])
    place = middle + _PERSON * (trunk @ [np.cos(angle := rng.uniform(0.0, 2.0 * np.pi)), np.sin(angle), 0.0])
    person = _path(scene, place, 0.1, rng)[:, None] + rng.uniform(-1.0, 1.0, (left, 3)) * _BODY_SIZE
    return np.concatenate([markers, person], axis=1)[:, :count]


def _arm(
    wrist: Float[np.ndarray, "T 3"], ahead: Float[np.ndarray, "T 3 3"], shoulder: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 5 3"]:
    """Markers beside the wrist's joint and on the forearm [m]: two at the wrist, an elbow, two between."""
    reach = wrist - shoulder
    reach /= np.linalg.norm(reach, axis=1, keepdims=True)
    along = _STRAIGHT * ahead[..., 0] + (1.0 - _STRAIGHT) * reach
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(ahead[..., 2], along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    frame = np.stack([-along, across, np.cross(along, across)], axis=2)
    elbow, *between = _ALONG_FOREARM[1], _ALONG_FOREARM[0], _ALONG_FOREARM[2]
    places = np.array([*_WRIST, elbow, *between])
    markers: Float[np.ndarray, "T 5 3"] = wrist[:, None] + np.einsum("tij,kj->tki", frame, places)
    return markers


def _path(
    scene: SceneMotion, center: Float[np.ndarray, "3"], volume: float, rng: np.random.Generator
) -> Float[np.ndarray, "T 3"]:
    """Slow motion about a place [m]."""
    config = WristConfig(center=tuple(center), volume=volume, turning=0.0)
    return wrist_path(scene.num_frames, scene.rate, config, rng=rng)[0]
