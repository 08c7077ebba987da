"""Results in every form say the same, and what is wrong in one is told in a sentence."""

from __future__ import annotations

import re

import numpy as np
import pytest

from benchmarks.public.answers import Answers, BenchmarkError, save_answers
from benchmarks.public.manifest import label_names
from benchmarks.public.results import find_results, read_result
from gloves import Capture
from track import track_capture

NAME = "hand-controller-hard-1"
LABELS = label_names()


@pytest.fixture(scope="module")
def capture(benchmark):
    return benchmark.capture(NAME)


@pytest.fixture(scope="module")
def truth(benchmark):
    return benchmark.truth(NAME)


def table(capture: Capture, labels: np.ndarray) -> str:
    rows = [
        f"{frame + 1},{capture.names[column]},{LABELS[labels[frame, column]]}"
        for frame, column in np.argwhere(labels >= 0)
    ]
    return "\n".join(["frame,point,label", *rows]) + "\n"


def test_a_table_gives_the_labels(capture, truth, tmp_path):
    path = tmp_path / f"{NAME}.csv"
    path.write_text(table(capture, truth.labels))
    answers = read_result(path, capture, LABELS)
    np.testing.assert_array_equal(answers.labels, truth.labels)
    assert answers.joints is None and answers.angles is None
    excel = "\ufeffFrame, Point, Label\r\n" + table(capture, truth.labels).split("\n", 1)[1].replace(
        "\n", "\r\n"
    )
    frame, column = np.argwhere(np.isfinite(capture.positions[..., 0]) & (truth.labels < 0))[0]
    path.write_text(f"{excel}\r\n{frame + 1},{capture.names[column]},none\r\n", encoding="utf-8")
    np.testing.assert_array_equal(read_result(path, capture, LABELS).labels, truth.labels)


def test_a_tracked_take_gives_labels_joints_and_angles(benchmark, capture, truth, tmp_path):
    users = benchmark.user(NAME)
    take = track_capture(capture, hands=users[::-1], labeler="dense19")
    take.save(tmp_path / f"{NAME}.npz")
    answers = read_result(tmp_path / f"{NAME}.npz", capture, LABELS)
    assert (answers.labels == truth.labels).mean() > 0.97
    found = np.isfinite(answers.joints)
    assert found.mean() > 0.8
    assert np.abs((answers.joints - truth.joints)[found]).mean() < 0.002
    np.testing.assert_allclose(answers.joints[:, 1], take.keypoints()[:, 0])
    other = benchmark.capture("single-hand-easy-1")
    with pytest.raises(BenchmarkError, match=r"of \d+ columns, expected the capture's 30 of 38"):
        read_result(tmp_path / f"{NAME}.npz", other, LABELS)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "line 1 is '', expected the columns frame,point,label"),
        ("frame;point;label\n", "expected the columns frame,point,label"),
        ("frame,point,label\n0,Unlabeled1,left:RingTip\n", "line 2 is of frame '0', expected 1 to 30"),
        ("frame,point,label\n31,Unlabeled1,left:RingTip\n", "line 2 is of frame '31', expected 1 to 30"),
        ("frame,point,label\n1.5,Unlabeled1,left:RingTip\n", "line 2 is of frame '1.5', expected 1 to 30"),
        ("frame,point,label\n1,Unlabelled1,left:RingTip\n", "unknown point 'Unlabelled1' (did you mean"),
        ("frame,point,label\n1,Unlabeled1,RingTip\n", "unknown label 'RingTip' (did you mean"),
        ("frame,point,label\n1,Unlabeled1\n", "line 2 has 2 cells, expected frame,point,label"),
        ("frame,point,label\n1,Unlabeled1,none\n1,Unlabeled1,none\n", "line 3 labels Unlabeled1 of frame 1"),
        (
            "frame,point,label\n1,Unlabeled1,left:RingTip\n1,Unlabeled2,left:RingTip\n",
            "frame 1 has left:RingTip twice, expected each label once at most",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_table_is_told(text, sentence, capture, tmp_path):
    assert np.isfinite(capture.positions[0, :2, 0]).all()
    path = tmp_path / f"{NAME}.csv"
    path.write_text(text)
    with pytest.raises(BenchmarkError, match=re.escape(sentence)) as told:
        read_result(path, capture, LABELS)
    assert str(told.value).startswith(str(path)) and "\n" not in str(told.value)


def test_a_label_of_no_point_is_told(capture, tmp_path):
    frame, column = np.argwhere(np.isnan(capture.positions[..., 0]))[0]
    path = tmp_path / f"{NAME}.csv"
    path.write_text(f"frame,point,label\n{frame + 1},{capture.names[column]},left:RingTip\n")
    told = f"frame {frame + 1} labels column {column + 1}, which has no point there"
    with pytest.raises(BenchmarkError, match=told):
        read_result(path, capture, LABELS)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"labels": np.zeros((29, 2), dtype=int)}, "labels are of 29 frames of 2 columns, expected"),
        ({"labels": np.zeros((30, 2))}, "labels are float64 of shape (30, 2), expected whole numbers"),
        ({"joints": np.zeros((30, 21, 3))}, "joints are float64 of shape (30, 21, 3), expected floats"),
        ({"joints": np.full((30, 2, 21, 3), 1100.0)}, "joints reach 1100, expected meters"),
        ({"joints": np.full((30, 2, 21, 3), np.inf)}, "joints reach inf, expected meters"),
        ({"angles": np.full((30, 2, 20), 45.0)}, "angles reach 45, expected radians"),
        ({"labels": None}, "the arrays are none, expected labels"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_arrays_is_told(changes, sentence, capture, truth, tmp_path):
    arrays = {"labels": truth.labels} | changes
    path = tmp_path / f"{NAME}.npz"
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(BenchmarkError, match=re.escape(sentence)):
        read_result(path, capture, LABELS)


def test_labels_beyond_the_last_are_told(capture, truth, tmp_path):
    labels = truth.labels.copy()
    labels[labels == 3] = 38
    save_answers(tmp_path / "a.npz", Answers(labels))
    with pytest.raises(BenchmarkError, match="labels go from -1 to 38, expected -1 for none to 37"):
        read_result(tmp_path / "a.npz", capture, LABELS)


def test_results_are_found_by_the_names_of_captures(tmp_path):
    with pytest.raises(BenchmarkError, match="no such folder"):
        find_results(tmp_path / "nowhere", ["a-1"])
    for name in ("about.json", "notes.txt", ".hidden.csv"):
        (tmp_path / name).touch()
    with pytest.raises(BenchmarkError, match=r"holds no results, expected a-1\.csv and so on"):
        find_results(tmp_path, ["a-1"])
    for name in ("a-1.csv", "b-1.npz", "c-1.npz"):
        (tmp_path / name).touch()
    found, unknown = find_results(tmp_path, ["a-1", "b-1"])
    assert found == {"a-1": tmp_path / "a-1.csv", "b-1": tmp_path / "b-1.npz"} and unknown == ["c-1.npz"]
    (tmp_path / "a-1.npz").touch()
    with pytest.raises(BenchmarkError, match=r"a-1\.csv and a-1\.npz, expected one of them"):
        find_results(tmp_path, ["a-1"])
