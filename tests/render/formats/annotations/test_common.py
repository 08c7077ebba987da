from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from render.formats.annotations.common import hand_mask, run_lengths, to_json
from render.frames import PARTS_A_HAND
from render.skin.forearm import FOREARM


@given(hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_run_lengths_spell_the_mask(mask: np.ndarray) -> None:
    counts = run_lengths(mask)
    values = np.arange(len(counts)) % 2 == 1
    np.testing.assert_array_equal(np.repeat(values, counts).reshape(mask.shape, order="F"), mask)
    assert all(counts[1:])


@given(hnp.arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12))))
def test_pycocotools_reads_run_lengths(mask: np.ndarray) -> None:
    coco_mask = pytest.importorskip("pycocotools.mask")
    record = {"size": list(mask.shape), "counts": run_lengths(mask)}
    decoded = coco_mask.decode(coco_mask.frPyObjects(record, *mask.shape))
    np.testing.assert_array_equal(decoded.astype(bool), mask)


def test_a_hand_is_masked_without_its_forearm(make_frame) -> None:
    frame = make_frame(sides=("right", "left"))
    parts, instances = frame.ideal.parts, frame.ideal.instances
    parts[:6, :6], instances[:6, :6] = 1 + PARTS_A_HAND + FOREARM, 2
    instances[:3, 90:] = 2  # a marker, which is no bone's
    mask = hand_mask(frame, 1)
    assert not mask[:6, :6].any()
    assert mask[:3, 90:].all()
    np.testing.assert_array_equal(
        mask & (parts > 0), (parts > PARTS_A_HAND) & (parts < 1 + PARTS_A_HAND + FOREARM)
    )
    assert not (mask & hand_mask(frame, 0)).any()


def test_nan_becomes_null() -> None:
    text = to_json({"a": np.array([1.5, np.nan]), 3: (np.int64(2), float("inf")), "t": np.bool_(True)})
    assert json.loads(text) == {"a": [1.5, None], "3": [2, None], "t": True}
