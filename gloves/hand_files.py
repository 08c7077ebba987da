"""Files of a hand in the flat pose: a MuJoCo or OpenSim model, a URDF, a rigged mesh, or its skin."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.fit import GloveFit
from gloves.takes.take import Take
from handsim.errors import ArgumentError
from handsim.files.outputs import atomic_write
from handsim.hand.model import HandModel, build_spec, join_qpos
from handsim.hand.model_files import Forearm, hand_osim, hand_urdf
from handsim.hand.shape import NUM_JOINTS, Side
from handsim.motion_files.motion import Motion, PosedHand
from handsim.motion_files.scenes import write_glb
from handsim.space.transforms import UpAxis, pose_matrices

ENDINGS: Final = (".xml", ".urdf", ".osim", ".glb")
WITH_MARKERS: Final = (".xml", ".osim")
"""Endings of files that hold the markers of a glove."""
MESH_ENDINGS: Final = (".glb", ".obj", ".ply", ".stl")


def write_hand(
    path: Path,
    hand: HandModel | GloveFit,
    *,
    actuators: bool = False,
    start: Float[np.ndarray, "27"] | None = None,
    up: UpAxis = "z",
    forearm: Forearm | None = None,
) -> None:
    """Write a hand in the flat pose; meters, radians, kilograms.

    Args:
        path: The file: .xml (MuJoCo: free joint, twenty hinges, capsules), .urdf, .osim (OpenSim, with the
            coordinates of the .mot of a take), or .glb (its skin with bones and weights, y up).
        hand: The hand; markers of its glove become sites of the .xml and markers of the .osim.
        actuators: Whether an .xml has position servos, whose controls are angles within the joints' ranges.
        start: Pose that the .osim begins in [m, rad]; flat when not given.
        up: The axis of that pose's world that points up.
        forearm: A forearm for the .osim.

    Raises:
        ArgumentError: The file has another ending.
        OSError: The file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in ENDINGS:
        raise ArgumentError(
            f"cannot write a hand as '{path}', expected a name that ends in {', '.join(ENDINGS)}"
        )
    model = hand.model if isinstance(hand, GloveFit) else hand
    if suffix == ".glb":
        flat = join_qpos(np.zeros((1, NUM_JOINTS)))
        write_glb(path, Motion(1.0, np.zeros(1), [PosedHand.of(model, flat)], []))
        return
    with atomic_write(path) as temporary:
        if suffix == ".urdf":
            temporary.write_text(hand_urdf(model), "utf-8")
            return
        sites = hand.attachment.sites(model) if isinstance(hand, GloveFit) else ()
        if suffix == ".osim":
            temporary.write_text(hand_osim(model, sites, start, up, forearm), "utf-8")
            return
        spec = build_spec(model.skeleton, model.capsules, sites=sites, actuators=actuators)
        import mujoco

        spec.compile()  # the XML writer needs a compiled spec
        temporary.write_text(spec.to_xml(), "utf-8")
        mujoco.MjModel.from_xml_string(temporary.read_text("utf-8"))  # check before the file gets its name


def first_forearm(take: Take, side: Side) -> Forearm | None:
    """A hand's forearm in a take, as in the first frame with both; None if its axes are unknown."""
    body = take.forearm_index(side)
    if body is None or not take.bodies[body].has_axes:
        return None
    both = np.stack([take.qpos[:, take.hand_index(side), :7], take.body_poses[:, body]])
    there = np.isfinite(both).all(axis=(0, 2))
    if not there.any():
        return None
    wrist, forearm = pose_matrices(both[:, there.argmax()])
    return Forearm(take.bodies[body].name, take.bodies[body].markers, np.linalg.inv(wrist) @ forearm)


def write_skin(path: Path, model: HandModel) -> None:
    """Write the skin in the flat pose [m], in the wrist's frame, as .glb, .obj, .ply or .stl."""
    import trimesh

    surface = model.surface
    skin = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    with atomic_write(path) as temporary:
        skin.export(temporary, file_type=path.suffix.lower()[1:])
