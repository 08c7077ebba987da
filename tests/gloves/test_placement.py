"""A marker that is put on a point of the skin is there when the glove is put on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gloves.fit import attach_markers, nominal_fit, place_marker
from gloves.layout import load_layout
from handsim.hand.model import HandModel
from handsim.hand.skin import vertex_normals

LAYOUT = load_layout("dense19")
MODELS = {side: HandModel.named("M", side=side) for side in ("right", "left")}


STALKS = dataclasses.replace(
    LAYOUT, markers=tuple(dataclasses.replace(marker, height=0.01) for marker in LAYOUT.markers)
)


@pytest.mark.parametrize("layout", [LAYOUT, STALKS])
@pytest.mark.parametrize("side", ["right", "left"])
def test_a_marker_that_is_put_where_it_is_stays_there(side, layout):
    fit = nominal_fit(layout, "L", side)
    for index in range(0, layout.num_markers, 1 if layout is LAYOUT else 5):
        moved = place_marker(layout, index, fit.model, fit.attachment.points[index])
        assert moved.markers[index].bone == layout.markers[index].bone
        assert moved.markers[index].height == layout.markers[index].height
        assert moved.markers[:index] == layout.markers[:index]
        assert moved.markers[index + 1 :] == layout.markers[index + 1 :]
        again = attach_markers(moved, fit.model).points[index]
        tolerance = 2e-4 if layout is LAYOUT else 5e-4
        np.testing.assert_allclose(again, fit.attachment.points[index], atol=tolerance)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(["right", "left"]),
    st.integers(0, LAYOUT.num_markers - 1),
    st.integers(0, 10**6),
    st.floats(0.0, 0.02),
)
def test_a_marker_goes_to_the_skin_below_the_point(side, index, place, height):
    model = MODELS[side]
    surface = model.surface
    vertex = place % len(surface.vertices)
    normal = vertex_normals(surface.vertices, surface.faces)[vertex]
    point = surface.vertices[vertex] + (LAYOUT.radius + height) * normal
    center = attach_markers(place_marker(LAYOUT, index, model, point), model).points[index]
    nearest = np.linalg.norm(surface.vertices - point, axis=1).min()
    assume(nearest > LAYOUT.radius + height - 1e-4)  # no marker fits into the folds between the fingers
    assert np.linalg.norm(center - point) < height + 0.016  # the wrist's cut is beyond what a layout reaches
    assert LAYOUT.radius - 1e-3 < np.linalg.norm(surface.vertices - center, axis=1).min() < 0.008
