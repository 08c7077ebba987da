"""Hands that the shipped detector finds in drawn pictures, damaged weights, and training for a few steps."""

from __future__ import annotations

import functools
import itertools
import json
import shutil

import cv2
import numpy as np
import pytest
import torch

from film import HandDetector, train_detector, training
from film.detector import (
    FINDER,
    HEAT_SIZE,
    KEYPOINTS,
    MOST_BYTES,
    WEIGHTS,
    Candidate,
    cut,
    palm_spread,
    peaks_of,
    square_around,
    upright,
)
from film.network import FinderNetwork, KeypointNetwork
from film.training import SCENES, Scene, draw_scenes, lessons_of
from handsim.errors import ArgumentError, WeightsError
from handsim.hand.shape import SIDES
from tests.sentences import error_names

BARE, GLOVED, TWO_GLOVED = 0, 1, 5  # numbers of shards


@pytest.fixture(scope="module")
def detector():
    return HandDetector.load()


@pytest.fixture(scope="module")
def drawn():
    """A few scenes of each kind that nobody learned from."""
    return {
        kind: [one for one in itertools.islice(draw_scenes(kind, seed=1234), 24) if len(one.sides)]
        for kind in (BARE, GLOVED, TWO_GLOVED)
    }


def boxes_of(scene):
    low, high = scene.keypoints.min(axis=1), scene.keypoints.max(axis=1)
    return np.column_stack([low, high - low])


def pck(found, truth):
    return float((np.linalg.norm(found - truth, axis=1) < 0.1 * np.ptp(truth, axis=0).max()).mean())


@pytest.mark.parametrize("kind", [BARE, GLOVED])
def test_a_drawn_hand_is_found(detector, drawn, kind):
    hits = []
    for scene in drawn[kind]:
        found = detector.detect(scene.picture)
        (box,) = boxes_of(scene)
        away = [np.linalg.norm(one.box[:2] + 0.5 * one.box[2:] - box[:2] - 0.5 * box[2:]) for one in found]
        hits.append(min(away, default=np.inf) < 0.4 * box[2:].max())
        for one in found:
            assert one.side in SIDES and 0.5 <= one.confidence <= 1.0
            assert one.keypoints.shape == (21, 2) and (one.scores >= 0.0).all() and (one.scores <= 1.0).all()
            np.testing.assert_allclose(one.box[:2], one.keypoints.min(axis=0))
        assert [one.confidence for one in found] == sorted((one.confidence for one in found), reverse=True)
    assert np.mean(hits) > 0.6


@pytest.mark.parametrize("kind", [BARE, GLOVED])
def test_keypoints_are_found_in_known_boxes(detector, drawn, kind):
    shares = []
    for scene in drawn[kind]:
        (hand,) = detector.refine(scene.picture, boxes_of(scene), [SIDES[n] for n in scene.sides])
        assert hand.side == SIDES[scene.sides[0]]
        shares.append(pck(hand.keypoints, scene.keypoints[0]))
    assert np.mean(shares) > 0.45


def test_both_hands_are_found(detector, drawn):
    both = [scene for scene in drawn[TWO_GLOVED] if len(scene.sides) == 2]
    counts = [len(detector.detect(scene.picture)) for scene in both]
    assert np.mean([count == 2 for count in counts]) > 0.3
    assert np.mean(counts) > 1.2


def test_the_side_of_most_bare_hands_is_right(detector, drawn):
    right = []
    for scene in drawn[BARE]:
        right += [one.side == SIDES[scene.sides[0]] for one in detector.detect(scene.picture)[:1]]
    assert len(right) > 10 and np.mean(right) > 0.6


def test_mirrored_palms_spread_the_other_way():
    keypoints = np.random.default_rng(0).normal(size=(21, 2))
    palm = np.array([[0.0, 0.0], [1.0, -2.0], [-1.0, -2.0]])  # of a right hand
    keypoints[[0, 5, 17]] = palm
    assert palm_spread(keypoints) > 0.0
    assert palm_spread(keypoints * [-1.0, 1.0]) == -palm_spread(keypoints)
    assert palm_spread(keypoints @ upright(keypoints).T) == pytest.approx(palm_spread(keypoints))


def test_a_plain_picture_has_no_hand(detector):
    assert detector.detect(np.full((480, 640, 3), 120, np.uint8)) == []


def test_a_box_outside_of_the_picture_has_no_hand(detector, drawn):
    picture = drawn[BARE][0].picture
    (hand,) = detector.refine(picture, [[5000.0, -900.0, 80.0, 60.0]], ["left"])
    assert hand.confidence < 0.5 and np.isfinite(hand.keypoints).all()


def test_wrong_arguments_are_told(detector):
    picture = np.zeros((48, 64, 3), np.uint8)
    for words, call in (
        ("float64 | uint8", lambda: detector.detect(picture.astype(float))),
        ("(48, 64) | (H, W, 3)", lambda: detector.detect(picture[..., 0])),
        ("picture.png | expected", lambda: detector.detect("picture.png")),
        ("1 boxes and 0 sides", lambda: detector.refine(picture, [[0.0, 0.0, 5.0, 5.0]], [])),
        ("size | expected", lambda: detector.refine(picture, [[0.0, 0.0, 0.0, 5.0]], ["left"])),
        ("finite | expected", lambda: detector.refine(picture, [[0.0, 0.0, np.nan, 5.0]], ["left"])),
        ("(1, 3) | (..., 4)", lambda: detector.refine(picture, [[0.0, 0.0, 5.0]], ["left"])),
        ("both | left, right", lambda: detector.refine(picture, [[0.0, 0.0, 5.0, 5.0]], ["both"])),
    ):
        with error_names(ArgumentError, words):
            call()


@pytest.mark.parametrize("name", [FINDER, KEYPOINTS])
@pytest.mark.parametrize("damage", ["missing", "empty", "short", "flipped", "other", "text", "large"])
def test_damaged_weights_end_in_a_sentence(tmp_path, name, damage):
    for one in (FINDER, KEYPOINTS):
        shutil.copy(WEIGHTS / one, tmp_path / one)
    path, content = tmp_path / name, (WEIGHTS / name).read_bytes()
    middle = len(content) // 2
    if damage == "missing":
        path.unlink()
    elif damage == "large":
        with path.open("wb") as file:
            file.truncate(MOST_BYTES + 1)
    else:
        path.write_bytes(
            {
                "empty": b"",
                "short": content[:middle],
                "flipped": content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :],
                "other": (WEIGHTS / (KEYPOINTS if name == FINDER else FINDER)).read_bytes(),
                "text": b"no model\n" * 100,
            }[damage]
        )
    with error_names(WeightsError, str(tmp_path)):
        HandDetector.load(tmp_path)


def test_a_square_holds_what_is_in_the_picture_at_its_place():
    picture = np.zeros((300, 400, 3), np.uint8)
    cv2.circle(picture, (250, 120), 9, (255, 255, 255), -1)
    points = np.array([[200.0, 60.0], [320.0, 200.0]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    for size in (32, 128):
        matrix = square_around(points, 1.5, size, turn)
        square = cut(picture, matrix, (size, size))[..., 0].astype(float)
        rows, columns = np.indices(square.shape) + 0.5
        middle = [(square * at).sum() / square.sum() for at in (columns, rows)]
        np.testing.assert_allclose(middle, matrix[:, :2] @ [250.5, 120.5] + matrix[:, 2], atol=0.3)


def test_fingers_are_turned_up():
    keypoints = np.random.default_rng(0).normal(size=(21, 2))
    x, y = (keypoints[9] - keypoints[0]) @ upright(keypoints).T
    assert y < 0.0 and abs(x) < 1e-9
    np.testing.assert_allclose(upright(np.zeros((21, 2))), np.eye(2))


def test_a_map_with_two_peaks_has_its_keypoint_at_the_higher_one():
    at = (np.arange(HEAT_SIZE) + 0.5) / HEAT_SIZE
    x, y = np.meshgrid(at, at)
    one, other = (np.exp(-((x - left) ** 2 + (y - 0.5) ** 2) / 0.0036) for left in (0.3, 0.7))
    found, scores = peaks_of(np.log(0.55 * one + 0.45 * other + 1e-9))
    np.testing.assert_allclose(found, [0.3, 0.5], atol=0.01)
    assert abs(scores - 0.55) < 0.02


@pytest.fixture(scope="module")
def lessons():
    """A few scenes that are not drawn, but cheap: a hand is a fan of lines."""
    rng, scenes = np.random.default_rng(0), []
    for _ in range(8):
        picture = np.full((240, 320, 3), rng.integers(0, 120, 3), np.uint8)
        wrist, points = rng.uniform(90.0, 150.0, 2), np.empty((21, 2))
        points[0] = wrist
        for finger in range(5):
            along = np.array([np.sin(0.4 * finger - 0.8), -np.cos(0.4 * finger - 0.8)])
            points[1 + 4 * finger : 5 + 4 * finger] = (
                wrist + np.array([[30.0], [42.0], [54.0], [66.0]]) * along
            )
            cv2.line(picture, wrist.astype(int), points[4 + 4 * finger].astype(int), (230, 200, 180), 7)
        scenes.append(Scene(picture, points[None], np.array([1], np.int8)))
    return scenes


@pytest.mark.parametrize("kind", ["finder", "keypoints"])
def test_training_lowers_its_loss(lessons, kind):
    torch.manual_seed(0)
    learned = lessons_of(lessons, rng=np.random.default_rng(0))
    network, make, loss, given = {
        "finder": (FinderNetwork(), training.finder_batch, training.finder_loss, learned[0]),
        "keypoints": (KeypointNetwork(), training.keypoint_batch, training.keypoint_loss, learned[1]),
    }[kind]
    losses = training.fit(network, functools.partial(make, given, []), loss, 24, 0)
    assert np.mean(losses[-6:]) < 0.8 * np.mean(losses[:3])


def test_lessons_keep_labels_in_their_pictures(lessons):
    views, squares = lessons_of(lessons, rng=np.random.default_rng(0))
    assert len(views) == len(lessons) <= len(squares)
    for square in squares:
        for x, y in square.keypoints[:, 0]:
            assert square.picture()[int(y), int(x)].min() > 130  # the wrist is on the hand


def test_drawn_hands_are_laid_over_photographs(lessons):
    """Half of the pictures have the photograph's green behind the hand, and some a glove of another color."""
    rng, scene = np.random.default_rng(0), lessons[0]
    mask = np.where(scene.picture.min(axis=2) > 130, 255, 0).astype(np.uint8)
    green = Scene(np.full((240, 320, 3), (20, 200, 30), np.uint8), np.empty((0, 21, 2)), np.empty(0, np.int8))
    (drawn,), _ = lessons_of([scene._replace(mask=mask)], rng=rng)
    backgrounds, squares = lessons_of(
        [green], lambda _: [Candidate(np.array([[9.0, 9.0], [99.0, 99.0]]), 0.0)], rng=rng
    )
    assert len(squares) == 3 and not any(len(square.sides) for square in squares)
    seen = [drawn.staged(backgrounds, rng).astype(int) for _ in range(60)]
    staged = [one for one in seen if abs(one[2, 2] - [20, 200, 30]).max() < 9]
    assert 15 < len(staged) < 45 and len({tuple(one[-3, -3]) for one in seen}) > 1
    x, y = drawn.keypoints[0, 0].astype(int)
    kept = [abs(one[y, x] - [230, 200, 180]).max() < 40 for one in staged]
    assert 0 < sum(kept) < len(kept)
    unmasked = lessons_of([scene], rng=rng)[0][0]
    np.testing.assert_array_equal(unmasked.staged(backgrounds, rng), unmasked.picture())


def test_pictures_without_hands_are_learned_from(few, tmp_path):
    cv2.imwrite(str(tmp_path / "room.png"), np.full((90, 120, 3), 90, np.uint8))
    file = tmp_path / "photographs.json"
    file.write_text(json.dumps({"images": [{"id": 1, "file_name": "room.png"}], "annotations": []}))
    HandDetector.load(train_detector(tmp_path / "out", start="shipped", photographs=file, samples=64))


@pytest.fixture
def few(monkeypatch, lessons):
    """Training on these lessons instead of drawn ones."""
    monkeypatch.setattr(training, "draw_scenes", lambda number, *, seed: lessons)
    return lessons


def contents(folder):
    return {name: (folder / name).read_bytes() for name in (FINDER, KEYPOINTS)}


def test_training_is_deterministic(few, tmp_path):
    one, other, third = (
        contents(train_detector(tmp_path / name, samples=64, seed=seed))
        for name, seed in (("one", 3), ("other", 3), ("third", 4))
    )
    HandDetector.load(tmp_path / "one")
    assert one == other != third


def test_training_starts_from_given_weights(tmp_path):
    """The shipped networks, read back, find what the shipped detector finds."""
    networks = {FINDER: FinderNetwork(), KEYPOINTS: KeypointNetwork()}
    shipped = HandDetector.load()
    for name, network in networks.items():
        training._load_folded(network, WEIGHTS / name)
        training.export(network, tmp_path / name)
    again = HandDetector.load(tmp_path)
    picture = next(draw_scenes(GLOVED, seed=77)).picture
    one, other = (one.refine(picture, [[100, 100, 200, 200]], ["left"])[0] for one in (shipped, again))
    np.testing.assert_allclose(one.keypoints, other.keypoints, atol=1.0)
    with pytest.raises(WeightsError):
        train_detector(tmp_path / "out", start=tmp_path / "nowhere", samples=64)


@pytest.fixture
def photographs(few, tmp_path):
    """A file of these lessons as photographs, some keypoints of which have no label."""
    images, annotations = [], []
    for number, scene in enumerate(few):
        cv2.imwrite(str(tmp_path / f"{number}.png"), scene.picture[..., ::-1])
        images.append({"id": number, "file_name": f"{number}.png"})
        rows = np.column_stack([scene.keypoints[0] - 0.5, np.full(21, 2)])
        rows[5:9] = 0.0  # without a label
        annotations.append({"image_id": number, "keypoints": rows.ravel().tolist(), "side": "right"})
    file = tmp_path / "photographs.json"
    file.write_text(json.dumps({"images": images, "annotations": annotations}))
    return file


def test_photographs_are_learned_from(photographs, tmp_path, monkeypatch):
    seen = []
    loss = training.keypoint_loss
    monkeypatch.setattr(
        training, "keypoint_loss",
        lambda found, targets: (torch.is_grad_enabled() and seen.append(targets), loss(found, targets))[1],
    )  # fmt: skip
    folder = train_detector(tmp_path / "out", start="shipped", photographs=photographs, samples=64)
    labeled = torch.cat([~targets[0].isnan().any(dim=2) for targets in seen])
    lacking = labeled[:, 0] & ~labeled[:, 6]
    assert 0.2 < lacking.float().mean() < 0.8
    HandDetector.load(folder)


def test_training_that_does_harm_leaves_the_detector_as_it_was(photographs, few, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "_ADAPTING_RATE", 1.0)
    folder = train_detector(tmp_path / "out", start="shipped", photographs=photographs, samples=64)
    detectors, picture = (HandDetector.load(), HandDetector.load(folder)), few[0].picture
    one, other = (each.refine(picture, [[100, 80, 90, 90]], ["right"])[0] for each in detectors)
    np.testing.assert_allclose(one.keypoints, other.keypoints, atol=0.1)


def test_a_shard_has_its_scenes():
    scenes = list(itertools.islice(draw_scenes(2, seed=5), 8))
    assert SCENES % len(scenes) == 0
    assert {len(scene.sides) for scene in scenes} <= {1, 2}
    again = list(itertools.islice(draw_scenes(2, seed=5), 2))
    np.testing.assert_array_equal(scenes[1].picture, again[1].picture)
