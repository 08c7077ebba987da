"""The commands `handsim rig list | new | check | import | score | plan`."""

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
from handsim.app.progress import named_steps
from handsim.errors import RigError
from handsim.files.outputs import (
    as_text,
    check_ending,
    check_outputs,
    save_json,
    write_starter,
    written_together,
)
from handsim.space.rig import (
    ROOM_CENTER,
    CameraRig,
    list_rigs,
    load_rig,
    named_rig,
    rig_description,
)
from handsim.space.rig_formats import import_cameras
from train.rig_advice.mounts import MOUNTS, Mount

if TYPE_CHECKING:
    from train.rig_advice.forecast import Forecast

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
    write_starter(file, _STARTER, error=RigError)
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
    check_ending(out, ".toml")
    check_outputs([file], [out])
    name = as_text(file.stem)
    try:
        rig = CameraRig(name, import_cameras(file, up))
    except RigError as error:
        raise RigError(str(error) if str(file) in str(error) else f"{file}: {error}") from error
    rig.save(out)
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


_VOLUME: Final = (0.6, 0.6, 0.6)

_Sides = tuple[float, float, float]


def score_rig_file(
    rig: Annotated[str, tyro.conf.Positional],
    volume: _Sides = _VOLUME,
    center: _Sides | None = None,
    take: Path | None = None,
    glove: str | None = None,
    out: Path | None = None,
    json: Path | None = None,
    num_frames: Annotated[int, tyro.conf.arg(aliases=["--frames"])] = 900,
    seed: int = 0,
) -> None:
    """Forecast what a rig will miss: gaps, ghosts, error, the worth of each camera; nothing is recorded.

    Args:
        rig: A .toml file or a shipped name.
        volume: Sides of the space that hands work in [m].
        center: Its middle [m]; (0, 0, 1.1) when not given, or where the hands of the take are.
        take: A take (.npz) of `handsim track` or `handsim simulate`, whose hands work where they are;
            simulated people when not given.
        glove: Marker layout: a shipped name or the path of a .toml file; dense19 or that of the take when
            not given.
        out: The page, an .html file; named after the rig when not given.
        json: File for the figures.
        num_frames: Frames of every person and kind of work, or of the take.
        seed: Seed of people, motion and cameras' losses.
    """
    cameras = load_rig(rig)
    named = Path(rig).with_suffix(".html") if rig.endswith(".toml") else Path(f"{cameras.name}.html")
    page = named if out is None else out
    check_ending(page, ".html")
    if json is not None:
        check_ending(json, ".json", option="--json")
    check_outputs([rig, take, glove], [page, json])
    from train.rig_advice import scoring
    from train.rig_advice.rig_page import COLUMNS_TOLD, camera_table, work_table, write_rig_page

    with named_steps("getting ready") as step:
        score = scoring.score_rig(
            cameras,
            volume=volume,
            center=center,
            take=take,
            glove=glove,
            num_frames=num_frames,
            seed=seed,
            on_step=step,
        )
    _print(work_table(score))
    _print(camera_table(score))
    print_line(COLUMNS_TOLD)
    axes = " x ".join(f"{1e3 * axis:.3f}" for axis in score.whole.error.axes)
    print_line(f"Error of points: {axes} mm, standard deviations along its axes.")
    for number, sentence in enumerate(score.advice, 1):
        print_line(f"{number}. {sentence}")
    with written_together():
        if json is not None:
            save_json(json, score.record())
        write_rig_page(page, score)
    print_line(f"{page}: what to do, the cameras' worth, a map of the volume")


def plan_rig(
    out: Path,
    cameras: int,
    room: _Sides,
    mounts: tuple[Mount, ...] = MOUNTS,
    volume: _Sides = _VOLUME,
    center: _Sides = ROOM_CENTER,
    keep: str | None = None,
    size: tuple[int, int] = (1280, 1280),
    field_of_view: float = 60.0,
    glove: str = "dense19",
    seed: int = 0,
) -> None:
    """Look for the best places of a number of cameras, for hands at work in a volume.

    Args:
        out: The rig, a .toml file.
        cameras: Number of cameras, with those that are kept.
        room: Width along x, depth along y and height of the room or truss [m]; it stands on the floor, its
            middle below that of the volume.
        mounts: What cameras can hang on: walls, a truss along the room's edges (four beams above and four
            posts), tripods.
        volume: Sides of the space that hands work in [m].
        center: Its middle [m].
        keep: A rig whose cameras stay where they are, a .toml file or a shipped name; the new ones are like
            its first.
        size: Width and height of the new cameras' pictures [px].
        field_of_view: Full opening across the shorter side of these [deg].
        glove: Marker layout: a shipped name or the path of a .toml file.
        seed: Seed of people and motion.
    """
    check_ending(out, ".toml")
    check_outputs([keep, glove], [out])
    from train.rig_advice import planning
    from train.rig_advice.rig_faults import faults

    with named_steps("getting ready") as step:
        planned = planning.plan_rig(
            cameras,
            room,
            mounts=mounts,
            volume=volume,
            center=center,
            camera=planning.plain_camera(size, field_of_view) if keep is None else None,
            keep=keep,
            glove=glove,
            name=as_text(out.stem),
            seed=seed,
            on_step=step,
        )
    table = Table("camera", box=None, pad_edge=False)
    table.add_column(Text("position [m]"), justify="right")
    table.add_column(Text("looks at [m]"), justify="right")
    for number, (position, target) in enumerate(zip(planned.rig.positions, planned.targets, strict=True), 1):
        table.add_row(
            str(number), *("  ".join(f"{one:.2f}" for one in part + 0.0) for part in (position, target))
        )
    Console().print(table)
    if planned.before is not None:
        print_line(f"before: {_forecast_line(planned.before)}")
    print_line(f"after:  {_forecast_line(planned.after)}")
    for sentence in faults(planned.rig):
        print_line(f"Suspicious: {sentence}.")
    planned.rig.save(out)
    print_line(f"{out}: run `handsim rig score {out}`")


def _forecast_line(one: Forecast) -> str:
    return (
        f"two cameras see {100 * one.seen_by_two:.1f} % of the marker-frames of other people, three "
        f"{100 * one.seen_by_three:.1f} %; {100 * one.missing:.1f} % missing, error "
        f"{1e3 * one.error.mean:.3f} mm"
    )


def _print(rows: list[list[str]]) -> None:
    table = Table(box=None, pad_edge=False)
    for number, title in enumerate(rows[0]):
        narrow = title.replace(" [", "\n[").replace("without ", "without\n")  # eighty columns are enough
        table.add_column(Text(narrow), justify="right" if number else "left", no_wrap=True)
    for row in rows[1:]:
        table.add_row(*row)
    Console().print(table)


RIG: Final[dict[str, Callable[..., Any]]] = {
    "list": list_shipped,
    "new": new_rig,
    "check": check_rig,
    "import": import_rig,
    "score": score_rig_file,
    "plan": plan_rig,
}
