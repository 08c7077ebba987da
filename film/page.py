"""The page on a video that was registered to a take."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from handsim.pages import Paint, Section, html_list, picture, write_sections

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from film.registration import Registration


def write_film_page(path: Path, registration: Registration) -> None:
    """Write the page: camera and clock, residuals over time, frames left out."""
    used = registration.reasons.count("")
    usual = ["The hands determine the clock, the lens and the camera's position well."]
    text = (
        "Median distance, in each frame, between the hands' outlines in the picture and those of the take, "
        "or between keypoints where outlines are not seen; a line marks each move of the camera."
    )
    drawn = picture((9.0, 2.6), _draw_residuals, registration), "Residuals over time"
    sections = [
        Section(
            "Camera and clock", html_list(registration.doubts() or usual, "ul"), table=registration.figures()
        ),
        Section("Residuals over time", text, [drawn], notes=registration.left_out()),
    ]
    of_all = f"{used} of {len(registration.reasons)} frames"
    lead = f"{of_all} fit, with a median residual of {registration.residual():.1f} px."
    write_sections(path, sections, title="A video, registered to a take", lead=lead)


def _draw_residuals(figure: Figure, registration: Registration) -> None:
    panel = figure.subplots()
    fits = np.array([not reason for reason in registration.reasons])
    for kept, color, name in ((fits, Paint.BLUE, "fits"), (~fits, Paint.WARM, "does not fit")):
        times, distances = registration.times[kept], registration.distances[kept]
        panel.plot(times, distances, ".", ms=2.5, color=color, label=name)
    for start in registration.starts[1:]:
        panel.axvline(float(registration.times[start]), color=Paint.INK, lw=1.0)
    panel.set(xlabel="time in the video [s]", ylabel="residual [px]", ylim=(0.0, None))
    panel.legend(frameon=False, ncols=2)
