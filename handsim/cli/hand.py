"""The command `handsim hand`: a hand for other programs, as a MuJoCo or OpenSim model, a URDF or a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from gloves.layout import load_layout
from handsim.app.messages import print_line
from handsim.errors import ArgumentError, errors_of
from handsim.files.outputs import check_ending, check_outputs, written_together
from handsim.hand.shape import NUM_JOINTS, NUM_QPOS, Side, Size
from handsim.space.transforms import UpAxis

if TYPE_CHECKING:
    from gloves.fit import GloveFit
    from handsim.hand.model import HandModel
    from handsim.hand.model_files import Forearm


def hand(
    out: Path = Path("hand.xml"),
    size: Size | None = None,
    side: Side | None = None,
    shape: Path | None = None,
    take: Path | None = None,
    mesh: Path | None = None,
    glove: str | None = None,
    actuators: bool = False,
    up: UpAxis = "z",
) -> None:
    """Write a hand as a MuJoCo or OpenSim model, a URDF or a rigged mesh, and its skin as a plain mesh.

    Args:
        out: The hand: .xml (MuJoCo: free joint, twenty hinges, capsules), .urdf, .osim (OpenSim: the
            coordinates of the .mot of handsim export, in a take's first pose), or .glb (its skin with bones
            and weights, y up); meters, radians, kilograms.
        size: Size of the hand, M when neither it nor a file is given.
        side: Which hand; the right one, or the only one of a file, when not given.
        shape: A user's file of `handsim calibrate`, for that user's hand instead of a size.
        take: A take of `handsim track` or `handsim simulate`, for a hand in it instead of a size.
        mesh: File for the skin in the flat pose, .glb, .obj, .ply or .stl; in meters, in the wrist's frame.
        glove: Marker layout whose markers become sites of the .xml or markers of the .osim: a shipped name
            or a .toml file. Hands of a file have their own markers.
        actuators: Position servos in the .xml, whose controls are angles within the joints' ranges.
        up: The axis of the take that points up, for the first pose in an .osim; y for Motive's default.
    """
    from gloves.fit import GloveFit
    from gloves.hand_files import ENDINGS, MESH_ENDINGS, WITH_MARKERS, write_hand, write_skin

    suffix = out.suffix.lower()
    check_ending(out, *ENDINGS)
    if mesh is not None:
        check_ending(mesh, *MESH_ENDINGS, option="--mesh")
    for option, given, endings in (
        ("--actuators", actuators, (".xml",)),
        ("--glove", glove is not None, WITH_MARKERS),
    ):
        if given and suffix not in endings:
            wanted = " or ".join(endings)
            raise ArgumentError(
                f"given {option} and --out {out}, expected an --out that ends in {wanted} with it"
            )
    if up != "z" and (take is None or suffix != ".osim"):
        raise ArgumentError(
            f"given --up {up} and --out {out}, expected --take and an --out that ends in .osim with it"
        )
    check_outputs([glove, shape, take], (out, mesh))
    chosen, words, start, forearm = _chosen_hand(size, side, shape, take, glove)
    model = chosen.model if isinstance(chosen, GloveFit) else chosen
    with written_together():
        write_hand(out, chosen, actuators=actuators, start=start, up=up, forearm=forearm)
        if mesh is not None:
            write_skin(mesh, model)
    markers = chosen.layout.num_markers if isinstance(chosen, GloveFit) else 0
    extras = {
        ".xml": f"{markers} marker sites" + f", {NUM_JOINTS} servos" * actuators,
        ".urdf": f"{NUM_JOINTS} joints",
        ".osim": f"{markers} markers"
        + ("" if forearm is None else f", and a forearm with {len(forearm.markers)}"),
        ".glb": "rigged skin",
    }
    print_line(f"{out}: {model.shape.side} hand {words}, {extras[suffix]}")
    if mesh is not None:
        counts = f"{len(model.surface.vertices)} vertices, {len(model.surface.faces)} triangles"
        print_line(f"{mesh}: its skin, {counts}")


def _chosen_hand(
    size: Size | None, side: Side | None, shape: Path | None, take: Path | None, glove: str | None
) -> tuple[HandModel | GloveFit, str, Float[np.ndarray, "27"] | None, Forearm | None]:
    """The hand of the options, in its glove if it has one, its origin, a take's first pose and forearm."""
    from gloves.fit import nominal_fit
    from gloves.hand_files import first_forearm
    from gloves.takes.take import load_take
    from handsim.hand.model import HandModel
    from track.user import User, load_user

    given = {"--size": size, "--shape": shape, "--take": take}
    named = [f"{option} {value}" for option, value in given.items() if value is not None]
    if len(named) > 1:
        raise ArgumentError(f"given {' and '.join(named)}, expected one of them")
    source = shape or take
    if source is not None:
        if glove is not None:
            raise ArgumentError(f"given --glove {glove} and {named[0]}, expected one of them")
        moving = None if take is None else load_take(take)
        user = load_user(source) if moving is None else User(moving.hands)
        with errors_of(source, ArgumentError):
            fit = user.of_side(side)
        poses = np.empty((0, NUM_QPOS)) if moving is None else moving.qpos[:, moving.hand_index(fit.side)]
        there = np.flatnonzero(np.isfinite(poses).all(axis=1))
        start = poses[there[0]] if len(there) else None
        forearm = first_forearm(moving, fit.side) if moving is not None and len(there) else None
        return fit, f"of {source}, {User((fit,))}", start, forearm
    size, side = size or "M", side or "right"
    hand = HandModel.named(size, side=side) if glove is None else nominal_fit(load_layout(glove), size, side)
    return hand, f"of size {size}", None, None
