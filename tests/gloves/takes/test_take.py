"""Takes on disk: whole and exact when read again, one sentence when they are not, and never unpickled."""

from __future__ import annotations

import dataclasses
import json
import sys
import zipfile

import numpy as np
import pytest

from gloves.fit import GlovedHand, attach, nominal_fit
from gloves.layout import load_layout
from gloves.takes.take import SCHEMA, SUFFIX, HeldBody, Take, load_take
from handsim.errors import CaptureError
from handsim.hand.model import HandModel
from handsim.hand.shape import sample_shape

FRAMES, COLUMNS = 7, 45


@pytest.fixture
def take(rng) -> Take:
    points = rng.normal(size=(FRAMES, COLUMNS, 3))
    labels = np.tile(np.arange(COLUMNS) - 1, (FRAMES, 1))
    ids = np.tile(np.arange(COLUMNS), (FRAMES, 1))
    gone = rng.random((FRAMES, COLUMNS)) < 0.2
    points[gone], labels[gone], ids[gone] = np.nan, -1, -1
    layout = load_layout("dense19")
    model = HandModel(sample_shape(side="right", rng=rng))
    hands = (
        GlovedHand(attach(layout, model), rng.normal(size=(FRAMES, 27))),
        GlovedHand(nominal_fit(layout, "XS", "left"), rng.normal(size=(FRAMES, 27))),
    )
    body = HeldBody("wand", tuple("abcdef"), np.tile(np.eye(4), (FRAMES, 1, 1)))
    return Take(120.0, points, ids, labels, hands, body, {"seed": 3, "room": {"optics": {"noise": 0.1}}})


def altered(path, **arrays) -> None:
    """Write the take anew with some arrays replaced, None taking one away."""
    with np.load(path) as stored:
        old = {name: stored[name] for name in stored.files}
    kept = {name: array for name, array in (old | arrays).items() if array is not None}
    with path.open("wb") as file:
        np.savez_compressed(file, **kept)


def header_of(path) -> dict:
    with np.load(path) as stored:
        return json.loads(str(stored["header"]))


def test_what_is_saved_is_what_is_read(take, tmp_path):
    one = np.where(take.labels < 19, take.labels, -1)
    alone = dataclasses.replace(take, body=None, hands=take.hands[:1], labels=one)
    for number, original in enumerate((take, alone)):
        path = tmp_path / f"{number}{SUFFIX}"
        original.save(path)
        again = load_take(path)
        for name in ("points", "ids", "labels"):
            np.testing.assert_array_equal(getattr(again, name), getattr(original, name))
        assert (again.rate, again.settings, again.num_frames) == (120.0, original.settings, FRAMES)
        assert len(again.hands) == len(original.hands)
        for ours, theirs in zip(original.hands, again.hands, strict=True):
            assert ours.layout == theirs.layout
            np.testing.assert_array_equal(ours.qpos, theirs.qpos)
            for field in dataclasses.fields(ours.shape):
                np.testing.assert_array_equal(
                    getattr(ours.shape, field.name), getattr(theirs.shape, field.name)
                )
        if original.body is None:
            assert again.body is None
        else:
            assert (again.body.name, again.body.marker_names) == ("wand", tuple("abcdef"))
            np.testing.assert_array_equal(again.body.T_world_body, original.body.T_world_body)
        assert [path.name for path in tmp_path.glob(".*")] == []


def test_labels_count_through_the_hands(take):
    assert take.hand_labels == (range(0, 19), range(19, 38))
    for label in (*take.hand_labels, range(38, 44)):
        observed = take.observed(label)
        for marker, name in enumerate(label):  # the fixture has label c - 1 in column c
            np.testing.assert_array_equal(observed[:, marker], take.points[:, name + 1])


def assert_refused(path, *words: str) -> None:
    with pytest.raises(CaptureError) as caught:
        load_take(path)
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: ") and "\n" not in sentence
    for word in words:
        assert word in sentence


def test_foreign_files_are_refused_in_a_sentence(tmp_path):
    contents = {
        "empty": b"",
        "text": b"Frame#\tTime\n",
        "zip that is none": b"PK\x03\x04" + 60 * b"\x00",
        "pickle": b"\x80\x04K\x01.",
    }
    path = tmp_path / f"foreign{SUFFIX}"
    assert_refused(path, "No such file")
    for content in contents.values():
        path.write_bytes(content)
        assert_refused(path, "not a take")
    with path.open("wb") as file:
        np.savez(file, something=np.zeros(3))
    assert_refused(path, "not a take")
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    assert_refused(path, "not a take")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "hello")
    assert_refused(path, "not a take")
    assert_refused(tmp_path)


def test_another_schema_is_named(take, tmp_path):
    path = tmp_path / f"take{SUFFIX}"
    take.save(path)
    altered(path, header=np.array(json.dumps(header_of(path) | {"schema": SCHEMA + 1})))
    assert_refused(path, f"schema {SCHEMA + 1}", f"expected {SCHEMA}")


def test_damage_is_told_wherever_it_is(take, tmp_path, rng):
    path = tmp_path / f"take{SUFFIX}"
    take.save(path)
    whole = path.read_bytes()
    for place in rng.integers(len(whole) - 1, size=60):  # cut
        path.write_bytes(whole[:place])
        assert_refused(path, "not a take, or a damaged one")
    refused = 0
    for place in rng.integers(len(whole), size=150):  # one byte wrong: some bytes of a zip mean nothing
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            again = load_take(path)
        except CaptureError as error:
            refused += 1
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
        else:
            np.testing.assert_array_equal(again.points, take.points)
    assert refused > 100


def test_arrays_that_do_not_fit_together_are_refused(take, tmp_path):
    path = tmp_path / f"take{SUFFIX}"
    take.save(path)
    whole = path.read_bytes()
    header = header_of(path)
    wrong = {
        "points": np.zeros((FRAMES, COLUMNS, 2)),
        "ids": np.zeros((FRAMES, COLUMNS - 1), dtype=np.int32),
        "labels": np.full((FRAMES, COLUMNS), 44, dtype=np.int16),
        "hands": None,
        "qpos": np.zeros((2, FRAMES - 1, 27)),
        "T_world_body": np.zeros((0, 4, 4)),
        "header": np.array(json.dumps(header | {"layouts": header["layouts"][:1]})),
    }
    for name, array in wrong.items():
        path.write_bytes(whole)
        altered(path, **{name: array})
        assert_refused(path, "not a take, or a damaged one")
    for change in ({"rate": "fast"}, {"rate": -1.0}, {"layouts": [{"name": "x"}] * 2}, {"layouts": None}):
        path.write_bytes(whole)
        altered(path, header=np.array(json.dumps(header | change)))
        assert_refused(path, "not a take, or a damaged one")
    for text in ("[]", "3", "{", '{"schema": 1}'):
        altered(path, header=np.array(text))
        assert_refused(path, "not a take, or a damaged one")


class Trap:
    """Whoever unpickles it leaves a mark."""

    def __reduce__(self):
        return exec, ("import sys; sys.modules['test_take_sprung'] = True",)


def test_nothing_is_ever_unpickled(take, tmp_path):
    path = tmp_path / f"take{SUFFIX}"
    take.save(path)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    sys.modules.pop("test_take_sprung", None)
    for name in ("header", "points", "qpos", "more"):
        with path.open("wb") as file:
            np.savez(file, **arrays | {name: np.array([Trap()], dtype=object)})
        assert_refused(path, "not a take, or a damaged one")
        assert "test_take_sprung" not in sys.modules
    with np.load(path, allow_pickle=True) as stored:  # the trap works
        _ = stored["more"]
    assert sys.modules.pop("test_take_sprung")
