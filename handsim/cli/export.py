"""The command `handsim export`: takes and labelers as files of other programs, by the ending of the file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from handsim.app.messages import print_line
from handsim.cli.options import neutral_pose
from handsim.errors import ArgumentError, CaptureError
from handsim.files.outputs import check_outputs
from handsim.space.transforms import ForwardAxis, UpAxis


def export(
    source: Annotated[str, tyro.conf.Positional],
    out: Path | None = None,
    fps: float | None = None,
    up: UpAxis = "z",
    forward: ForwardAxis | None = None,
    neutral: tuple[str, ...] | None = None,
    guesses: bool = False,
    scene: Path | None = None,
    frame: int | None = None,
) -> None:
    """Write the motion of a take, a user's hand, or a trained labeler, for other programs.

    Args:
        source: A take (.npz, of `handsim track` or the .truth.npz of `handsim simulate`); a user's file
            (.json); or a labeler, by the name of a glove with a shipped one or the folder of a trained one.
        out: The file. Of a take .glb (skinned and animated), .bvh, .usda or .usdc, .csv (joint angles
            and positions), .trc (joint positions) or .mot (joint angles for OpenSim); of a user .xml
            (MuJoCo), .urdf, .osim (OpenSim) or .glb; of a labeler .onnx, which labels without torch.
        fps: Frames per second of the file, such as 30 or 60 for a game; those of the take when not given.
        up: The axis of the take that points up; y for captures of Motive's default. Files have y up, but
            .usda, .usdc and .csv have the take's axes.
        forward: The axis of the take that is forward in the room, as forward= in an address of --send: it
            becomes -z, as in OpenXR, or y of a .usdc with z up. When not given, y if z points up, else -z.
        neutral: First and last time [s] at which the hands are flat, or in another pose in which the angles
            of the ISB in a .csv are to be zero; or the take (.npz) of a trial that shows this pose.
        guesses: Whether a .csv has numbers, too, for joints beyond which no marker was seen.
        scene: Instead of --out, a file (.usdc, .usda) of what a picture of a take shows by default: skin with
            textures, lamps, camera and background, for path tracers (docs/rendering.md).
        frame: Number of this frame; the first with a hand when not given.
    """
    from gloves.takes.archives import GROWING_SUFFIX
    from track.user import load_user

    if (out is None) == (scene is None) or (frame is not None and scene is None):
        raise ArgumentError("expected --out, or --scene and maybe --frame")
    if scene is not None:
        if fps is not None or forward is not None or neutral is not None or guesses:
            given = "--fps, --forward, --neutral or --guesses"
            raise ArgumentError(f"given {given} and --scene, expected --out with them")
        _export_scene(Path(source), scene, frame, up)
        return
    assert out is not None
    if source.lower().endswith((".npz", f".npz{GROWING_SUFFIX}")):
        _export_take(Path(source), out, fps, neutral or (), up=up, forward=forward, guesses=guesses)
        return
    if fps is not None or up != "z" or forward is not None or neutral is not None or guesses:
        given = f"--forward {forward}" if forward is not None else f"--up {up}"
        given = f"--neutral {' '.join(neutral)}" if neutral else given
        given = f"--fps {fps:g}" if fps is not None else "--guesses" if guesses else given
        raise ArgumentError(f"given {given} and {source}, expected a take with it, whose motion is written")
    if source.lower().endswith(".json"):
        check_outputs([source], [out])
        user = load_user(source)
        user.export(out)
        print_line(f"{out}: {user.of_side().side} hand of {source}; handsim hand --shape has more options")
    else:
        _export_labeler(source, out)


def _export_take(source: Path, out: Path, fps: float | None, neutral: Sequence[str], **options: Any) -> None:
    from gloves.takes.motion_formats import motion_format
    from gloves.takes.take import load_take, poses_for

    form = motion_format(out)
    check_outputs([source, *neutral], [out])
    take = load_take(source)
    if not np.isfinite(take.qpos[..., 0]).any():
        raise CaptureError(f"{source}: there is no hand in any frame, expected one to export")
    motion = poses_for(form, take, fps)
    take.export(out, rate=fps, neutral=neutral_pose(neutral), **options)
    sides = " and ".join(motion.sides)
    things = "".join(f", {body.name}" for body in motion.bodies)
    print_line(
        f"{out}: {sides} hand{'s' * (len(motion.hands) > 1)}{things}; {motion.num_frames} frames at "
        f"{motion.rate:g} Hz"
    )
    for side, absent in zip(motion.sides, np.isnan(motion.qpos[..., 0]).sum(axis=0), strict=True):
        if absent:
            print_line(f"{side} hand: without a pose in {absent} frames, {form.without_pose} there")


def _export_scene(source: Path, scene: Path, frame: int | None, up: UpAxis) -> None:
    from render.scene_file import write_scene

    check_outputs([source], [scene])
    write_scene(scene, source, frame=frame, up=up)
    print_line(f"{scene}: what the picture of a frame shows; textures are in {scene.with_suffix('')}")


def _export_labeler(source: str, out: Path) -> None:
    from gloves.captures.formats import READABLE
    from gloves.takes.motion_formats import MOTION_FORMATS
    from train.labelers.storage import export_onnx, load_network

    if Path(source).suffix.lower() in READABLE:
        raise ArgumentError(f"{source} is a capture without poses; handsim track makes a take of it")
    if Path(source).suffix.lower() == ".toml":
        raise ArgumentError(
            f"{source} is a glove, expected the folder of a labeler that handsim train wrote for it"
        )
    if out.suffix.lower() != ".onnx":
        raise ArgumentError(
            f"cannot write the labeler '{source}' as '{out}', expected a name that ends in .onnx; takes, "
            f"which end in .npz, become {', '.join(MOTION_FORMATS)}"
        )
    check_outputs([source], [out])
    network, card = load_network(source)
    export_onnx(network, card["marker_names"], out)
    print_line(f"{out}: {len(card['marker_names'])} markers")
