"""What drawn pictures teach: a keypoint network that has seen only them, tried on photographs.

    python -m benchmarks.keypoint_network OUT PHOTOS REFERENCE [--variants ours plain ...]
        [--pictures 12000 --samples 240000 --seed 0 --photographs 100]

Trains the network of `keypoint_training.py` once for each variant of the pictures, from
equal poses and views, and prints the share of keypoints within a tenth of the box of the hand (PCK@0.1): on
1,000 pictures that it learned from, on drawn hands of `ours` that it has not seen, and on photographs where
the reference (what `benchmarks.photograph_reference` writes) is sure. Variants:

ours: what `handsim render` draws; name it first, and the others are compared with it.
plain: the loop that a user would write with pyrender: the same skins and cameras, one color of skin a
    picture, one light, a plain background.

Photographs are counted twice: with the keypoints that the network finds, which are ours, and with those
moved to where MediaPipe has them, by shares that were measured on drawn hands. `--photographs 100` adds about
a hundred labeled photographs of some people to the training, a quarter of the samples; those of other people
are left to be tried on.

OUT keeps crops and networks, and a run goes on with those of the same numbers and seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import torch
import trimesh
import tyro

from benchmarks import keypoint_training as training
from benchmarks.record import Figures, describe, run, save_figures
from handsim import HandModel
from handsim.files.outputs import atomic_write
from render import RenderConfig, RenderedFrame
from render.painting.opengl import OPENGL_FROM_OPENCV, load_pyrender, offscreen_renderer

LEARNED, HELD_OUT = 1, 2  # seeds of the pictures
SKINS: Final = (
    (60, 42, 34),
    (110, 75, 56),
    (150, 106, 80),
    (190, 140, 112),
    (220, 175, 148),
    (236, 200, 180),
)


@dataclass(frozen=True)
class Options:
    """The command line."""

    out: tyro.conf.Positional[Path]
    photos: Path
    reference: Path
    variants: tuple[Literal["ours", "plain"], ...] = ("ours", "plain")
    pictures: int = 12000
    samples: int = 240000
    seed: int = 0
    photographs: int = 0
    save: str | None = None


def draw_plain(count: int, seed: int) -> Any:
    """Pictures by pyrender alone; poses, cameras and cuts are drawn as those of `keypoint_training.draw`."""
    rng, found = np.random.default_rng(seed), []
    config: RenderConfig = replace(training.CONFIG, passes=("ids",), seed=seed)
    renderer = offscreen_renderer(640, 480)
    for frame in training.frames(count, rng, config):
        picture = plain_picture(frame, renderer, rng)
        found.append(training.cut_out(picture, frame.hands[0].keypoints, rng))
    return training.Pictures(*(np.stack(values) for values in zip(*found, strict=True)))


def plain_picture(frame: RenderedFrame, renderer: Any, rng: np.random.Generator) -> np.ndarray:
    """One hand in one color under one light before one color."""
    pyrender, hand = load_pyrender(), frame.hands[0]
    skin = np.array(SKINS[rng.integers(len(SKINS))]) / 255.0
    material = pyrender.MetallicRoughnessMaterial(
        baseColorFactor=[*(skin**2.2), 1.0], metallicFactor=0.0, roughnessFactor=0.7
    )
    faces = HandModel(hand.shape).surface.faces
    scene = pyrender.Scene(bg_color=[*rng.random(3), 1.0], ambient_light=[0.2, 0.2, 0.2])
    mesh = trimesh.Trimesh(hand.vertices, faces, process=False)
    scene.add(pyrender.Mesh.from_trimesh(mesh, material=material, smooth=True))
    fx, fy, cx, cy = frame.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    pose = frame.camera.T_world_camera @ OPENGL_FROM_OPENCV
    scene.add(pyrender.IntrinsicsCamera(fx, fy, cx, cy), pose=pose)
    turned = trimesh.transformations.euler_matrix(*rng.uniform(-0.8, 0.8, 2), 0.0)
    scene.add(pyrender.DirectionalLight(intensity=4.0), pose=pose @ turned)
    return np.array(renderer.render(scene)[0])


VARIANTS: Final[dict[str, Callable[[int, int], Any]]] = {
    "ours": training.draw,
    "plain": draw_plain,
}


def pictures_of(variant: str, count: int, seed: int, out: Path) -> Any:
    """Crops of a variant, drawn or from the folder."""
    path = out / f"{variant}-{count}-{seed}.npz"
    if not path.exists():
        cut = VARIANTS[variant](count, seed)
        with atomic_write(path) as temporary:
            np.savez(temporary, **cut._asdict())
    with np.load(path, allow_pickle=False) as arrays:
        return training.Pictures(*(arrays[name] for name in training.Pictures._fields))


def learned_by(variant: str, options: Options) -> Any:
    """1,000 of the pictures that a variant's network learned from."""
    cut = pictures_of(variant, options.pictures, LEARNED, options.out)
    return training.middle_of(training.Pictures(*(values[:1000] for values in cut)))


def network_of(variant: str, labeled: Any, options: Options) -> torch.nn.Module:
    """The network that has seen a variant and labeled photographs, trained or from the folder."""
    trained_from = f"{options.pictures}-{options.samples}-{options.seed}"
    if labeled is not None:
        trained_from += f"-{options.photographs}_photographs"
    path = options.out / f"{variant}-{trained_from}.pt"
    network = training.KeypointNetwork()
    if not path.exists():
        cut = pictures_of(variant, options.pictures, LEARNED, options.out)
        trained = training.train(cut, options.samples, options.seed, labeled)
        with atomic_write(path) as temporary:
            torch.save(trained.state_dict(), temporary)
    network.load_state_dict(torch.load(path, weights_only=True))
    return network.eval().to(memory_format=torch.channels_last)


def main(options: Annotated[Options, tyro.conf.arg(name="")]) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    print(describe())
    some, photos = training.split(
        training.load_photos(options.photos, options.reference), options.photographs
    )
    labeled = training.labeled_as_ours(some) if options.photographs else None
    held_out = training.middle_of(pictures_of("ours", 1000, HELD_OUT, options.out))
    print(
        f"{options.pictures} pictures, {options.samples} samples, {len(some.crops)} labeled photographs; "
        f"{len(photos.crops)} photographs"
    )
    result = {}
    figures: Figures = {
        "photographs": ("photographs of hands on which the reference is sure", len(photos.crops))
    }
    for variant in options.variants:
        network = network_of(variant, labeled, options)
        sets = {"learned": learned_by(variant, options), "drawn": held_out, "photographs": photos}
        points = {name: training.find(network, one.crops) for name, one in sets.items()}
        found = {name: 100 * training.pck(points[name], one) for name, one in sets.items()}
        moved = training.MEDIAPIPE @ points["photographs"]
        result[variant] = found = found | {"moved": 100 * training.pck(moved, photos)}
        shares = "  ".join(f"{name} {share:5.1f}" for name, share in found.items())
        print(f"{variant:15s} {shares}", flush=True)
        sets_of = "learned from | other drawn hands | photographs | moved"
        figures[variant] = (f"trained on {variant}, PCK@0.1 [%]: {sets_of}", list(found.values()))
        if "ours" in result and variant != "ours":
            ratio = (100 - found["photographs"]) / (100 - result["ours"]["photographs"])
            print(f"misses on photographs, {variant} over ours: {ratio:.2f}", flush=True)
            figures[f"{variant}_ratio"] = (f"misses on photographs, {variant} over ours", ratio)
    save_figures(options.save, figures)


if __name__ == "__main__":
    run(main, __doc__)
