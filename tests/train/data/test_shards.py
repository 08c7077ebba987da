"""Rows that stay in their files: the same rows as in memory, read by several processes without copies."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from train import MappedRows, TrainSettings
from train.data.batches import Part, draw_batch
from train.data.shards import row_dtype
from train.settings import batch_recipe


def shards_of(sizes):
    rows = np.zeros(sum(sizes), dtype=row_dtype(4))
    rows["hand"] = np.arange(len(rows))
    rows["markers"] = np.random.default_rng(0).normal(size=rows["markers"].shape)
    return rows, np.split(rows, np.cumsum(sizes)[:-1])


@given(st.lists(st.integers(1, 6), min_size=1, max_size=5), st.data())
def test_spans_numbers_and_fields_are_those_of_the_rows_in_memory(sizes, data):
    rows, shards = shards_of(sizes)
    start = data.draw(st.integers(0, len(rows) - 1))
    stop = data.draw(st.integers(start + 1, len(rows)))
    inner = data.draw(st.integers(0, stop - start))
    for mapped, whole in [
        (MappedRows(shards), rows),
        (MappedRows(shards).span(start, stop), rows[start:stop]),
        (MappedRows(shards).span(start, stop).span(0, inner), rows[start : start + inner]),
    ]:
        assert len(mapped) == len(whole)
        assert np.array_equal(mapped["markers"], whole["markers"])
        numbers = np.array(data.draw(st.lists(st.integers(0, len(whole) - 1))) if len(whole) else [], int)
        assert np.array_equal(mapped[numbers], whole[numbers])
        for outside in (-1, len(whole)):
            with pytest.raises(IndexError):
                mapped[np.array([outside])]


def test_a_set_that_is_handed_on_is_its_files(dataset):
    content = pickle.dumps(dataset)
    assert len(content) < 20_000 < sum(shard.nbytes for shard in dataset.shards)
    other = pickle.loads(content)
    assert all(isinstance(shard, np.memmap) for shard in other.shards)
    assert other.rows().tobytes() == dataset.rows().tobytes() and other.marker_names == dataset.marker_names


@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_parts_are_the_batch_of_one_device_shared_out(dataset, share, count):
    recipe = batch_recipe(TrainSettings(batch=32, rig_share=share), 19)
    whole, again = (
        draw_batch(rows, recipe, rng=np.random.default_rng(5))
        for rows in (dataset.rows(), dataset.mapped_rows())
    )
    parts = [Part(first, count).of(again) for first in range(count)]
    assert sum(len(part.markers) for part in parts) == 32
    for first, part in enumerate(parts):
        width = part.cloud.points.shape[1]
        assert np.array_equal(part.markers, whole.markers[first::count])
        for mine, all_of_them in zip(part.cloud, whole.cloud, strict=True):
            assert np.array_equal(mine, all_of_them[first::count, :width])
        assert not whole.cloud.present[first::count, width:].any()
    means = [part.cloud.points[part.cloud.present].mean() for part in parts]
    weighted = np.mean([part.weights.points * mean for part, mean in zip(parts, means, strict=True)])
    assert weighted == pytest.approx(whole.cloud.points[whole.cloud.present].mean())
    assert np.mean([part.weights.clouds for part in parts]) == pytest.approx(1.0)
