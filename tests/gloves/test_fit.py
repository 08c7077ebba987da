from __future__ import annotations

import dataclasses

import pytest

from gloves.fit import attach, nearest_markers


def test_the_nearest_markers_are_named() -> None:
    fit = attach("dense19", "M")
    points = fit.attachment.points.copy()
    points[7] = points[2] + [0.0, 0.003, 0.004]
    first, second, distance = nearest_markers(
        dataclasses.replace(fit, attachment=dataclasses.replace(fit.attachment, points=points))
    )
    assert (first, second) == (fit.layout.names[2], fit.layout.names[7])
    assert distance == pytest.approx(0.005)
