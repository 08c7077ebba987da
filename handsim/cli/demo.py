"""The command `handsim demo`: the whole chain on a built-in example, and a page that shows it."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from handsim._checks import check_count
from handsim.app.messages import named_steps, print_line, print_table
from handsim.files.outputs import atomic_write, written_together
from handsim.pages import write_sections


def demo(out: Path = Path("demo"), seed: int = 0, num_frames: int = 2000) -> None:
    """Run the whole chain on a built-in example: generate, label, track, draw; ends with a page of pictures.

    Args:
        out: Folder for index.html and its pictures.
        seed: Seed of the generated frames and of everything drawn at random.
        num_frames: Frames to generate and label.
    """
    check_count("num_frames", num_frames, 1)
    check_count("seed", seed, 0)
    out.mkdir(parents=True, exist_ok=True)
    page = out / "index.html"
    with tempfile.TemporaryDirectory(prefix=".work-", dir=out) as work, named_steps("starting") as step:
        from handsim.cli.demo_sections import GLOVE, demo_sections

        pictures = Path(work) / "pictures"
        sections = list(demo_sections(pictures, Path(work), seed=seed, num_frames=num_frames, report=step))
        with written_together():
            for picture in sorted(pictures.iterdir()):
                with atomic_write(out / picture.name) as temporary:
                    shutil.copyfile(picture, temporary)
            write_sections(
                page,
                sections,
                title="handsim demo",
                lead="A hand in a marker glove takes poses in front of simulated cameras. A labeler that was "
                "trained on simulation alone labels the points that the cameras see.",
            )
    figures = sections[-1]
    print_table(figures.table, title=f"{num_frames} generated frames, glove {GLOVE}")
    print_line(figures.notes[0])
    print_line(f"page: {page.resolve()}")
