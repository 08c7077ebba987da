"""The command `handsim report`: the page on a take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from handsim.app.messages import print_line
from handsim.cli.options import neutral_pose
from handsim.cli.study import Step, StudyFile, is_study, run_study, study_files
from handsim.files.outputs import check_outputs, write_text


def report(
    takes: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    neutral: tuple[str, ...] | None = None,
    decimal: Literal[".", ","] = ".",
    guesses: bool = False,
    cycles: str | None = None,
) -> None:
    """Write a page on a take: joint angles, range of motion, gaps, residuals, doubtful frames.

    Beside it are its tables: OUT with the ending .frames.csv has a row per frame and hand, .joints.csv the
    ranges of motion and errors, .markers.csv what was seen of each marker, .doubts.csv the doubtful frames,
    .reach.csv how near the thumb came to the fingers, .angles.csv a row per joint and measure. Of several
    takes the latter are joined in OUT/study.csv, and with --cycles those of cycles in OUT/cycles.csv; a take
    that cannot be read is reported, and what OUT has of the same takes and options stays.

    Args:
        takes: A take (.npz, of handsim track or the .truth.npz of handsim simulate); several of them,
            folders, or a table of them (.csv), see docs/how_to/study.md.
        out: The page, an .html file, whole in itself; of several takes a folder of pages.
        neutral: First and last time [s] of a pose in which the angles of .angles.csv are zero, or the take
            (.npz) of a trial that shows this pose, such as the flat hand before the session.
        decimal: A comma for tables as programs in much of Europe read them, with semicolons between cells.
        guesses: Whether curves and .frames.csv have angles, too, of joints beyond which no marker was seen.
        cycles: A joint of the model, such as index_PIP_flexion: the movement is cut where it is least, and
            page and .cycles.csv tell all joints' angles over the cycles, their ranges and velocities.
    """
    from track.takes.take_figures import PageSettings
    from track.takes.take_tables import table_paths

    if not is_study(takes, out):
        _report(takes, out, neutral=neutral, decimal=decimal, guesses=guesses, cycles=cycles)
        return

    def plan(file: StudyFile) -> Step:
        page = out / file.name.with_suffix(".html")
        zero = (file.cells["neutral"],) if "neutral" in file.cells else neutral
        words = {name: file.cells.get(name, "") for name in ("person", "session")}
        options = {**words, "neutral": zero, "decimal": decimal, "guesses": guesses, "cycles": cycles}
        return Step((page, *table_paths(page, PageSettings(cycles=cycles))), zero or (), options)

    def join(steps: list[Step]) -> None:
        for place, name in ((-1, "study.csv"), (-2, "cycles.csv"))[: 1 if cycles is None else 2]:
            tables = [step.outputs[place].read_text("utf-8").splitlines() for step in steps]
            if tables:
                rows = [*tables[0][:1], *(row for table in tables for row in table[1:])]
                write_text(out / name, "".join(f"{row}\n" for row in rows))

    run_study(study_files(takes, out, [".html"], [".npz"]), out, _report, plan, "reported", join)


def _report(takes: tuple[Path, ...], out: Path, *, neutral: tuple[str, ...] | None, **settings: Any) -> None:
    """Write the page on a take and its tables."""
    from gloves.takes.take import load_take
    from track.takes.take_figures import PageSettings
    from track.takes.take_page import write_take_page
    from track.takes.take_tables import table_paths

    (take,) = takes
    chosen = PageSettings(neutral=neutral_pose(neutral), **settings)
    check_outputs([take, *(neutral or ())], [out, *table_paths(out, chosen)])
    page, frames, *tables = write_take_page(out, load_take(take), source=str(take), settings=chosen)
    print_line(f"{page}: page on {take}; tables in {', '.join(map(str, (frames, *tables)))}")
