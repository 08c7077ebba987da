"""The command `handsim render`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal, cast

import tyro
from rich.console import Console

from handsim._checks import check_choice
from handsim.app.messages import print_line
from handsim.app.output import Place, place_of
from handsim.app.progress import print_above, progress_bar
from handsim.app.workers import chosen_workers
from handsim.errors import HandSimError
from handsim.files.outputs import check_outputs
from handsim.hand.shape import Side
from render.color_sensor import ExposureConfig, ShutterConfig
from render.config import RenderConfig
from render.depth_sensor import SENSORS, DepthSensor
from render.formats.writer import merge_renderings
from render.painting.painter import PainterChoice
from render.scenery.backgrounds import BackgroundKind, Backgrounds, photo_files
from render.session import SHEET, cut_off_pictures, left_out_frames, render_take
from render.skin.look import ALL_TONES, named_tones
from render.subject import CSV, PoseFile
from render.viewpoints import Placement, ViewConfig

_NO_SENSOR: Final = "none"
_AUTO_SENSOR: Final = "auto"
_DEFAULT: Final = RenderConfig()
_VIEW: Final = ViewConfig()
_AS_IN_VIEW: Final = ("placement", "camera", "views", "share", "distance", "rig", "cameras")
_AS_IN_CONFIG: Final = (
    "passes",
    "dress",
    "vary",
    "painter",
    "every",
    "num_frames",
    "frames_per_shard",
    "seed",
)


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """`RenderConfig` as the options of the command name it."""

    placement: Placement = _VIEW.placement
    """Position of the cameras. still: in front of the hands, following them only where they leave the
    picture. orbit: around them. head: at the user's eyes. anywhere: at another position in every frame.
    rig: at the cameras of a rig, turned to the hands, with lenses as long as it takes."""
    camera: str = _VIEW.camera
    """Camera: vga, vga_wide, sr300, kinect2, azure_kinect, d435, headset_fisheye."""
    views: int = _VIEW.views
    """Number of cameras; a rig has its own number."""
    share: float = _VIEW.share
    """Share of the picture's height that a hand's longer side has, or a little more; less where all hands
    of a frame do not fit into the picture otherwise."""
    distance: tuple[float, float] | None = _VIEW.distance
    """Instead of the share, nearest and farthest distance from the center of the hands [m], drawn
    uniformly."""
    rig: str = _VIEW.rig
    """Rig for the placement rig: a shipped name or the path of a .toml file."""
    cameras: str | None = None
    """File of your own cameras, instead of all these: ours (.toml), OpenCV's (.yml, .json), or COLMAP's (the
    folder of cameras.txt and images.txt)."""
    passes: tuple[str, ...] = _DEFAULT.passes
    """Pictures to draw: rgb, depth, normals, ids."""
    dress: Literal["skin", "glove"] = _DEFAULT.dress
    """Bare skin, or the marker glove with its markers."""
    tones: tuple[str, ...] = ()
    """Classes of skin tone to draw from, and no others: very-light, light, intermediate, tan, brown, dark;
    all when not given."""
    background: tuple[BackgroundKind, ...] = ()
    """Kinds of background: plain, gradient, noise, clutter, room, photo; when not given, a mixture of the
    others, or photographs alone where --photos is given."""
    photos: Path | None = None
    """Folder of photographs, for backgrounds of the kind photo."""
    vary: Literal["shard", "frame"] = _DEFAULT.vary
    """Whether light and background change with every shard or with every frame."""
    depth_sensor: tuple[str, ...] = (_AUTO_SENSOR,)
    """Depth sensors: kinect1, d435, kinect2, azure_kinect, or none for perfect depth only, or auto: d435,
    and kinect2, which needs half a meter, for the placement rig and from --distance 0.6 on."""
    color_sensor: bool = True
    """Whether noisy colors are written beside the perfect ones."""
    motion_blur: bool = False
    """Whether shutters blur motion, and some of them roll; takes eight drawings per picture."""
    painter: PainterChoice = _DEFAULT.painter
    """What paints colors: our own compiled code, opengl, or auto: opengl where there is hardware for it."""
    every: int = _DEFAULT.every
    """Step between the frames that are drawn."""
    num_frames: int | None = _DEFAULT.num_frames
    """Number of these frames at most, spread evenly over the take; all when not given."""
    frames_per_shard: int = _DEFAULT.frames_per_shard
    """Frames that are written together."""
    seed: int = _DEFAULT.seed
    """Seed of all random choices."""

    def config(self) -> RenderConfig:
        """The configuration that these options stand for.

        Raises:
            HandSimError: A name is unknown, or a number is out of range.
        """
        return RenderConfig(
            **{name: getattr(self, name) for name in _AS_IN_CONFIG},
            view=ViewConfig(**{name: getattr(self, name) for name in _AS_IN_VIEW}),
            tones=named_tones(self.tones) if self.tones else ALL_TONES,
            background=self._backgrounds(),
            depth_sensor=_sensors(self.depth_sensor),
            color_sensor=ExposureConfig() if self.color_sensor else None,
            shutter=ShutterConfig() if self.motion_blur else None,
        )

    def _backgrounds(self) -> Backgrounds:
        """Kinds in equal shares; without any, photographs where there is a folder, else the usual mixture."""
        if not self.background and self.photos is None:
            return Backgrounds()
        photos = None if self.photos is None else str(self.photos)
        return Backgrounds(dict.fromkeys(self.background or ("photo",), 1.0), photos)


def render(
    take: Annotated[Path | None, tyro.conf.Positional] = None,
    *,
    out: Annotated[str, tyro.conf.arg(metavar="PATH")],
    poses: Path | None = None,
    hands: tuple[Side, ...] | None = None,
    people: int | None = None,
    glove: str = "dense19",
    merge: tuple[Path, ...] = (),
    options: Annotated[RenderOptions, tyro.conf.arg(name="")] = RenderOptions(),
    format: tuple[str, ...] = ("webdataset",),
    workers: int | None = None,
    cluster: str | None = None,
) -> None:
    """Draw the hands of a take: colors, depth, normals and ids, with the ground truth of each picture.

    The same command resumes where it was stopped. Poses of your own are drawn with --poses; --merge makes one
    folder of several.

    Args:
        take: A tracked take (.npz), the truth of a simulated one (.truth.npz), or a .csv of handsim export.
        out: Folder for the pictures, their annotations and contact_sheet.png; or a folder of an object store,
            as s3://bucket/prefix (docs/object_stores.md).
        poses: Poses of your own (.npz, or .csv as handsim export writes it) instead of a take;
            docs/rendering.md has the arrays and columns.
        hands: Whose poses an .npz has, in its order: right (when not given), left, or both. A .csv names its
            hands, and all are drawn when not given.
        people: Number of people that they are distributed over; one for each shard when not given.
        glove: Their marker layout with --dress glove: a shipped name or the path of a .toml file.
        merge: Folders of other renderings to be copied into one, with keys and ids of their own.
        options: What to draw.
        format: File formats: webdataset, coco, yolo, freihand, interhand, exr, png; several go into
            folders.
        workers: Processes; all cores when not given.
        cluster: Where else to draw shards: tcp://host:port of a Dask scheduler, its file (.json), or local;
            docs/cluster.md.
    """
    if sum((take is not None, poses is not None, bool(merge))) != 1:
        raise HandSimError("expected a take, --poses or --merge, and one of them alone")
    place = place_of(out)
    if merge:
        if not isinstance(place, Path):
            raise HandSimError(f"--merge copies into a folder, and {place} is none; copy that folder then")
        if options != RenderOptions() or format != ("webdataset",):
            raise HandSimError("--merge copies pictures as they are; leave out the options of drawing")
        count = merge_renderings(merge, place)
        print_line(f"{out}: {count} shards of {len(merge)} renderings")
        return
    source = _source(take, poses, hands, people, glove)
    check_outputs((take, poses, options.cameras), (place if isinstance(place, Path) else None,))
    config = options.config()
    start = time.perf_counter()
    if options.photos is not None:
        _print_left_out(options.photos)
    told: list[tuple[int, int]] = []
    with (
        progress_bar("images") as (bar, task),
        chosen_workers(cluster, workers, print_above(bar)) as chosen,
    ):

        def show(done: int, total: int) -> None:
            told.append((done, total))
            doing = "drawing" if done < total else "writing the annotations and the contact sheet"
            bar.update(task, completed=done, total=total, description=doing)

        count = render_take(
            source,
            place,
            format,
            config,
            workers=chosen,
            progress=show,
        )
    seconds = time.perf_counter() - start
    _print_lacking(out, place)
    if told and told[0][0] == told[0][1]:
        print_line(f"{out}: complete already, with all of its {count} images")
    else:
        print_line(f"{out}: {count} images in {seconds:.0f} s, {count / seconds:.1f} a second")
    if {"rgb", "depth"} & set(config.passes):
        print_line(f"{place}/{SHEET}: some of them at one glance")


def _source(
    take: Path | None, poses: Path | None, hands: tuple[Side, ...] | None, people: int | None, glove: str
) -> Path | PoseFile:
    """What is drawn: a take, or poses of one's own."""
    if take is not None and take.suffix.lower() == CSV:
        take, poses = None, take
    if poses is not None:
        return PoseFile(poses, hands, people, glove)
    if (hands, people, glove) != (None, None, "dense19"):
        raise HandSimError("--hands, --people and --glove belong to --poses; a take has its own")
    return cast("Path", take)


def _print_lacking(out: str, place: Place) -> None:
    """Say which frames were left out, and which pictures lack a hand."""
    lost = left_out_frames(place)
    if lost:
        print_line(
            f"{out}: frames left out: {len(lost)} (the first: {lost[0]}), where a camera would be inside a "
            "hand or an object"
        )
    cut = cut_off_pictures(place)
    if cut:
        print_line(f"{out}: images that lack a hand of their frame: {len(cut)} (the first: {cut[0]})")


def _print_left_out(photos: Path) -> None:
    _, broken = photo_files(photos)
    if broken:
        more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
        Console(stderr=True).print(
            f"left out: {broken[0]}{more}, not readable as photographs", soft_wrap=True, markup=False
        )


def _sensors(names: tuple[str, ...]) -> DepthSensor | Literal["auto"] | None:
    if names == (_AUTO_SENSOR,):
        return "auto"
    if names == (_NO_SENSOR,) or not names:
        return None
    for name in names:
        check_choice(name, (*SENSORS, _NO_SENSOR), noun="depth sensor")
    return DepthSensor(names)
