"""The command `handsim render`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro
from rich.console import Console

from handsim.app.progress import progress_bar
from handsim.errors import HandSimError, choices
from render.cameras.viewpoints import Placement, ViewConfig
from render.painting.painter import Painter
from render.scenery.backgrounds import KINDS, BackgroundConfig, BackgroundKind, photo_files
from render.sensors.depth_noise import SENSORS, DepthNoiseConfig
from render.sensors.exposure import ExposureConfig
from render.sensors.shutter import ShutterConfig
from render.session import SHEET, RenderConfig, render_take
from render.skin.look import ALL_TONES, TONES

_NO_SENSOR: Final = "none"


def render(
    take: Annotated[Path, tyro.conf.Positional],
    out: Path,
    format: tuple[str, ...] = ("webdataset",),
    passes: tuple[str, ...] = ("rgb", "depth", "normals", "ids"),
    placement: Placement = "still",
    camera: str = "vga",
    views: int = 1,
    distance: tuple[float, float] = (0.55, 0.9),
    rig: str = "six",
    dress: Literal["skin", "glove"] = "skin",
    tones: tuple[str, ...] = (),
    background: tuple[BackgroundKind, ...] = (),
    photos: Path | None = None,
    vary: Literal["shard", "frame"] = "shard",
    depth_sensor: tuple[str, ...] = ("kinect2",),
    color_sensor: bool = True,
    motion_blur: bool = False,
    painter: Painter = "compiled",
    every: int = 1,
    frames_per_shard: int = 64,
    seed: int = 0,
    workers: int | None = None,
) -> None:
    """Draw the hands of a take: colors, depth, normals and ids, with the truth of each picture.

    The same command goes on where it was stopped.

    Args:
        take: A tracked take (.npz), or the truth of a simulated one (.truth.npz).
        out: Folder for the pictures, their annotations and contact_sheet.png.
        format: Of the files: webdataset, coco, freihand, interhand, exr, png; several go into folders.
        passes: What to draw: rgb, depth, normals, ids.
        placement: Where cameras stand: still, orbit, head, anywhere, rig.
        camera: vga, vga_wide, sr300, kinect2, azure_kinect, d435, headset_fisheye.
        views: Cameras that look at once.
        distance: Nearest and farthest [m].
        rig: For the placement rig: a shipped name or the path of a .toml file.
        dress: Bare skin, or the marker glove with its markers.
        tones: Classes of skin tone: very-light, light, intermediate, tan, brown, dark; all when not given.
        background: Kinds: plain, gradient, noise, clutter, room, photo; a mixture when not given.
        photos: Folder of photographs, for backgrounds of the kind photo.
        vary: When light and background change.
        depth_sensor: kinect1, d435, kinect2, azure_kinect, or none for perfect depth only.
        color_sensor: Whether there are noisy colors beside the perfect ones.
        motion_blur: Whether there are shutters, some of them rolling; takes eight drawings a picture.
        painter: Who paints colors: our own code, or opengl, which is quicker where there is a graphics card.
        every: Draw each so many frames one.
        frames_per_shard: Frames that are finished together.
        seed: Of all that is random.
        workers: Processes; all cores when not given.
    """
    config = RenderConfig(
        passes=passes,
        view=ViewConfig(placement, camera, views, distance, rig),
        dress=dress,
        tones=_angles(tones),
        background=_backgrounds(background, photos),
        vary=vary,
        depth_sensor=_sensors(depth_sensor),
        color_sensor=ExposureConfig() if color_sensor else None,
        shutter=ShutterConfig() if motion_blur else None,
        painter=painter,
        every=every,
        frames_per_shard=frames_per_shard,
        seed=seed,
    )
    start = time.perf_counter()
    if photos is not None:
        _tell_left_out(photos)
    with progress_bar("images") as (bar, task):
        count = render_take(
            take,
            out,
            format,
            config,
            workers=workers,
            progress=lambda done, wanted: bar.update(task, completed=done, total=wanted),
        )
    seconds = time.perf_counter() - start
    console = Console()
    console.print(f"{out}: {count} images in {seconds:.0f} s", soft_wrap=True, markup=False)
    if {"rgb", "depth"} & set(passes):
        console.print(f"{out / SHEET}: some of them at one glance", soft_wrap=True, markup=False)


def _angles(tones: tuple[str, ...]) -> tuple[float, float]:
    """From the darkest to the lightest of the classes."""
    if not tones:
        return ALL_TONES
    known = {name.replace(" ", "-"): angles for name, angles in TONES.items()}
    for name in tones:
        if name not in known:
            raise HandSimError(choices(name, known, noun="skin tone"))
    chosen = [known[name] for name in tones]
    return min(low for low, _ in chosen), max(high for _, high in chosen)


def _backgrounds(kinds: tuple[BackgroundKind, ...], photos: Path | None) -> BackgroundConfig:
    folder = None if photos is None else str(photos)
    if not kinds and folder is None:
        return BackgroundConfig()
    wanted = kinds or ("photo",)
    return BackgroundConfig(**{kind: float(kind in wanted) for kind in KINDS}, photos=folder)


def _tell_left_out(photos: Path) -> None:
    _, broken = photo_files(photos)
    if broken:
        more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
        Console(stderr=True).print(
            f"left out: {broken[0]}{more}, no readable photographs", soft_wrap=True, markup=False
        )


def _sensors(names: tuple[str, ...]) -> DepthNoiseConfig | None:
    if names == (_NO_SENSOR,) or not names:
        return None
    for name in names:
        if name not in SENSORS:
            raise HandSimError(choices(name, (*SENSORS, _NO_SENSOR), noun="depth sensor"))
    return DepthNoiseConfig(sensors=names)
