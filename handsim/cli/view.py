"""The command `handsim view`."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from handsim.app.messages import named_steps, print_line, progress_bar
from handsim.cli.options import TrackerOptions, check_source, check_take_file
from handsim.errors import ArgumentError
from handsim.files.outputs import check_outputs
from handsim.files.signals import interrupt_flag
from handsim.space.transforms import UpAxis
from track.streams import LOOPBACK
from track.viewer import address_of, opened_server

if TYPE_CHECKING:
    from handsim.space.rig import CameraRig
    from track.settings import TrackerSetup
    from track.viewer.contents import Content


def view(
    file: Annotated[str | None, tyro.conf.Positional] = None,
    *,
    host: str = LOOPBACK,
    port: int | None = None,
    out: Path | None = None,
    rig: str | None = None,
    live: str | None = None,
    options: Annotated[TrackerOptions, tyro.conf.arg(name="")] = TrackerOptions(),  # noqa: B008 (frozen)
    video: Path | None = None,
    time: float | None = None,
    up: UpAxis = "z",
) -> None:
    """Show a file or a live tracker in the browser; Ctrl-C ends it.

    In a tracked take labels can be corrected, and are saved.

    Args:
        file: A marker layout or camera rig (.toml, or a shipped name), the folder of a training set, also
            as s3://bucket/prefix, a capture (.trc, .c3d, .csv or .tsv), a tracked take or a simulated take's
            truth (.npz), or a user's file (.json).
        host: Address to serve the page at; only this machine reaches the default. There is no password.
        port: Port to serve the page at; the first free one from 8080 on when not given.
        out: File for a layout that was changed, a new name beside the layout when not given; or for the take
            of a live tracker (.npz), which is not recorded when not given.
        rig: Cameras to show with a capture, a take or a stream: a shipped name or the path of a .toml file.
        live: Stream to track instead of a file: natnet://host, qtm://host or module:name.
        options: Options of a live tracker; --size is also that of the hand that wears a layout.
        video: File for a video of a take, capture or training set (.mp4), which is drawn instead of a page.
        time: Time of a take, capture or training set that the page opens at [s]; its start when not given.
        up: The axis of a take, capture or stream that points up; y for Motive's default.
    """
    from handsim.space.rig import load_rig
    from track.settings import TrackerSetup
    from track.viewer.contents import open_content

    check_source("file", file, live)
    if live is not None:
        if video is not None:
            raise ArgumentError(f"--video is {video}, but a live view is not drawn; see handsim track")
        if time is not None:
            raise ArgumentError(f"--time is {time:g} with --live, expected a file")
        if out is not None:
            check_take_file(out, live=True)
            check_outputs((rig, *options.files()), (out,))
        cameras = None if rig is None else load_rig(rig)
        with named_steps(""):  # a glove may have to be learned
            setup = TrackerSetup.of(options.settings())
        _view_live(live, setup, host, port, cameras, out, up)
        return
    _check_still(str(file), options, video, time)
    content = open_content(str(file), out=out, size=options.size, rig=rig, time=time, up=up)
    if video is not None:
        _draw(str(file), content, video, up)
        return
    with opened_server(host, port, "handsim view") as server:
        run = content.show(server)
        with interrupt_flag() as ended:
            print_line(f"{file} ({content.kind}): {address_of(server)} ; Ctrl-C ends it")
            run(ended)


def _check_still(file: str, options: TrackerOptions, video: Path | None, time: float | None) -> None:
    """Refuse options of a live tracker beside a file, and a time to open a video at."""
    given = [one.name for one in fields(options) if one.name != "size" and getattr(options, one.name)]
    if given:
        names = ", ".join(f"--{name}" for name in given)
        raise ArgumentError(f"given {names} and the file {file}, expected --live with it")
    if video is not None and time is not None:
        raise ArgumentError(f"given --time {time:g} and --video {video}, expected one of them")


def _draw(name: str, content: Content, video: Path, up: UpAxis) -> None:
    """Draw the video of a recording."""
    check_outputs((name,), (video,))
    from render.illustrations import write_clip
    from track.viewer.contents import first_look
    from track.viewer.recordings import write_video

    recording = content.recording
    if recording is None:
        raise ArgumentError(f"--video is {video}, but {name} is a {content.kind}: nothing in it moves")
    with progress_bar("pictures") as bar:
        look = first_look(recording)
        count = write_video(video, recording, look, up=up, write_clip=write_clip, progress=bar)
    print_line(f"{video}: {count} pictures of {name} ({content.kind})")


def _view_live(
    url: str,
    setup: TrackerSetup,
    host: str,
    port: int | None,
    cameras: CameraRig | None,
    out: Path | None,
    up: UpAxis,
) -> None:
    """Track a stream and show it until a signal or the stream ends it; record it if `out` is given."""
    from track.live.live_tracking import track_live
    from track.viewer.timeline import LiveView

    with opened_server(host, port, "handsim view") as server, LiveView(server, cameras, up) as view:
        print_line(f"{url}: {address_of(server)} ; Ctrl-C ends it")
        tracked = track_live(url, setup, [view], out=out)
    print_line(*view.notes(), *([] if out is None else [f"{out}: {tracked.num_frames} frames"]))
