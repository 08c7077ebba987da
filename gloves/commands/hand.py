"""The command `handsim hand`: a hand for other programs, as a MuJoCo model and as a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

import mujoco
import trimesh

from gloves.attachment import attach_markers
from gloves.layout import load_layout
from handsim.app.messages import print_line
from handsim.errors import HandSimError
from handsim.files.atomic import atomic_write
from handsim.files.outputs import check_outputs
from handsim.hand.mjcf import Site, build_spec
from handsim.hand.model import HandModel

_MESH_SUFFIXES: Final = (".glb", ".obj", ".ply", ".stl")


def hand(
    out: Path = Path("hand.xml"),
    size: Literal["XS", "S", "M", "L", "XL"] = "M",
    side: Literal["right", "left"] = "right",
    mesh: Path | None = None,
    glove: str | None = None,
) -> None:
    """Write a hand as a MuJoCo model, and its skin as a mesh.

    Args:
        out: The model, a .xml file: free joint, twenty hinges, capsules; meters, radians, kilograms.
        size: Size of the hand.
        side: Which hand.
        mesh: File for the skin in the flat pose, .glb, .obj, .ply or .stl; in meters, in the wrist's frame.
        glove: Marker layout whose markers become sites of the model: a shipped name or a .toml file.
    """
    if out.suffix.lower() != ".xml":
        raise HandSimError(f"--out is {out}, expected a file name that ends in .xml")
    if mesh is not None and mesh.suffix.lower() not in _MESH_SUFFIXES:
        raise HandSimError(f"--mesh is {mesh}, expected a file name that ends in {', '.join(_MESH_SUFFIXES)}")
    check_outputs([glove], (out, mesh))
    model = HandModel.named(size, side=side)
    sites: tuple[Site, ...] = ()
    if glove is not None:
        sites = attach_markers(load_layout(glove), model).sites(model)
    write_model(out, model, sites=sites)
    print_line(f"{out}: {side} hand of size {size}, {len(sites)} marker sites")
    if mesh is not None:
        write_mesh(mesh, model)
        surface = model.surface
        counts = f"{len(surface.vertices)} vertices, {len(surface.faces)} triangles"
        print_line(f"{mesh}: its skin, {counts}")


def write_model(path: Path, model: HandModel, *, sites: tuple[Site, ...] = ()) -> None:
    """Write the MuJoCo model, which `mujoco.MjModel.from_xml_path` opens.

    Args:
        path: A .xml file.
        model: The hand.
        sites: Markers.
    """
    spec = build_spec(model.skeleton, model.capsules, sites=sites)
    spec.compile()  # fills in what the XML writer asks for
    with atomic_write(path) as temporary:
        temporary.write_text(spec.to_xml(), "utf-8")
        mujoco.MjModel.from_xml_path(str(temporary))  # before it takes its name


def write_mesh(path: Path, model: HandModel) -> None:
    """Write the skin in the flat pose [m], in the wrist's frame, in the format of the file's suffix."""
    surface = model.surface
    skin = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    with atomic_write(path) as temporary:
        skin.export(temporary, file_type=path.suffix.lower()[1:])
