"""Pages for everything that can be viewed; the kind of a file or folder is recognized by its content."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, cast

import numpy as np

import gloves.layout
from gloves.captures.formats import READABLE, read_capture
from gloves.fit import GloveFit, nominal_fit
from gloves.layout import list_layouts, load_layout
from gloves.takes.archives import is_growing
from gloves.takes.corrections import corrections_path, unfitting_sentences
from gloves.takes.take import load_take
from handsim.errors import ArgumentError, FileError, HandSimWarning
from handsim.files.inputs import read_toml
from handsim.files.outputs import check_outputs
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import NUM_JOINTS, SIZES
from handsim.space.rig import CameraRig, list_rigs, load_rig
from handsim.space.transforms import UpAxis
from track.settings import USUAL_SIZE
from track.user import load_user, size_words
from track.viewer.editors import HEIGHT, Corrector, LabelEditor, LayoutEditor, edited_path
from track.viewer.recordings import CaptureRecording, DatasetRecording, Recording, TakeRecording
from track.viewer.stage import FrameView, HandSkin, PointBalls, set_stage, show_rig, show_volume, switch
from track.viewer.timeline import StatusPanel, Timeline
from train.data.shards import Dataset, is_dataset

if TYPE_CHECKING:
    from viser import ViserServer

ACCEPTED: Final = (
    "a marker layout or camera rig (.toml, or a shipped name), a training set's folder, a capture "
    f"({', '.join(READABLE)}), a tracked take or a simulated take's truth (.npz), or a user's file (.json)"
)
"""The kinds of files that can be viewed."""
_TIME_TOLERANCE: Final = 0.01  # [s] --time may lie outside of a recording by this.
_FIRST_LOOK_FRAMES: Final = 30  # number of frames that determine the first look

Run = Callable[[Callable[[], bool]], None]
"""Serves a page until the given function returns True."""
_HAND_SPACING: Final = 0.14  # distance between the centers of two hands [m]
_BEFORE_COLOR: Final = (150, 150, 150)


class Content(NamedTuple):
    """Content of a file, ready to be shown."""

    kind: str
    show: Callable[[ViserServer], Run]
    """Adds the content to a page; returns the function that serves the page."""
    recording: Recording | None = None
    """Frames of content that changes over time."""


def open_content(
    name: str,
    *,
    out: Path | None = None,
    size: str | None = None,
    rig: CameraRig | str | None = None,
    time: float | None = None,
    up: UpAxis = "z",
) -> Content:
    """Read a file, folder, or shipped layout or rig; the parameters are those of `handsim view`."""
    path, given, keys = Path(name), cast("str | Path", name), set[str]()
    suffix = path.suffix.lower()
    if not path.exists() and name in (*list_layouts(), *list_rigs()):
        keys = {"radius_mm" if name in list_layouts() else "camera"}
    elif not (path.exists() or suffix or is_growing(path) or is_dataset(name)):
        raise ArgumentError(f"{name}: no such file, folder or shipped name, expected {ACCEPTED}")
    elif suffix == ".toml" and not path.is_dir():
        given, keys = path, set(read_toml(path, error=FileError))
        if not keys & {"camera", "field_of_view", "radius_mm"}:
            raise ArgumentError(f"{path}: a TOML file of another kind, expected {ACCEPTED}")
    if size is not None and (not keys or keys & {"camera", "field_of_view"}):
        raise ArgumentError(f"--size is {size}, but {name} is no marker layout, which a hand would wear")
    if keys & {"camera", "field_of_view"}:
        content = _rig_content(load_rig(given))
    elif keys:
        content = _layout_content(given, out, USUAL_SIZE if size in (None, "auto") else str(size))
    elif out is not None:
        raise ArgumentError(f"--out is {out}, but {name} is no marker layout: nothing would be saved")
    elif suffix == ".json":
        hands = load_user(path)
        content = Content("user", lambda server: _show_user(server, hands))
    else:
        return _recorded(path, name, None if rig is None else load_rig(rig), time, up)
    for option, value, why in (
        ("--time", None if time is None else f"{time:g}", ": nothing in it moves"),
        ("--rig", rig, ", which no cameras are shown with"),
        ("--up", None if up == "z" else up, ", in which z points up"),
    ):
        if value is not None:
            raise ArgumentError(f"{option} is {value}, but {name} is a {content.kind}{why}")
    return content


def _recorded(path: Path, name: str, rig: CameraRig | None, time: float | None, up: UpAxis) -> Content:
    """Frames of a file or folder, and a corrector for a tracked take."""
    recording: Recording
    corrector: Corrector | None = None
    if path.is_dir() or is_dataset(name):
        recording = DatasetRecording(Dataset(name), rig)
    elif path.suffix.lower() in READABLE:
        recording = CaptureRecording(read_capture(path), rig)
    elif path.suffix.lower() == ".npz" or is_growing(path):
        take = load_take(path)
        if take.made_by_tracker and not is_growing(path):
            corrector = Corrector(path, take)
            for sentence in unfitting_sentences(corrections_path(path), corrector.unfitting):
                warnings.warn(sentence, HandSimWarning, stacklevel=2)
        recording = TakeRecording(corrector.take if corrector else take, rig)
    else:
        raise ArgumentError(f"{path}: a file of another kind, expected {ACCEPTED}")
    first = 0
    if time is not None:
        begin, end = float(recording.times[0]), float(recording.times[-1])
        if not begin - _TIME_TOLERANCE <= time <= end + _TIME_TOLERANCE:
            raise ArgumentError(f"--time is {time:g} s, but {name} lasts from {begin:g} to {end:.3f} s")
        first = int(np.argmin(np.abs(recording.times - time)))
    kind = type(recording).__name__.removesuffix("Recording").lower()
    return Content(kind, lambda server: show_recording(server, recording, corrector, first, up), recording)


def _layout_content(given: str | Path, out: Path | None, size: str) -> Content:
    layout = load_layout(given)
    model = HandModel.named(size, side=layout.sides[-1])
    shipped = Path(gloves.layout.__file__).parent / "layouts" / f"{given}.toml"
    path = shipped if isinstance(given, str) else given
    if out is not None:
        check_outputs((path,), (out,))
        if out.exists():
            raise ArgumentError(f"--out is {out}, which exists already, expected a new name")
    target = out or edited_path(Path(f"{layout.name}.toml") if isinstance(given, str) else given)
    return Content("layout", lambda server: _wait_only(LayoutEditor(server, path, layout, model, target)))


def _rig_content(rig: CameraRig) -> Content:
    def show(server: ViserServer) -> Run:
        show_rig(server, rig)
        show_volume(server, rig)
        server.gui.add_markdown(
            f"**{rig.name}**: {len(rig.cameras)} cameras of {rig.pictures()}. "
            "Dots are seen by two cameras or more, blue ones by all. The green cube is where wrists move in "
            "training sets."
        )
        set_stage(server, rig.positions, ground=0.0)
        return _wait_only()

    return Content("rig", show)


def show_recording(
    server: ViserServer,
    recording: Recording,
    corrector: Corrector | None = None,
    first: int = 0,
    up: UpAxis = "z",
) -> Run:
    """Add a recording to a page, opened at frame `first`; return the function that serves the page."""

    def show(index: int) -> None:
        frame = recording.frame(index)
        view.show(frame)
        panel.show(index, frame, hurried=timeline.playing)
        if editor is not None:
            editor.show(index, hurried=timeline.playing)

    def changed() -> None:
        panel.renew()
        timeline.refresh()

    timeline = Timeline(server, recording.times, show)
    panel = StatusPanel(server, recording)
    view = FrameView(server, recording)
    panel.add_doubts(timeline.jump)
    editor: LabelEditor | None = None
    if corrector is not None and isinstance(recording, TakeRecording):
        editor = LabelEditor(server, recording, corrector, changed)
        view.on_pick = editor.pick
    panel.add_plots()
    set_stage(server, first_look(recording), up=up)
    timeline.go_to(first)
    timeline.update()

    def run(ended: Callable[[], bool]) -> None:
        timeline.run(ended)
        if corrector is not None and corrector.added:
            lost = "; ".join(map(str, corrector.added))
            warnings.warn(f"{corrector.path}: not saved: {lost}", HandSimWarning, stacklevel=2)

    return run


def first_look(recording: Recording) -> np.ndarray:
    """Points [m] for the first look: wrists and labeled points of some frames, or else all their points."""
    indices = np.unique(np.linspace(0, recording.num_frames - 1, _FIRST_LOOK_FRAMES).astype(int))
    frames = [recording.frame(int(index)) for index in indices]
    wrists = [frame.qpos[:, :3] for frame in frames]
    labeled = [frame.points[frame.labels >= 0] for frame in frames]
    points = np.concatenate([*wrists, *labeled])
    if np.isfinite(points).all(axis=1).any():
        return points
    return np.concatenate([frame.points for frame in frames])


def _wait_only(_shown: object = None) -> Run:
    """Serve a page that only reacts; `_shown` is kept alive with its handlers."""

    def run(ended: Callable[[], bool]) -> None:
        while not ended():
            time.sleep(0.2)

    return run


def _show_user(server: ViserServer, hands: Sequence[GloveFit]) -> Run:
    """Show a user's flat hands side by side; lines lead from designed to calibrated markers."""
    for node, words in (("/after", "calibrated hands"), ("/before", "hands of the nearest size")):
        switch(server, words, server.scene.add_frame(node, show_axes=False))
    corners = []
    for number, hand in enumerate(hands):
        nominal = [nominal_fit(hand.layout, size, hand.side) for size in SIZES]
        before = min(nominal, key=lambda fit: abs(fit.shape.length - hand.shape.length))
        shift = np.array([0.0, _HAND_SPACING * (number - (len(hands) - 1) / 2), HEIGHT])
        _add_hand(server, f"/after/{hand.side}", hand, shift)
        _add_hand(server, f"/before/{hand.side}", before, shift, _BEFORE_COLOR, 0.35, 0.5)
        points = np.stack([before.attachment.points, hand.attachment.points], axis=1)
        server.scene.add_line_segments(
            f"/moved/{hand.side}", points + shift, (200, 60, 50), thickness=2.0, thickness_units="screen"
        )
        corners.append(hand.model.surface.vertices + shift)
        moved = 1e3 * np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
        server.gui.add_markdown(
            f"**{hand.side}**: {size_words(hand)}, nearest size {size_words(before)}; markers differ by "
            f"{np.median(moved):.1f} mm (median), {moved.max():.1f} mm at most"
        )
    set_stage(server, np.concatenate(corners), ground=0.0)
    return _wait_only()


def _add_hand(
    server: ViserServer,
    node: str,
    hand: GloveFit,
    shift: np.ndarray,
    color: tuple[int, int, int] | None = None,
    opacity: float | None = None,
    size: float = 1.0,
) -> None:
    """Show a flat hand with markers of `size` times their radius."""
    qpos = join_qpos(np.zeros((1, NUM_JOINTS)), position=shift)[0]
    HandSkin(server, f"{node}/skin", color=color, opacity=opacity).show(hand.model, qpos)
    count, radius = hand.layout.num_markers, size * hand.layout.radius
    balls = PointBalls(server, f"{node}/markers", hand.layout.names, most=count, radius=radius)
    balls.show(hand.attachment.points + shift, np.arange(count), np.ones(count, dtype=np.bool_))
