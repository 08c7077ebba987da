"""The command `handsim render`."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Annotated, cast

import tyro

from handsim.app.messages import print_line, progress_bar
from handsim.app.output import place_of
from handsim.app.workers import chosen_workers
from handsim.errors import HandSimError
from handsim.files.outputs import check_outputs
from handsim.hand.shape import Side
from render.config import RenderConfig


def render(
    take: Annotated[Path | None, tyro.conf.Positional] = None,
    *,
    out: Annotated[str, tyro.conf.arg(metavar="PATH")],
    poses: Path | None = None,
    hands: tuple[Side, ...] | None = None,
    people: int | None = None,
    glove: str | None = None,
    merge: tuple[Path, ...] = (),
    options: Annotated[RenderConfig, tyro.conf.arg(name="")],
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
            as s3://bucket/prefix (docs/cluster.md).
        poses: Poses of your own (.npz, or .csv as handsim export writes it) instead of a take;
            docs/rendering.md has the arrays and columns.
        hands: Whose poses an .npz has, in its order: right (when not given), left, or both. A .csv names its
            hands, and all are drawn when not given.
        people: Number of people that poses are distributed over; one for each shard when not given.
        glove: Marker layout of poses with --dress glove: a shipped name or the path of a .toml file; dense19
            when not given.
        merge: Folders of other renderings to be copied into one, with keys and ids of their own.
        options: What to draw.
        format: File formats: webdataset, coco, yolo, exr, png; several go into folders.
        workers: Processes; all cores when not given.
        cluster: Where else to draw shards: tcp://host:port of a Dask scheduler, its file (.json), or local;
            docs/cluster.md.
    """
    from render.formats.writer import merge_renderings
    from render.session import (
        SHEET,
        cut_off_pictures,
        hidden_pictures,
        left_out_frames,
        render_take,
        visible_hands,
    )
    from render.subject import CSV, PoseFile

    if sum((take is not None, poses is not None, bool(merge))) != 1:
        raise HandSimError("expected a take, --poses or --merge, and one of them alone")
    place = place_of(out)
    if merge:
        if not isinstance(place, Path):
            raise HandSimError(f"--merge copies into a folder, and {place} is none; copy that folder then")
        own = {hands, people, glove, workers, cluster} - {None}
        if options != RenderConfig() or format != ("webdataset",) or own:
            raise HandSimError("--merge copies pictures as they are; leave out the options of drawing")
        print_line(f"{out}: {merge_renderings(merge, place)} shards of {len(merge)} renderings")
        return
    table = poses if take is None or take.suffix.lower() != CSV else take
    if table is None and {hands, people, glove} != {None}:
        raise HandSimError("--hands, --people and --glove belong to --poses; a take has its own")
    source = cast("Path", take) if table is None else PoseFile(table, hands, people, glove or "dense19")
    check_outputs(
        (take, poses, cast("str | None", options.view.cameras)), (place if isinstance(place, Path) else None,)
    )
    start, counts = time.perf_counter(), list[tuple[int, int]]()
    with progress_bar("images") as bar, chosen_workers(cluster, workers, bar.say) as chosen:

        def show(done: int, total: int) -> None:
            counts.append((done, total))
            doing = "drawing" if done < total else "writing the annotations and the contact sheet"
            bar.step(doing)
            bar(done, total)

        count = render_take(source, place, format, options, workers=chosen, progress=show)
    seconds = time.perf_counter() - start
    if lost := left_out_frames(place):
        print_line(
            f"{out}: frames left out: {len(lost)} (the first: {lost[0]}), where a camera would be inside a "
            "hand or an object"
        )
    if cut := cut_off_pictures(place):
        print_line(f"{out}: images that lack a hand of their frame: {len(cut)} (the first: {cut[0]})")
    if hidden := hidden_pictures(place):
        print_line(
            f"{out}: images left out: {len(hidden)} (the first: {hidden[0]}), which would show no hand"
        )
    if visible := Counter(visible_hands(place)):
        shown = (f"{hands or 'no'} hand{'s' * (hands > 1)} in {visible[hands]}" for hands in sorted(visible))
        print_line(f"{out}: images show {', '.join(shown)}")
    if counts and counts[0][0] == counts[0][1]:
        print_line(f"{out}: complete already, with all of its {count} images")
    else:
        print_line(f"{out}: {count} images in {seconds:.0f} s, {count / seconds:.1f} a second")
    if {"rgb", "depth"} & set(options.passes):
        print_line(f"{place}/{SHEET}: some of them at one glance")
