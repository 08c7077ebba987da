"""The command `handsim rig import`: a rig's file of the calibration that another program wrote."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from handsim.app.messages import print_line
from handsim.errors import RigError
from handsim.files.outputs import check_outputs
from handsim.space.cameras import CameraRig, save_rig
from handsim.space.rig_formats.any_file import load_lab_cameras
from handsim.space.rig_formats.rig_of_cameras import corner_distortion, marker_cameras, rig_of_cameras

if TYPE_CHECKING:
    from handsim.space.camera import Camera


def import_rig(
    file: Annotated[Path, tyro.conf.Positional], out: Path, up: Literal["y", "z"] | None = None
) -> None:
    """Write a rig's file of the calibration of a camera system, and tell what a rig leaves out.

    Args:
        file: Vicon's .xcp, Qualisys' calibration (.xml or .txt), Motive's .mcal, OpenCV's .yml or .json with
            intrinsics and extrinsics, or COLMAP's cameras.txt and images.txt.
        out: The rig, a .toml file.
        up: The axis that points up in the calibration; y for Motive and z for the others when not given.
            The rig's is z.
    """
    if out.suffix.lower() != ".toml":
        raise RigError(f"--out is {out}, expected a file name that ends in .toml")
    check_outputs([file], [out])
    cameras = marker_cameras(file, load_lab_cameras(file))
    rig = rig_of_cameras(file, cameras, up)
    save_rig(out, rig)
    _show(rig, [one.camera for one in cameras])
    print_line(
        f"{out}: {len(cameras)} cameras, field of view {np.rad2deg(rig.field_of_view):.1f} degrees, "
        f"{rig.resolution} pixels across it"
    )


def _show(rig: CameraRig, cameras: list[Camera]) -> None:
    table = Table("camera", "name", box=None, pad_edge=False)
    for column in ("position [m]", "picture [px]", "focal length [px]", "distortion at a corner [px]"):
        table.add_column(Text(column), justify="right", min_width=7)
    for number, (camera, position) in enumerate(zip(cameras, rig.positions, strict=True), 1):
        table.add_row(
            str(number),
            Text(camera.name),
            " ".join(f"{one:.2f}" for one in position + 0.0),
            f"{camera.size[0]} x {camera.size[1]}",
            f"{np.sqrt(camera.K[0, 0] * camera.K[1, 1]):.0f}",
            f"{corner_distortion(camera):.1f}",
        )
    Console().print(table)


RIG: Final[dict[str, Callable[..., Any]]] = {"import": import_rig}
