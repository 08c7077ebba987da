"""The command `handsim hand`: a hand for other programs, as a MuJoCo model, a URDF or a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import mujoco
import numpy as np
import trimesh

from gloves.fit import GloveFit, attach, nominal_fit
from gloves.layout import load_layout
from gloves.takes.take import Take, load_take
from handsim.app.messages import print_line
from handsim.errors import ArgumentError, choices
from handsim.files.atomic import atomic_write
from handsim.files.outputs import check_outputs
from handsim.hand.mjcf import Site, build_spec
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import NUM_JOINTS, Side
from handsim.hand.urdf import hand_urdf
from track.user import load_user

Size = Literal["XS", "S", "M", "L", "XL"]
_USUAL_SIZE: Final = "M"
_USUAL_GLOVE: Final = "dense19"
_SUFFIXES: Final = (".xml", ".urdf", ".glb")
_MESH_SUFFIXES: Final = (".glb", ".obj", ".ply", ".stl")


def hand(
    out: Path = Path("hand.xml"),
    size: Size | None = None,
    side: Side | None = None,
    shape: Path | None = None,
    take: Path | None = None,
    mesh: Path | None = None,
    glove: str | None = None,
    actuators: bool = False,
) -> None:
    """Write a hand as a MuJoCo model, a URDF or a rigged mesh, and its skin as a plain mesh.

    Args:
        out: The hand: .xml (MuJoCo: free joint, twenty hinges, capsules), .urdf, or .glb (its skin with bones
            and weights, y up); meters, radians, kilograms.
        size: Size of the hand, M when neither it nor a file is given.
        side: Which hand; the right one, or the only one of a file, when not given.
        shape: A user's file of `handsim calibrate`, for that user's hand instead of a size.
        take: A take of `handsim track` or `handsim simulate`, for a hand in it instead of a size.
        mesh: File for the skin in the flat pose, .glb, .obj, .ply or .stl; in meters, in the wrist's frame.
        glove: Marker layout whose markers become sites of the .xml: a shipped name or a .toml file. Hands of
            a file have the sites of their own markers.
        actuators: Position servos in the .xml, whose controls are angles within the joints' ranges.
    """
    suffix = out.suffix.lower()
    if suffix not in _SUFFIXES:
        raise ArgumentError(f"--out is {out}, expected a file name that ends in {', '.join(_SUFFIXES)}")
    if mesh is not None and mesh.suffix.lower() not in _MESH_SUFFIXES:
        raise ArgumentError(
            f"--mesh is {mesh}, expected a file name that ends in {', '.join(_MESH_SUFFIXES)}"
        )
    if suffix != ".xml" and (actuators or glove is not None):
        option = "--actuators" if actuators else "--glove"
        raise ArgumentError(f"given {option} and --out {out}, expected an --out that ends in .xml with it")
    if mesh is not None and mesh.resolve() == out.resolve():
        raise ArgumentError(f"--out and --mesh are both {out}, expected two files")
    check_outputs([glove, shape, take], (out, mesh))
    model, sites, words = _chosen_hand(size, side, shape, take, glove)
    if suffix == ".xml":
        _write_model(out, model, sites, actuators=actuators)
        extras = f", {len(sites)} marker sites" + f", {NUM_JOINTS} servos" * actuators
    elif suffix == ".urdf":
        with atomic_write(out) as temporary:
            temporary.write_text(hand_urdf(model), "utf-8")
        extras = f", {NUM_JOINTS} joints"
    else:
        worn = attach(load_layout(_USUAL_GLOVE), model)  # a take has gloves; the file has none
        Take.of_poses([worn], _flat_pose()[:, None], rate=1.0).export(out)
        extras = ", rigged skin"
    print_line(f"{out}: {model.shape.side} hand {words}{extras}")
    if mesh is not None:
        _write_mesh(mesh, model)
        surface = model.surface
        counts = f"{len(surface.vertices)} vertices, {len(surface.faces)} triangles"
        print_line(f"{mesh}: its skin, {counts}")


def _chosen_hand(
    size: Size | None, side: Side | None, shape: Path | None, take: Path | None, glove: str | None
) -> tuple[HandModel, tuple[Site, ...], str]:
    """The hand that the options name, its markers, and where it is from in words."""
    given = {"--size": size, "--shape": shape, "--take": take}
    named = [f"{option} {value}" for option, value in given.items() if value is not None]
    if len(named) > 1:
        raise ArgumentError(f"given {' and '.join(named)}, expected one of them")
    source = shape or take
    if source is not None:
        if glove is not None:
            raise ArgumentError(f"given --glove {glove} and {named[0]}, expected one of them")
        fits = load_user(source) if take is None else load_take(source).hands
        fit = _of_side(source, fits, side)
        millimeters = f"{1e3 * fit.shape.length:.0f} x {1e3 * fit.shape.breadth:.0f} mm"
        return fit.model, fit.attachment.sites(fit.model), f"of {source}, {millimeters}"
    size = size or _USUAL_SIZE
    if glove is None:
        return HandModel.named(size, side=side or "right"), (), f"of size {size}"
    fit = nominal_fit(load_layout(glove), size, side or "right")
    return fit.model, fit.attachment.sites(fit.model), f"of size {size}"


def _of_side(source: Path, fits: Sequence[GloveFit], side: Side | None) -> GloveFit:
    """The hand of a side; without one the right hand, or the only one."""
    hands = {fit.side: fit for fit in fits}
    if side is None:
        side = "right" if "right" in hands else "left"
    if side not in hands:
        raise ArgumentError(f"{source}: {choices(side, hands, noun='hand')}")
    return hands[side]


def _flat_pose() -> np.ndarray:
    """The pose (1, 27) of zero angles with the wrist at the origin."""
    return join_qpos(np.zeros((1, NUM_JOINTS)))


def _write_model(path: Path, model: HandModel, sites: tuple[Site, ...], *, actuators: bool) -> None:
    """Write the MuJoCo model, which `mujoco.MjModel.from_xml_path` opens."""
    spec = build_spec(model.skeleton, model.capsules, sites=sites, actuators=actuators)
    spec.compile()  # fills in what the XML writer asks for
    with atomic_write(path) as temporary:
        temporary.write_text(spec.to_xml(), "utf-8")
        mujoco.MjModel.from_xml_path(str(temporary))  # before it takes its name


def _write_mesh(path: Path, model: HandModel) -> None:
    """Write the skin in the flat pose [m], in the wrist's frame, in the format of the file's suffix."""
    surface = model.surface
    skin = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    with atomic_write(path) as temporary:
        skin.export(temporary, file_type=path.suffix.lower()[1:])
