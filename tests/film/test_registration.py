from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from film.annotation import filmed_take
from film.registration import Registration, register
from gloves.fit import settle_glove
from gloves.layout import load_layout
from gloves.takes.take import Take
from gloves.takes.worn import FormerHands
from handsim import Camera, HandModel, HandSimError, Lens, write_page
from tests.film.filmed import SIZE, Filming, moving_take

CASES = {
    "plain": (Filming(seed=1), ("right",)),
    "two hands": (Filming(seed=2, swapped=0.15), ("left", "right")),
    "sides are always wrong": (Filming(seed=3, swapped=1.0), ("right",)),
    "a phone that is held upright": (Filming(seed=1, readout=(0.02, 0.0)), ("right",)),
    "many misses": (Filming(seed=4, missing=0.5, outliers=0.2), ("left",)),
    "a stranger's hand": (Filming(seed=5, stranger=True), ("right",)),
}


def errors(found: Camera, true: Camera) -> tuple[float, float, float]:
    """Degrees, millimeters and percent of the focal length."""
    turn = Rotation.from_matrix(found.T_world_camera[:3, :3].T @ true.T_world_camera[:3, :3])
    away = np.linalg.norm(found.T_world_camera[:3, 3] - true.T_world_camera[:3, 3])
    return np.rad2deg(turn.magnitude()), 1e3 * away, 100.0 * abs(found.focal_length / true.focal_length - 1.0)


def clock_error(found: Registration, filming: Filming) -> float:
    """[ms] in the middle of the video."""
    return 1e3 * abs(found.offset + found.drift * filming.seconds / 2.0 - filming.offset)


@pytest.mark.parametrize("case", CASES)
def test_a_hidden_camera_is_found(case):
    filming, sides = CASES[case]
    take = moving_take(sides=sides)
    found = register(take, filming.found(take), SIZE)
    turn, away, focal = errors(found.cameras[0], filming.cameras()[0])
    assert turn < 0.6 and away < 8.0 and focal < 1.5
    assert clock_error(found, filming) < 3.0
    assert len(found.cameras) == 1
    assert found.deviations["focal"] < 0.02 and found.deviations["offset"] < 0.005
    assert found.reasons.count("") > 0.25 * len(found.reasons)


@pytest.mark.parametrize("dress", ["glove", "skin"])
def test_outlines_tell_the_camera_within_its_bounds(dress):
    """Keypoints are 10 px off, later 30 px to one side; the take has a finger bent wrongly for a second."""
    filming = Filming(seed=31, seconds=9.0, rate=8.0, noise=10.0, readout=(0.0, 0.0))
    take = moving_take()
    frames, pictures = filming.found(take), filming.pictures(take, dress)
    for frame in frames[45:]:
        for hand in frame.hands:
            hand.keypoints[:] += [30.0, 0.0]
    qpos = take.qpos.copy()
    qpos[(take.times > 6.0) & (take.times < 7.0), 0, 12:16] += 0.9
    wrong = Take.of_poses(take.hands, qpos, rate=take.rate)
    steps: list[tuple[int, int]] = []
    found = register(wrong, frames, SIZE, None, lambda: pictures, lambda *step: steps.append(step))
    assert len(steps) > 72 and steps == sorted(steps) and steps[-1] == (144, 144)
    turn, away, focal = errors(found.cameras[0], filming.cameras()[0])
    assert len(found.cameras) == 1 and turn < 0.25 and away < 3.0 and focal < 0.6
    assert clock_error(found, filming) < 1.5 and found.residual() < 1.0
    bent = [6.1 < filming.offset + frame.time < 6.9 for frame in frames]
    assert all(reason for reason, is_bent in zip(found.reasons, bent, strict=True) if is_bent)
    assert (
        np.mean([not reason for reason, is_bent in zip(found.reasons, bent, strict=True) if not is_bent])
        > 0.7
    )


def test_a_stabilized_video_is_refused():
    """Its pictures are shifted by up to 9 px, as much as keypoints are off."""
    filming, take = Filming(seed=31, seconds=9.0, rate=8.0, noise=8.0, readout=(0.0, 0.0)), moving_take()
    shifts = np.rint(9.0 * np.sin(np.arange(72)[:, None] * [0.9, 1.3])).astype(int)
    shown = [np.roll(*both, axis=(0, 1)) for both in zip(filming.pictures(take), shifts, strict=True)]
    with pytest.raises(HandSimError, match="do not move as those of the take at any shift"):
        register(take, filming.found(take), SIZE, pictures=lambda: shown)


def test_motion_that_repeats_itself_tells_no_clock():
    take, filming = moving_take(8.0), Filming(seed=1, seconds=5.0)
    twice = Take.of_poses(take.hands, np.concatenate([take.qpos, take.qpos]), rate=take.rate)
    with pytest.raises(HandSimError, match=r"clock at \d.*\.3\d and at \d.*\.3\d s explain \d+ and \d+ %"):
        register(twice, filming.found(take), SIZE)


def test_a_video_shows_the_hands_of_its_frames():
    """The take has two users, and the video ends with the first, or after both."""
    filming, last = Filming(seed=1, seconds=9.0), moving_take()
    small = settle_glove(load_layout("dense19"), HandModel.named("S"))
    frames = np.arange(270)
    found = Registration(
        filming.cameras()[:1], (0,), 2.3, 0.0, (0.0, 0.0), {}, frames / 30.0, 0.0 * frames, ("",) * 270
    )
    for change in (6.0, 14.0):
        stop = int(np.searchsorted(last.times, change))
        take = dataclasses.replace(last, former=[FormerHands(stop, (small,), "S")])
        filmed = filmed_take(take, found, every=True)
        for frame in (0, filmed.num_frames - 1):
            worn = small if filmed.times[frame] < change else last.hands[0]
            assert filmed.hands_at(frame)[0].model.shape == worn.model.shape
        assert len(filmed.former) == (change == 6.0)


@pytest.mark.slow
def test_outlines_are_those_of_the_hands_of_the_frame():
    """A small hand is found where it is, though a large one comes after the video."""
    filming, take = Filming(seed=31, seconds=9.0, rate=8.0, readout=(0.0, 0.0)), moving_take()
    large = settle_glove(load_layout("dense19"), HandModel.named("XL"))
    frames, pictures = filming.found(take), filming.pictures(take)
    worn = dataclasses.replace(
        take, hands=(large,), former=[FormerHands(take.num_frames - 1, take.hands, "M")]
    )
    one, other = (register(each, frames, SIZE, pictures=lambda: pictures) for each in (take, worn))
    np.testing.assert_allclose(one.distances, other.distances)
    np.testing.assert_allclose(one.cameras[0].T_world_camera, other.cameras[0].T_world_camera)


def test_a_push_makes_two_spans():
    take, filming = moving_take(), Filming(seed=6, bump=6.0)
    found = register(take, filming.found(take), SIZE)
    assert len(found.cameras) == 2 and abs(found.starts[1] - 180) <= 3
    for one, true in zip(found.cameras, filming.cameras(), strict=True):
        turn, away, _ = errors(one, true)
        assert turn < 0.8 and away < 12.0
    assert any("moved at 6.0 s" in told for told in found.doubts())


def test_what_is_not_moved_tells_no_clock():
    take, filming = moving_take(still=True), Filming(seed=7)
    try:
        told = " ".join(register(take, filming.found(take), SIZE).doubts())
    except HandSimError as error:
        assert "expected hands that move in all directions" in str(error)
    else:
        assert "clock is known to" in told and "focal length is known to" in told


def test_a_given_lens_is_kept():
    take, filming = moving_take(), Filming(seed=8)
    given = filming.cameras()[0]
    found = register(take, filming.found(take), SIZE, given.at(np.eye(4)))
    assert found.cameras[0].lens == given.lens and np.array_equal(found.cameras[0].K, given.K)
    assert errors(found.cameras[0], given)[1] < 4.0


def test_a_given_fisheye_sees_the_same():
    take, filming = moving_take(), Filming(seed=9, readout=(0.0, 0.0))
    true = filming.cameras()[0]
    fisheye = Camera("f", SIZE, true.K, true.T_world_camera, Lens("fisheye", (0.02, -0.01, 0.0, 0.0)))

    class Fisheye(Filming):
        def cameras(self):
            return fisheye, fisheye

    found = register(take, Fisheye(seed=9, readout=(0.0, 0.0)).found(take), SIZE, fisheye)
    assert errors(found.cameras[0], fisheye)[1] < 4.0


def test_frames_that_do_not_fit_are_left_out():
    take, filming = moving_take(), Filming(seed=10, outliers=0.0, missing=0.0, swapped=0.0)
    frames = filming.found(take)
    for n in range(100, 120):  # the tracker took another finger there
        frames[n].hands[0].keypoints[:] += [40.0, 0.0]
    frames[150] = frames[150]._replace(hands=[])
    found = register(take, frames, SIZE)
    assert len(found.cameras) == 1 and all(found.reasons[n] for n in range(100, 120))
    away = "no hand of the take is in the picture"
    left = {n for n, reason in enumerate(found.reasons) if reason not in ("", away)}
    assert left <= set(range(100, 120)) | {150} and len(left) > 12
    assert "off" in found.reasons[105] and found.reasons[150] == "the detector found no hand there"


def test_dropped_poses_do_not_count():
    take, filming = moving_take(), Filming(seed=11)
    frames, qpos = filming.found(take), take.qpos.copy()
    qpos[300:420] = np.nan
    found = register(Take.of_poses(take.hands, qpos, rate=take.rate), frames, SIZE)
    lost = [found.reasons[n] for n in range(len(frames)) if 5.1 < filming.offset + n / 30.0 < 6.9]
    assert set(lost) == {"the take has no hand then"}
    assert errors(found.cameras[0], filming.cameras()[0])[1] < 8.0


def test_another_take_is_refused():
    frames = Filming(seed=12).found(moving_take())
    with pytest.raises(HandSimError, match=r"do not move as those of the take|hands were found in"):
        register(moving_take(seed=5, sides=("left",)), frames, SIZE)
    with pytest.raises(HandSimError, match="hands were found in 0 of the 10 frames"):
        register(moving_take(), [frame._replace(hands=[]) for frame in frames[:10]], SIZE)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "seconds", "rate"), [(8, 12.0, 10.0), (4, 12.0, 12.0), (8, 4.0, 20.0)])
def test_slow_motion_is_told_with_its_ratio(ratio, seconds, rate):
    take = moving_take()
    found = Filming(seed=ratio, seconds=seconds, rate=rate).found(take)
    slow = [frame._replace(time=ratio * frame.time) for frame in found]
    with pytest.raises(HandSimError, match=rf"move {ratio} times as slowly .* -itsscale {1 / ratio:g} -i"):
        register(take, slow, SIZE)


def test_the_page_tells_the_camera(tmp_path):
    take = moving_take()
    found = register(take, Filming(seed=13).found(take), SIZE)
    write_page(tmp_path / "film.html", found)
    page = (tmp_path / "film.html").read_text("utf-8")
    assert f"{found.cameras[0].focal_length:.1f} px" in page and "Residuals over time" in page
    assert found.record()["offset"] == found.offset
