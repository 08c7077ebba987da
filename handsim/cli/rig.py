"""The commands `handsim rig list | new | check | import`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from handsim.app.messages import print_line
from handsim.errors import RigError
from handsim.files.atomic import atomic_write
from handsim.files.outputs import check_outputs
from handsim.space.cameras import CameraRig, list_rigs, load_rig, named_rig, rig_description, save_rig
from handsim.space.rig_formats.any_file import import_cameras

_STARTER: Final = """\
# A camera rig (docs/rigs.md): lengths in meters, z up, the origin on the floor. Edit it, then run
#   handsim rig check FILE
#   handsim rig score FILE

name = "my rig"
description = "Four cameras at the corners of a table."
size = [1280, 1024]  # width and height of the pictures [px]
horizontal_field_of_view = 56.0  # [deg], as data sheets state it; or focal = 1204.0 [px] of a calibration

# One table for each camera, two to thirty-two of them; what it says goes before what stands at the top. Hands
# work around (0, 0, 1.1): place the origin so, or tell `handsim rig score` where they work with --center.

[[camera]]
position = [-1.2, -0.9, 2.2]  # of the lens
target = [0.0, 0.0, 1.1]  # a point in the middle of its picture

[[camera]]
position = [-1.2, 0.9, 2.2]
target = [0.0, 0.0, 1.1]

[[camera]]
position = [1.2, -0.9, 2.2]
target = [0.0, 0.0, 1.1]

[[camera]]
position = [1.2, 0.9, 2.2]
target = [0.0, 0.0, 1.1]
"""


def list_shipped() -> None:
    """List the camera rigs that come with handsim: how many cameras, their pictures, and what they are."""
    table = Table("name", box=None, pad_edge=False)
    table.add_column("cameras", justify="right")
    table.add_column("pictures")
    table.add_column("description")
    for name in list_rigs():
        rig = named_rig(name)
        table.add_row(name, str(len(rig.cameras)), Text(rig.pictures()), Text(rig_description(name)))
    Console().print(table)
    print_line("One of your own: handsim rig new FILE.toml, then handsim rig score FILE.toml.")


def new_rig(file: Annotated[Path, tyro.conf.Positional]) -> None:
    """Write a commented rig file as a start for a rig of your own.

    Args:
        file: A new .toml file.
    """
    if file.suffix.lower() != ".toml":
        raise RigError(f"{file}: expected a file name that ends in .toml")
    if file.exists():
        raise RigError(f"{file} exists already and is left as it is; name a new file")
    with atomic_write(file) as temporary:
        temporary.write_text(_STARTER, "utf-8")
    print_line(f"{file}: edit it, then run `handsim rig check {file}`")


def check_rig(rig: Annotated[str, tyro.conf.Positional]) -> None:
    """Check a rig's file: where its cameras stand and look, and what is suspicious.

    Args:
        rig: A .toml file or a shipped name.
    """
    cameras = load_rig(rig)
    from train.rig_advice.rig_faults import HALF_SIDE, cube_points, faults, pixels_of_a_marker, working_point

    point = working_point(cameras)
    shares = cameras.in_view(cube_points(point, np.full(3, 2 * HALF_SIDE)))
    table = Table("camera", title=Text(f"{cameras.name}: {len(cameras.cameras)} cameras"))
    for column in ("position [m]", "from the middle [m]", "a marker [px]", "of the cube in view [%]"):
        table.add_column(Text(column), justify="right")
    for number, position in enumerate(cameras.positions):
        table.add_row(
            str(number + 1),
            "  ".join(f"{one:.2f}" for one in position + 0.0),
            f"{np.linalg.norm(position - point):.2f}",
            f"{pixels_of_a_marker(cameras, point)[number]:.1f}",
            f"{100 * shares[:, number].mean():.0f}",
        )
    Console().print(table)
    middle = ", ".join(f"{one:.2f}" for one in point + 0.0)
    covered = 100 * (shares.sum(axis=-1) >= 2).mean()
    print_line(
        f"The cameras look at ({middle}) m; {covered:.0f} % of the cube of {2 * HALF_SIDE:g} m around it is "
        "in view of two or more."
    )
    found = faults(cameras)
    for sentence in found:
        print_line(f"Suspicious: {sentence}.")
    if not found:
        print_line(f"Nothing is suspicious. What it sees of hands at work: handsim rig score {rig}")


def import_rig(
    file: Annotated[Path, tyro.conf.Positional], out: Path, up: Literal["y", "z"] | None = None
) -> None:
    """Write a rig's file of the calibration of a camera system: all its cameras, pictures and lenses.

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
    name = "".join(one for one in file.stem if one.isprintable()) or "rig"
    try:
        rig = CameraRig(name, import_cameras(file, up))
    except RigError as error:
        raise RigError(str(error) if str(file) in str(error) else f"{file}: {error}") from error
    save_rig(out, rig)
    table = Table("camera", "name", box=None, pad_edge=False)
    for column in ("position [m]", "picture [px]", "focal length [px]", "lens"):
        table.add_column(Text(column), justify="right", min_width=7)
    for number, camera in enumerate(rig.cameras, 1):
        table.add_row(
            str(number),
            Text(camera.name),
            " ".join(f"{one:.2f}" for one in camera.T_world_camera[:3, 3] + 0.0),
            f"{camera.size[0]} x {camera.size[1]}",
            f"{camera.focal_length:.0f}",
            camera.lens.kind,
        )
    Console().print(table)
    print_line(f"{out}: {len(rig.cameras)} cameras of {rig.pictures()}")


RIG: Final[dict[str, Callable[..., Any]]] = {
    "list": list_shipped,
    "new": new_rig,
    "check": check_rig,
    "import": import_rig,
}
