"""The picture of docs/angles.md: axes of bones and signs of angles, on hands that `render.draw` draws.

python -m benchmarks.angle_pictures docs/pictures/angles.jpg
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from handsim import Camera, HandModel, join_qpos
from handsim.files.outputs import atomic_write
from handsim.hand.angles import ISB_NAMES, isb_angles
from handsim.hand.shape import BONE_NAMES, JOINT_NAMES, Side
from handsim.pages import own_figures
from handsim.space.camera import look_at
from render import draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE, _FOCAL, _FAR = 360, 900.0, 0.62  # [px], [px], [m]
_CENTER: Final = np.array([0.09, 0.0, 0.0])  # of a flat right hand [m]
_BACK: Final = np.array([-0.05, 0.0, 1.0])
_THUMB: Final = np.array([0.0, 1.0, 0.12])
_TIP: Final = np.array([1.0, 0.35, 0.25])
_COLORS: Final = {"X": "#c8372d", "Y": "#2f8f4e", "Z": "#2b62c9"}
_LENGTH: Final = 0.03  # [m] of an axis
_PANELS: Final[tuple[tuple[str, Side, dict[str, float], NDArray[np.float64], tuple[str, ...]], ...]] = (
    (
        "right hand from the back, X into the page",
        "right",
        {},
        _BACK,
        ("palm", "index_proximal", "thumb_metacarpal"),
    ),
    (
        "left hand: mirrored, equal signs",
        "left",
        {},
        _BACK,
        ("palm", "index_proximal", "thumb_metacarpal"),
    ),
    (
        "index: flexion +",
        "right",
        {"index_MCP_flexion": 40.0, "index_PIP_flexion": 50.0, "index_DIP_flexion": 30.0},
        _THUMB,
        (),
    ),
    (
        "little: ulnar deviation +",
        "right",
        {"little_MCP_abduction": -25.0, "index_MCP_abduction": 18.0},
        _BACK,
        (),
    ),
    ("thumb: radial abduction +", "right", {"thumb_metacarpal_flexion": -35.0}, _BACK, ()),
    ("thumb: palmar abduction +", "right", {"thumb_metacarpal_abduction": 30.0}, _TIP, ()),
)
_SHOWN: Final = {
    2: ("index_MCP_flexion", "index_PIP_flexion", "index_DIP_flexion"),
    3: ("little_MCP_ulnar_deviation", "index_MCP_ulnar_deviation"),
    4: ("thumb_metacarpal_radial_abduction",),
    5: ("thumb_metacarpal_palmar_abduction",),
}
"""The angles of the ISB that stand in a panel."""


def main(path: str) -> None:
    """Draw the picture."""
    with own_figures({}) as new_figure:
        figure = new_figure(figsize=(9.0, 6.4), layout="constrained")
        for number, panel in enumerate(figure.subplots(2, 3).flat):
            _draw_panel(panel, number)
        with atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=100, format="jpg", pil_kwargs={"quality": 82})


def _draw_panel(panel: Axes, number: int) -> None:
    title, side, degrees, direction, bones = _PANELS[number]
    model, mirror = HandModel.named("M", side=side), np.array([1.0, -1.0 if side == "left" else 1.0, 1.0])
    angles = np.zeros((1, len(JOINT_NAMES)))
    for name, value in degrees.items():
        angles[0, JOINT_NAMES.index(name)] = np.deg2rad(value)
    qpos = join_qpos(angles)
    K = np.array([[_FOCAL, 0.0, _SIZE / 2], [0.0, _FOCAL, _SIZE / 2], [0.0, 0.0, 1.0]])
    at = _CENTER + _FAR * direction / np.linalg.norm(direction)
    camera = Camera("view", (_SIZE, _SIZE), K, look_at(at * mirror, _CENTER * mirror))
    (frame,) = draw(qpos, model=model, camera=camera, passes=("rgb",), background="plain", tones=("light",),
                    color_sensor=None, seed=3)  # fmt: skip
    panel.imshow(frame.rgb)
    panel.set_title(title, fontsize=9)
    panel.axis("off")
    frames = model.forward_kinematics(qpos)[0]
    for bone in bones:
        origin, rotation = frames[BONE_NAMES.index(bone)][:3, 3], frames[BONE_NAMES.index(bone)][:3, :3]
        if bone == "palm":
            origin = origin + 0.045 * rotation[:, 0]
        for name, axis in zip(
            "XYZ", (-rotation[:, 2], -rotation[:, 0], rotation[:, 1] * mirror[1]), strict=True
        ):
            start, end = camera.project(np.stack([origin, origin + _LENGTH * axis]))
            panel.annotate(
                "", end, start, arrowprops={"arrowstyle": "-|>", "color": _COLORS[name], "lw": 1.6}
            )
            if np.linalg.norm(end - start) > 20.0:
                panel.annotate(name, end + 0.18 * (end - start), color=_COLORS[name], fontsize=8, ha="center",
                               va="center")  # fmt: skip
    found = dict(zip(ISB_NAMES, np.rad2deg(isb_angles(model.shape, angles)[0]), strict=True))
    lines = [f"{name.replace('_', ' ')} {found[name]:.0f}°" for name in _SHOWN.get(number, ())]
    panel.text(6, _SIZE - 8, "\n".join(lines), fontsize=7.5, va="bottom")


if __name__ == "__main__":
    main(*sys.argv[1:])
