"""The commands `handsim rig list | new | check | import | score | plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from handsim.app.messages import named_steps, print_line, print_table
from handsim.errors import RigError
from handsim.files.outputs import (
    as_text,
    check_ending,
    check_outputs,
    save_json,
    write_starter,
    written_together,
)
from handsim.pages import coordinates
from handsim.space.rig import CameraRig, list_rigs, load_rig, rig_description
from handsim.space.rig_formats import import_cameras
from handsim.space.transforms import UpAxis
from train.forecast.settings import PlanRigSettings, ScoreRigSettings

if TYPE_CHECKING:
    from train.forecast.rig_forecast import Forecast


def list_rig() -> None:
    """List the camera rigs that come with handsim: how many cameras, their pictures, and what they are."""
    rigs = [(name, load_rig(name)) for name in list_rigs()]
    rows = [(name, str(len(rig.cameras)), rig.pictures(), rig_description(name)) for name, rig in rigs]
    print_table([("name", "cameras", "pictures", "description"), *rows], left=4, wraps=True)
    print_line("One of your own: handsim rig new FILE.toml, then handsim rig score FILE.toml.")


def new_rig(file: Annotated[Path, tyro.conf.Positional]) -> None:
    """Write a commented rig file as a start for a rig of your own.

    Args:
        file: A new .toml file.
    """
    write_starter(
        file, (Path(__file__).parents[1] / "data" / "starter_rig.toml").read_text("utf-8"), error=RigError
    )
    print_line(f"{file}: edit it, then run `handsim rig check {file}`")


def check_rig(rig: Annotated[str, tyro.conf.Positional]) -> None:
    """Check a rig's file: where its cameras stand and look, and what is suspicious.

    Args:
        rig: A .toml file or a shipped name.
    """
    from train.forecast import rig_score
    from train.forecast.rig_forecast import HALF_SIDE

    cameras = load_rig(rig)
    point, side = rig_score.working_point(cameras), 2 * HALF_SIDE
    shares = cameras.in_view(rig_score.cube_points(point, side))
    pixels = rig_score.pixels_of_a_marker(cameras, point)
    rows = [["camera", "position [m]", "from the middle [m]", "a marker [px]", "of the cube in view [%]"]]
    for number, position in enumerate(cameras.positions):
        away = f"{np.linalg.norm(position - point):.2f}"
        share = f"{100 * shares[:, number].mean():.0f}"
        rows.append([str(number + 1), coordinates(position, "  "), away, f"{pixels[number]:.1f}", share])
    print_table(rows, title=f"{cameras.name}: {len(cameras.cameras)} cameras")
    covered = 100 * (shares.sum(axis=-1) >= 2).mean()
    print_line(
        f"The cameras look at ({coordinates(point, ', ')}) m; {covered:.0f} % of the cube of "
        f"{side:g} m around it is in view of two or more."
    )
    fine = f"Nothing is suspicious. What it sees of hands at work: handsim rig score {rig}"
    print_line(*(_suspicions(cameras) or [fine]))


def _suspicions(rig: CameraRig) -> list[str]:
    from train.forecast.rig_score import faults

    return [f"Suspicious: {sentence}." for sentence in faults(rig)]


def import_rig(file: Annotated[Path, tyro.conf.Positional], out: Path, up: UpAxis | None = None) -> None:
    """Write a rig's file of the calibration of a camera system: all its cameras, pictures and lenses.

    Args:
        file: Vicon's .xcp, Qualisys' calibration (.xml or .txt), Motive's .mcal, OpenCV's .yml or .json with
            intrinsics and extrinsics, Pose2Sim's .toml, or the folder of COLMAP's cameras and images.
        out: The rig, a .toml file.
        up: The axis that points up in the calibration; y for Motive and z for the others when not given.
            In the rig z points up.
    """
    check_outputs([file], [out], ".toml")
    try:
        rig = CameraRig(as_text(file.stem), import_cameras(file, up))
    except RigError as error:
        raise RigError(str(error) if str(file) in str(error) else f"{file}: {error}") from error
    rig.save(out)
    rows = [["camera", "name", "position [m]", "picture [px]", "focal length [px]", "lens"]]
    for number, camera in enumerate(rig.cameras, 1):
        place = coordinates(camera.T_world_camera[:3, 3])
        size = f"{camera.size[0]} x {camera.size[1]}"
        rows.append([str(number), camera.name, place, size, f"{camera.focal_length:.0f}", camera.lens.kind])
    print_table(rows, left=2, wraps=True)
    print_line(f"{out}: {len(rig.cameras)} cameras of {rig.pictures()}")


def score_rig(
    rig: Annotated[str, tyro.conf.Positional],
    settings: Annotated[ScoreRigSettings, tyro.conf.arg(name="")],
    out: Path | None = None,
    json: Path | None = None,
) -> None:
    """Forecast what a rig will miss: gaps, ghosts, error, the worth of each camera; nothing is recorded.

    Args:
        rig: A .toml file or a shipped name.
        settings: What hands do before it.
        out: The page, an .html file; named after the rig when not given.
        json: File for the figures.
    """
    cameras = load_rig(rig)
    named = Path(rig).with_suffix(".html") if rig.endswith(".toml") else Path(f"{cameras.name}.html")
    page = named if out is None else out
    check_ending(page, ".html")
    if json is not None:
        check_ending(json, ".json", option="--json")
    check_outputs([rig, settings.take, settings.glove], [page, json])
    from train.forecast import rig_score

    with named_steps("") as step:
        score = rig_score.score_rig(cameras, settings, on_step=step)
    for header, *rows in (rig_score.work_table(score), rig_score.camera_table(score)):
        print_table([[header[0].replace(" ", "\n"), *header[1:]], *rows])
    print_line(rig_score.COLUMNS_TOLD)
    axes = " x ".join(f"{1e3 * axis:.3f}" for axis in score.whole.error.axes)
    print_line(f"Error of points: {axes} mm, standard deviations along its axes.")
    print_line(*(f"{number}. {sentence}" for number, sentence in enumerate(score.advice, 1)))
    with written_together():
        if json is not None:
            save_json(json, score.record())
        rig_score.write_rig_page(page, score)
    print_line(f"{page}: what to do, the cameras' worth, a map of the volume")


def plan_rig(
    out: Path,
    cameras: int,
    room: tuple[float, float, float],
    settings: Annotated[PlanRigSettings, tyro.conf.arg(name="")],
) -> None:
    """Look for the best places of a number of cameras, for hands at work in a volume.

    Args:
        out: The rig, a .toml file.
        cameras: Number of cameras, with those that are kept.
        room: Width along x, depth along y and height of the room or truss [m]; it stands on the floor, its
            middle below that of the volume.
        settings: Where hands work, and what cameras can hang on.
    """
    check_outputs([settings.keep, settings.glove], [out], ".toml")
    from train.forecast import rig_plan

    with named_steps("") as step:
        planned = rig_plan.plan_rig(cameras, room, settings, name=as_text(out.stem), on_step=step)
    rows = [["camera", "position [m]", "looks at [m]"]]
    for number, places in enumerate(zip(planned.rig.positions, planned.targets, strict=True), 1):
        rows.append([str(number), *(coordinates(place, "  ") for place in places)])
    print_table(rows)
    if planned.before is not None:
        print_line(f"before: {_forecast_line(planned.before)}")
    print_line(f"after:  {_forecast_line(planned.after)}")
    print_line(*_suspicions(planned.rig))
    planned.rig.save(out)
    print_line(f"{out}: run `handsim rig score {out}`")


def _forecast_line(one: Forecast) -> str:
    return (
        f"two cameras see {100 * one.seen_by_two:.1f} % of the marker-frames of other people, three "
        f"{100 * one.seen_by_three:.1f} %; {100 * one.missing:.1f} % missing, error "
        f"{1e3 * one.error.mean:.3f} mm"
    )
