"""The page on a video that was registered to a take."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from handsim.pages import Paint, Section, html_list, picture, write_sections

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from film.registration import Registration


def write_film_page(path: Path, found: Registration) -> None:
    """Write the page: camera and clock, residuals over time, frames left out."""
    counted = found.reasons.count("")
    doubts = found.doubts() or ["The hands tell the clock, the lens and the camera's place well."]
    sections = [
        Section("Camera and clock", html_list(doubts, "ul"), table=found.figures()),
        Section(
            "Residuals over time",
            "Distance of the hands' outlines in the picture from the take's, or of keypoints where outlines "
            "are not seen, the median of each frame; a line for each move of the camera.",
            [(picture((9.0, 2.6), _over_time, found), "Residuals over time")],
            notes=found.left_out(),
        ),
    ]
    lead = f"{counted} of {len(found.reasons)} frames count, {found.residual():.1f} px off in the median."
    write_sections(path, sections, title="A video, registered to a take", lead=lead)


def _over_time(figure: Figure, found: Registration) -> None:
    panel = figure.subplots()
    fits = np.array([not reason for reason in found.reasons])
    for kept, color, name in ((fits, Paint.BLUE, "counts"), (~fits, Paint.WARM, "does not")):
        panel.plot(found.times[kept], found.distances[kept], ".", ms=2.5, color=color, label=name)
    for start in found.starts[1:]:
        panel.axvline(float(found.times[start]), color=Paint.INK, lw=1.0)
    panel.set(xlabel="time in the video [s]", ylabel="residual [px]", ylim=(0.0, None))
    panel.legend(frameon=False, ncols=2)
