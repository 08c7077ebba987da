"""The command `handsim demo`: the whole chain on a built-in example, and a page that shows it."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from handsim._checks import check_count
from handsim.app.messages import print_line
from handsim.app.page import write_page
from handsim.app.progress import named_steps
from handsim.files.outputs import atomic_write, written_together


def demo(out: Path = Path("demo"), seed: int = 0, num_frames: int = 2000) -> None:
    """Run the whole chain on a built-in example: generate, label, track, draw; ends with a page of pictures.

    Args:
        out: Folder for index.html and its pictures.
        seed: Of the generated frames and of everything drawn at random.
        num_frames: Frames to generate and label.
    """
    check_count("num_frames", num_frames, 1)
    check_count("seed", seed, 0)
    out.mkdir(parents=True, exist_ok=True)
    console, page = Console(), out / "index.html"
    with tempfile.TemporaryDirectory(prefix=".work-", dir=out) as work, named_steps("starting") as step:
        from handsim.cli.demo_sections import GLOVE, demo_sections

        pictures = Path(work) / "pictures"
        sections = list(demo_sections(pictures, Path(work), seed=seed, num_frames=num_frames, report=step))
        with written_together():
            for picture in sorted(pictures.iterdir()):
                with atomic_write(out / picture.name) as temporary:
                    shutil.copyfile(picture, temporary)
            write_page(
                page,
                sections,
                title="handsim demo",
                lead="A hand in a marker glove takes poses in front of simulated cameras. A labeler that was "
                "trained on simulation alone labels the points that the cameras see.",
            )
    figures = sections[-1]
    printed = Table(title=f"{num_frames} generated frames, glove {GLOVE}")
    for number, column in enumerate(figures.table[0]):
        printed.add_column(Text(column), justify="right" if number else "left")
    for row in figures.table[1:]:
        printed.add_row(*row)
    console.print(printed)
    console.print(figures.notes[0])
    print_line(f"page: {page.resolve()}")
