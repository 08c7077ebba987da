"""`handsim track` and `handsim calibrate` through the command line, on captures and on a live stream."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.paper.hand_errors import hand_errors
from gloves import Capture, GloveFit, load_layout, load_take, read_capture, write_capture
from gloves.fit import nominal_fit, wear
from gloves.takes.archives import CutOffWarning, GrownArchive
from gloves.takes.corrections import NO_MARKER
from gloves.takes.take import LOST
from handsim import HandModel, sample_shape
from handsim.app import messages
from handsim.cli.main import main
from handsim.space.objects import named_object
from tests.limits import file_size_limit
from tests.waiting import LONG, signal_once, wait_for
from track import Recorder, ReplayServer, User, captures, load_user, open_source, track_capture
from track.bodies.rigid_body import load_body
from track.streams import natnet
from track.streams.live_stream import LiveStream
from track.viewer.editors import Corrector
from train.simulation.scenes import CalibrationTakeConfig
from train.simulation.takes import simulate_calibration

FRAMES = 60
SIZED = """
import time
from gloves import load_take
from track import frames

class Sized:
    def __init__(self, file):
        self.frames, self.closed = list(frames.capture_frames(load_take(file).capture())), False

    def __iter__(self):
        number = 0
        while not self.closed:
            frame = self.frames[number % len(self.frames)]
            yield frames.StreamedFrame(number, number / 120.0, frame.points, frame.ids)
            number += 1
            time.sleep(0.01)

    def close(self):
        self.closed = True
"""
LATE = """
import time
import numpy as np
from track import StreamedFrame

class Late:
    def __iter__(self):
        time.sleep(1.0)
        for number in range(30):
            yield StreamedFrame(number, number / 100, np.full((6, 3), 0.1 * number), np.arange(6))

    def close(self):
        pass
"""
EMPTY = LATE.replace("time.sleep(1.0)", "").replace("np.full((6, 3), 0.1 * number), np.arange(6)", "*NOTHING")
EMPTY = EMPTY.replace(
    "class Late:",
    """NOTHING = np.empty((0, 3)), np.empty(0, dtype=int)

class Late:
    without_points = "is the cover off?"
""",
)
REFUSED = LATE.replace(
    "class Late:",
    """class Late:
    tries = []

    def __init__(self):
        self.tries.append(0)
        if len(self.tries) < 3:
            raise ConnectionRefusedError("not yet")
""",
)
PLAYED = """
import numpy as np
from gloves import read_capture
from track import StreamedFrame

class Played:
    def __init__(self, file):
        self.capture = read_capture(file)

    def __iter__(self):
        for number, points in enumerate(self.capture.positions):
            seen = np.isfinite(points[:, 0])
            yield StreamedFrame(number, number / self.capture.rate, points[seen], np.flatnonzero(seen))

    def close(self):
        pass
"""


@pytest.fixture(scope="module")
def right_user(tmp_path_factory):
    """The file of a user with a right hand."""
    path = tmp_path_factory.mktemp("right_user") / "user.json"
    User((nominal_fit(load_layout("dense19"), "L", "right"),)).save(path)
    return path


@pytest.fixture(scope="module")
def user(tmp_path_factory):
    """A user's capture for calibration, their hand and what the command made of it."""
    folder, rng = tmp_path_factory.mktemp("user"), np.random.default_rng(5)
    shape = sample_shape(side="right", rng=rng)
    model = HandModel(shape)
    worn = wear(load_layout("dense19"), model, along=0.05, around=0.2, rng=rng)
    config = CalibrationTakeConfig(free=2.0, rounds=0)
    take = simulate_calibration((GloveFit(model, worn),), config, rng=rng)
    write_capture(folder / "user.c3d", take.capture())
    arguments = [str(folder / "user.c3d"), "--size", "L", "--out", str(folder / "user.json")]
    assert main(["calibrate", *arguments]) == 0
    return folder, GloveFit(model, worn)


@pytest.mark.slow
def test_a_user_is_calibrated_from_unlabeled_points(user, capsys):
    folder, true = user
    (found,) = load_user(folder / "user.json")
    assert found.side == "right", "the left hand is not in the capture"
    errors = hand_errors(found, true)
    start = hand_errors(nominal_fit(load_layout("dense19"), "L", "right"), true)
    assert np.median(errors.positions) < 0.5 * np.median(start.positions)
    assert main(["track", str(folder / "user.c3d"), "--shape", str(folder / "user.json"), "--out",
                 str(folder / "take.npz")]) == 0  # fmt: skip
    take = load_take(folder / "take.npz")
    assert take.sides == ("right",) and take.settings["user"] == "user.json"
    assert np.nanmedian(take.rms) < 0.0005
    np.testing.assert_array_equal(take.hands[0].attachment.points, found.attachment.points)
    said = capsys.readouterr().out
    assert said.startswith(f"{folder / 'user.json'}: hands in the glove 'dense19'\n")
    assert "right hand: tracked" in said


@pytest.mark.slow
def test_a_user_who_is_calibrated_in_a_wrong_glove_is_told(user, tmp_path, capsys):
    folder, _ = user
    asked = [str(folder / "user.c3d"), "--glove", "sparse13", "--out", str(tmp_path / "user.json")]
    assert main(["calibrate", *asked, "--hands", "right", "--size", "L"]) == 0
    said = capsys.readouterr().err
    assert " of the points at the hands are not markers of what was tracked; name the glove worn" in said


def test_users_that_do_not_fit_are_told(right_user, capture, tmp_path, capsys):
    shape, out = str(right_user), str(tmp_path / "out.npz")
    for arguments, words in (
        (["--size", "M"], "expected one of them"),
        (["--hands", "left"], "unknown hand 'left'; valid names: right"),
        (["--glove", "sparse13"], "but glove 'sparse13' has"),
    ):
        assert main(["track", str(capture), "--shape", shape, "--out", out, *arguments]) == 1
        assert words in capsys.readouterr().err
    assert main(["calibrate", str(capture), "--hands", "left", "--out", str(tmp_path / "user.json")]) == 1
    said = capsys.readouterr().err.splitlines()  # a busy machine tells of progress before
    assert sum(line.startswith("handsim calibrate: ") for line in said) == 1 and said[-1].startswith(
        "handsim"
    )
    assert not list(tmp_path.iterdir())


def test_a_capture_becomes_a_take_and_is_told_of(capture, tmp_path, capsys):
    out, labeled = tmp_path / "new" / "tracked.npz", tmp_path / "labeled.trc"
    assert main(["track", str(capture), "--out", str(out), "--labeled", str(labeled), "--size", "L"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{out}: {FRAMES} frames, 0.5 s at 120 Hz"
    assert lines[1].startswith("right hand: tracked 98.3 %, found 1.7 %, coasting 0.0 %, lost 0.0 %; median")
    assert lines[2].startswith("left hand: ") and " mm, " in lines[2]
    assert any("points are not markers" in line for line in lines) and lines[-1].endswith(" ms per frame")
    take, truth = load_take(out), load_take(capture.with_suffix(".truth.npz"))
    assert take.sides == ("right", "left")
    assert take.settings["capture"] == "take.c3d" and take.settings["user"] == "L"
    json.dumps(take.settings)
    true = np.where(truth.labels < 38, truth.labels, -1)
    assert np.mean(take.labels == true) > 0.95
    columns = read_capture(labeled)
    assert columns.names[:38] == take.label_names
    seen = columns.positions[:, :19]
    np.testing.assert_allclose(seen, take.observed("right"), atol=1e-6)
    unlabeled = np.isfinite(columns.positions[:, 38:, 0]).sum()
    assert any(f"{unlabeled} of " in line for line in lines)


def test_corrections_come_back_with_a_new_tracking(capture, tmp_path, capsys):
    out, labeled = tmp_path / "tracked.npz", tmp_path / "labeled.trc"
    arguments = ["track", str(capture), "--out", str(out), "--size", "L", "--no-smooth"]
    assert main(arguments) == 0
    first = load_take(out)
    corrector = Corrector(out, first)
    (column,) = np.flatnonzero(first.labels[30] == 5)
    number = first.ids[30, column]
    corrector.add(30, column, (20, 40), NO_MARKER)
    corrector.save()
    saved = load_take(out)
    about = (first.ids == number) & np.isin(np.arange(FRAMES), np.arange(20, 41))[:, None]
    assert (saved.labels[about] == -1).all() and (first.labels[about] == 5).all()
    capsys.readouterr()
    assert main([*arguments, "--labeled", str(labeled)]) == 0
    beside = tmp_path / "tracked.corrections.toml"
    assert f"{beside}: 1 correction applied" in capsys.readouterr().out
    again = load_take(out)
    np.testing.assert_array_equal(again.labels, saved.labels)
    np.testing.assert_allclose(again.qpos, saved.qpos, atol=1e-9)
    assert again.settings["corrections"] == saved.settings["corrections"] != []
    rows = about.any(axis=1)
    assert np.isnan(read_capture(labeled).positions[rows, 5]).all()

    beside.write_text(re.sub("place_mm = .*", "place_mm = [5000, 0, 0]", beside.read_text()))
    assert main(arguments) == 0
    assert "the correction to none in frames 20 to 40 no longer fits" in capsys.readouterr().err
    np.testing.assert_array_equal(load_take(out).labels, first.labels)


def test_corrections_that_cannot_be_meant_are_told_before_the_work(capture, tmp_path, capsys):
    out, beside = tmp_path / "tracked.npz", tmp_path / "tracked.corrections.toml"
    beside.write_text('[[correction]]\nframes = [0, 60]\nplace_mm = [0, 0, 0]\nlabel = "none"\n')
    assert main(["track", str(capture), "--out", str(out), "--size", "L"]) == 1
    assert (
        f"{beside}: correction 1 is for frames 0 to 60, expected frames from 0 to 59"
        in capsys.readouterr().err
    )
    assert main(["track", "--live", "natnet://127.0.0.1", "--out", str(out), "--size", "L"]) == 1
    assert "corrects the take that --live would replace" in capsys.readouterr().err
    assert not out.exists()


def test_the_size_of_the_hands_is_measured(capture, tmp_path, capsys):
    out = tmp_path / "tracked.npz"
    assert main(["track", str(capture), "--out", str(out)]) == 0
    said = capsys.readouterr().out.splitlines()[0]
    size = said.removeprefix("size of the hands: ")
    length, _, breadth, unit, *doubt = size.split()
    assert unit == "mm," and doubt[:2] == ["unsure", "by"]
    truth, take = load_take(capture.with_suffix(".truth.npz")), load_take(out)
    assert int(length) == pytest.approx(1e3 * truth.hands[0].shape.length, abs=int(doubt[2]))
    assert 0.4 < int(breadth) / int(length) < 0.5
    assert take.settings["user"] == f"auto, {size}"
    assert np.nanmedian(take.rms) < 0.005


def test_hands_that_are_not_there_get_the_usual_size(tmp_path, capsys):
    rng = np.random.default_rng(0)
    path, out = tmp_path / "clutter.trc", tmp_path / "out.npz"
    write_capture(path, Capture(tuple(f"U{n}" for n in range(30)), rng.uniform(-1, 1, (5, 30, 3)), 120.0))
    main(["track", str(path), "--out", str(out)])
    err = capsys.readouterr().err
    assert "no hand was found to measure its size, in 3 frames with most of its markers; size M is" in err


@pytest.mark.slow
def test_bodies_are_followed_beside_the_hands(capture, tmp_path, capsys):
    truth = load_take(capture.with_suffix(".truth.npz"))
    wand, out, labeled = tmp_path / "wand.toml", tmp_path / "take.npz", tmp_path / "labeled.c3d"
    assert main(["body", str(capture.with_suffix(".truth.npz")), "--out", str(wand)]) == 0
    assert capsys.readouterr().out == f"{wand}: controller, 6 markers, at most 99.9 mm apart\n"
    asked = [
        *"--size L --hands right --body".split(),
        str(wand),
        *"--body mug --labelled".split(),
        str(labeled),
    ]  # the earlier spelling holds
    assert main(["track", str(capture), "--out", str(out), *asked]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith(
        "controller: tracked 98.3 %, found 1.7 %, coasting 0.0 %, lost 0.0 %; median RMS"
    )
    assert lines[3] == (
        "mug: tracked 0.0 %, found 0.0 %, coasting 0.0 %, lost 100.0 %; it was never found: are these its "
        "markers?"
    )
    take, first = load_take(out), truth.hand_labels[-1].stop
    assert [body.name for body in take.bodies] == ["controller", "mug"]
    np.testing.assert_allclose(take.bodies[0].positions, named_object("controller").markers, atol=1e-12)
    mine = truth.labels >= first
    assert np.mean(take.labels[mine] - 19 == truth.labels[mine] - first) > 0.99
    columns = read_capture(labeled)
    assert columns.names[: len(take.label_names)] == take.label_names
    assert take.label_names[19] == "controller:ring_front"
    seen = columns.positions[:, 19:25]
    true = truth.observed(range(first, first + 6))
    there = np.isfinite(true[..., 0])
    np.testing.assert_array_equal(np.isfinite(seen[..., 0]), there)
    np.testing.assert_allclose(seen[there], true[there], atol=1e-6)


def test_a_body_is_learned_from_a_capture_of_it(capture, tmp_path, capsys):
    truth = load_take(capture.with_suffix(".truth.npz"))
    alone = np.where((truth.labels >= truth.hand_labels[-1].stop)[..., None], truth.points, np.nan)
    alone = alone[:, np.isfinite(alone[..., 0]).any(axis=0)]
    file, wand = tmp_path / "alone.trc", tmp_path / "wand.toml"
    write_capture(file, Capture(tuple(f"*{n}" for n in range(alone.shape[1])), alone, truth.rate))
    assert main(["body", str(file), "--out", str(wand)]) == 0
    assert capsys.readouterr().out.startswith(f"{wand}: wand, 6 markers, at most 99.9 mm apart")
    body, true = load_body(wand), load_body("controller")
    np.testing.assert_allclose(np.sort(body.distances.ravel()), np.sort(true.distances.ravel()), atol=0.0002)


def test_a_body_is_followed_through_a_stream(capture, tmp_path, capsys):
    out = tmp_path / "live.npz"
    with ReplayServer(capture.with_suffix(".truth.npz")) as server:
        asked = ["--live", server.url, "--seconds", "0.5", "--body", "controller", "--out", str(out)]
        assert main(["track", *asked]) == 0
    assert (load_take(out).body_status != LOST).all()
    assert "controller: tracked" in capsys.readouterr().out


def test_the_same_command_writes_the_same_bytes(capture, tmp_path):
    for name in ("one.npz", "two.npz"):
        assert main(["track", str(capture), "--out", str(tmp_path / name), "--hands", "right"]) == 0
    take = load_take(tmp_path / "one.npz")
    assert take.sides == ("right",) and (take.status != LOST).all()
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


@pytest.mark.slow
def test_the_command_and_python_track_alike(capture, tmp_path):
    """The size is measured, a body is tracked, and a label is corrected."""
    command, python = tmp_path / "command.npz", tmp_path / "python.npz"
    place = 1e3 * load_take(capture.with_suffix(".truth.npz")).points[0, 0]
    where = f"place_mm = [{', '.join(map(str, place))}]"
    beside = tmp_path / "command.corrections.toml"
    beside.write_text(f'[[correction]]\nframes = [0, 5]\n{where}\nlabel = "none"\n')
    assert main(["track", str(capture), "--out", str(command), "--body", "controller", "--no-smooth"]) == 0
    track_capture(capture, bodies=["controller"], corrections=beside, smooth=False).save(python)
    assert command.read_bytes() == python.read_bytes()
    in_memory = track_capture(
        read_capture(capture), glove=load_layout("dense19"), bodies=["controller"], smooth=False
    )
    again = load_take(python)
    np.testing.assert_array_equal(in_memory.qpos[10:], again.qpos[10:])
    assert in_memory.settings["user"] == again.settings["user"]


def test_a_stream_is_tracked_for_some_seconds(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("track.live.live_tracking.open_source", functools.partial(open_source, silence=20.0))
    # However busy the machine is, no frame is dropped.
    monkeypatch.setattr(LiveStream, "forgive", lambda stream: setattr(stream, "forgiven_until", np.inf))
    out = tmp_path / "live.npz"
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server:
        assert main(["track", "--live", server.url, "--seconds", "0.3", "--out", str(out)]) == 0
    take = load_take(out)
    assert 2 <= take.num_frames <= FRAMES and take.rate == pytest.approx(120.0, rel=1e-3)
    assert take.settings["capture"] == server.url
    stream = take.settings["stream"]
    assert stream["received_frames"] >= take.num_frames
    assert (stream["missing_frames"], stream["doubled_frames"], stream["restarts"]) == (0, 0, 0)
    np.testing.assert_array_equal(take.numbers, np.arange(take.num_frames))
    assert (take.status[-1] != LOST).all()
    told = capsys.readouterr()
    assert "right hand: tracked" in told.out and "; 0 missing" in told.out
    assert "frames received: " in told.out and take.settings["user"] == "M", "they were seen too briefly"
    ready, *lines = told.err.splitlines()
    assert ready == "getting ready"
    assert lines[0] == f"recording to {out}.part, which becomes {out} at the end; Ctrl-C ends it"


def test_hands_of_a_stream_are_measured_beside_the_tracker(capture, tmp_path, capsys, monkeypatch):
    """The first frame is recorded at once; the recording knows both sizes, also while it grows."""
    (tmp_path / "sized_source.py").write_text(SIZED)
    monkeypatch.syspath_prepend(tmp_path)
    out, part, source = tmp_path / "live.npz", tmp_path / "live.npz.part", capture.with_suffix(".truth.npz")
    add, grown, users = Recorder.add, [], [None]

    def check(recorder: Recorder, *frame: object) -> None:
        add(recorder, *frame)
        users.append(recorder._tracker.user)
        if users[-1].notes.startswith("auto") and users[-1] is users[-2] and not grown:  # the last step
            recorder._archive.flush()
            recorded = GrownArchive(part)
            grown.append((recorded.header["settings"], recorded.read()["hands"]["length"]))
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Recorder, "add", check)
    address = f"sized_source:Sized?file={source}"
    assert main(["track", "--live", address, "--out", str(out)]) == 0
    take, said = load_take(out), capsys.readouterr()
    first, measured = take.former[0], take.settings["user"]
    assert first.notes == "M" and 0 < first.stop < take.num_frames
    assert measured.startswith("auto, ")
    assert f"size of the hands: {measured.split(', unsure')[0].removeprefix('auto, ')}\n" in said.err
    assert said.out.startswith(f"size of the hands: {measured.removeprefix('auto, ')}\n")
    assert take.hands[0].shape.length != pytest.approx(0.187, abs=1e-4)
    ((settings, length),) = grown
    assert settings["user"] == take.settings["user"]
    assert length == pytest.approx(take.hands[0].shape.length)
    with np.load(out) as stored:  # as they were sent
        np.testing.assert_allclose(stored["keypoints"], take.keypoints(), atol=1e-9)


def test_a_server_may_start_after_the_tracker(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(natnet, "_PATIENCE", 0.5)
    started, took = [], messages.LiveStatus.show

    def show(status: messages.LiveStatus, line: str, *, now: bool = False) -> None:
        took(status, line, now=now)
        if "no NatNet server answers" in line and not started:
            started.append(ReplayServer(capture.with_suffix(".truth.npz"), loop=True, port=port))

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    monkeypatch.setattr(messages.LiveStatus, "show", show)
    out, address = tmp_path / "live.npz", f"natnet://127.0.0.1:{port}"
    try:
        assert main(["track", "--live", address, "--size", "M", "--seconds", "0.3", "--out", str(out)]) == 0
    finally:
        for server in started:
            server.close()
    assert "it is waited for, Ctrl-C ends it" in capsys.readouterr().err
    assert load_take(out).num_frames > 1


def test_seconds_count_from_the_first_frame(tmp_path, monkeypatch):
    (tmp_path / "late_source.py").write_text(LATE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("track.live.live_tracking.open_source", functools.partial(open_source, silence=0.1))
    out = tmp_path / "live.npz"
    options = ["--size", "M", "--seconds", "0.5", "--out", str(out)]
    assert main(["track", "--live", "late_source:Late", *options]) == 0
    assert load_take(out).num_frames == 30, "not from the first silence"


def test_a_source_of_the_user_s_own_that_is_refused_is_tried_again(tmp_path, monkeypatch, capsys):
    (tmp_path / "refused.py").write_text(REFUSED)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("track.live.live_tracking._RETRY_PERIOD", 0.01)
    out = tmp_path / "live.npz"
    assert main(["track", "--live", "refused:Late", "--size", "M", "--out", str(out)]) == 0
    assert load_take(out).num_frames == 30
    assert "not yet (" in capsys.readouterr().err


@pytest.mark.parametrize("enough", [False, True])
def test_a_user_is_calibrated_from_a_stream(enough, capture, tmp_path, monkeypatch, capsys):
    (tmp_path / "played.py").write_text(PLAYED)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("track.calibration.user_calibration._EXAMINATION_PERIOD", 0.0)
    monkeypatch.setattr("track.calibration.user_calibration._REQUEST_PERIOD", 0.0)
    monkeypatch.setattr("track.calibration.user_calibration._LEAST_TRACKED_TIME", -1.0)
    monkeypatch.setattr(messages.LiveStatus, "due", True)
    if enough:
        monkeypatch.setattr("track.calibration.user_calibration.still_joints", lambda *seen: ())
    calls = []

    def calibrate(*arguments, **options):
        calls.append(arguments)
        return User((nominal_fit(load_layout("dense19"), "L", "right"),))

    monkeypatch.setattr(captures, "calibrate", calibrate)
    out = tmp_path / "user.json"
    address = f"played:Played?file={capture}"
    asked = ["--live", address, "--hands", "right", "--size", "L", "--out", str(out)]
    assert main(["calibrate", *asked]) == 0
    ((recorded, settings),) = calls
    assert recorded == tmp_path / "user.calibration.npz" and settings.size == "L"
    assert load_take(recorded).num_frames == (2 if enough else FRAMES)
    assert load_user(out).sides == ("right",)
    assert ("right hand: move the " in capsys.readouterr().err) is not enough
    assert main(["calibrate", "--seconds", "9", str(capture), "--out", str(out)]) == 1
    assert main(["calibrate", "--out", str(out)]) == 1
    assert "neither a capture nor --live" in capsys.readouterr().err


@pytest.mark.parametrize("size", ["auto", "M"])
def test_a_stream_whose_frames_have_no_points_is_told_at_once(size, tmp_path, monkeypatch, capsys):
    (tmp_path / f"empty_{size}.py").write_text(EMPTY)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("track.streams.live_stream._EMPTY_TIME", -1.0)
    main(["track", "--live", f"empty_{size}:Late", "--size", size, "--out", str(tmp_path / "live.npz")])
    said = "frames arrive, but no point was in any of them; is the cover off?"
    assert capsys.readouterr().err.splitlines().count(said) == 1


def _numbers_in(part):
    """The numbers of the frames that are in a recording; none before its first bytes are written."""
    try:
        return GrownArchive(part).read()["numbers"]
    except (OSError, ValueError):
        return np.empty(0)


@contextlib.contextmanager
def recording(capture, out):
    """The command in a process of its own, which records a stream that never ends, and what is on disk."""
    run = "import sys; from handsim.cli.main import main; sys.exit(main(sys.argv[1:]))"
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server:
        live = ["track", "--live", server.url, "--size", "M", "--out", str(out)]
        process = subprocess.Popen([sys.executable, "-c", run, *live], stderr=subprocess.PIPE, text=True)
        part = out.with_name(f"{out.name}.part")
        try:
            wait_for(lambda: len(_numbers_in(part)) > 60 or process.poll() is not None)
            yield process, _numbers_in(part)
        finally:
            process.kill()
            process.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_recording_while_frames_arrive(number, capture, tmp_path):
    with recording(capture, tmp_path / "live.npz") as (process, there):
        process.send_signal(number)
        _, said = process.communicate(timeout=LONG)
    assert process.returncode == 0, said
    assert os.listdir(tmp_path) == ["live.npz"]
    numbers = load_take(tmp_path / "live.npz").numbers
    assert len(there) > 60 and (np.diff(numbers) > 0).all()
    np.testing.assert_array_equal(numbers[: len(there)], there)


def test_a_kill_leaves_all_that_was_written(capture, tmp_path):
    with recording(capture, tmp_path / "live.npz") as (process, there):
        process.kill()
    part = tmp_path / "live.npz.part"
    assert os.listdir(tmp_path) == [part.name]
    with pytest.warns(CutOffWarning):
        numbers = load_take(part).numbers
    assert len(there) > 60 and (np.diff(numbers) > 0).all()
    np.testing.assert_array_equal(numbers[: len(there)], there)


@pytest.fixture
def interrupt():
    """Sends a signal to this process once a condition holds and the command handles signals."""
    threads = []
    yield lambda number, condition: threads.append(signal_once(condition, number))
    for thread in threads:
        thread.join()


def test_a_second_signal_keeps_the_recording(capture, tmp_path, capsys, monkeypatch, interrupt):
    out, part, writes = tmp_path / "live.npz", tmp_path / "live.npz.part", threading.Event()

    def slow(*_, **__):
        writes.set()
        time.sleep(LONG)

    monkeypatch.setattr(Recorder, "finish", slow)
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server:
        interrupt(signal.SIGINT, lambda: len(_numbers_in(part)) > 60)
        interrupt(signal.SIGTERM, writes.is_set)
        assert main(["track", "--live", server.url, "--size", "M", "--out", str(out)]) == 143
    said = capsys.readouterr().err
    assert said.endswith(f"\nhandsim track: ended by SIGTERM; the recording is kept in {part}\n")
    assert os.listdir(tmp_path) == [part.name]
    with pytest.warns(CutOffWarning):
        assert load_take(part).num_frames > 60


def test_a_signal_while_hands_are_awaited_keeps_the_points(capture, tmp_path, capsys, interrupt):
    take = load_take(capture.with_suffix(".truth.npz"))
    few = SimpleNamespace(points=take.points[:, :2], ids=take.ids[:, :2], rate=120.0)
    with ReplayServer(few, loop=True) as server:
        interrupt(signal.SIGTERM, lambda: server.sent > 10)
        assert main(["track", "--live", server.url, "--out", str(tmp_path / "live.npz")]) == 0
    assert (load_take(tmp_path / "live.npz").status == LOST).all()


def test_a_stream_without_frames_is_told(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("track.live.live_tracking.open_source", functools.partial(open_source, silence=0.2))
    take = load_take(capture.with_suffix(".truth.npz"))
    with ReplayServer(SimpleNamespace(points=take.points[:1], ids=take.ids[:1], rate=120.0)) as server:
        arguments = ["track", "--live", server.url, "--seconds", "0.5", "--out", str(tmp_path / "live.npz")]
        assert main(arguments) == 1
    said = capsys.readouterr().err
    assert "1 frames came, expected two or more" in said
    assert not list(tmp_path.iterdir())


@pytest.fixture
def listener():
    """A UDP socket that keeps all that is sent to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        one.bind(("127.0.0.1", 0))
        one.setblocking(False)
        yield one


def address_of(listener) -> str:
    return f"udp://127.0.0.1:{listener.getsockname()[1]}"


def heard(listener) -> list[dict]:
    """All messages that a listener was sent."""
    messages = []
    with contextlib.suppress(BlockingIOError):
        while True:
            messages.append(json.loads(listener.recv(1 << 16)))
    return messages


def numbers_heard(listener) -> set[int]:
    """The numbers of all frames that a listener was sent."""
    return {message["number"] for message in heard(listener) if message["type"] == "frame"}


def test_hands_are_sent_without_a_recording(capture, tmp_path, capsys, monkeypatch, listener):
    monkeypatch.chdir(tmp_path)
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server:
        sent = ["--live", server.url, "--seconds", "0.3", "--send", address_of(listener)]
        assert main(["track", *sent, "--size", "M"]) == 0
    heard, said = numbers_heard(listener), capsys.readouterr()
    assert len(heard) > 1 and not list(tmp_path.iterdir()) and "recording" not in said.err
    assert re.match(r"\d+ frames, \d\.\d s\n", said.out) and "frames sent to udp" in said.out


@pytest.mark.parametrize("seconds", [["--seconds", "0.2"], []])
@pytest.mark.parametrize("output", ["--out", "--send", "--out --send"])
def test_a_server_without_frames_ends_a_session_of_a_given_length(
    seconds, output, tmp_path, capsys, monkeypatch, interrupt
):
    monkeypatch.setattr("track.live.live_tracking._FIRST_FRAME_WAIT", 0.5)
    monkeypatch.setattr("track.live.live_tracking.open_source", functools.partial(open_source, silence=0.1))
    (tmp_path / "waits.py").write_text(LATE.replace("time.sleep(1.0)", "time.sleep(1e6)"))
    monkeypatch.syspath_prepend(tmp_path)
    out = tmp_path / "new" / "live.npz"
    given = {"--out": ["--out", str(out)], "--send": ["--send", "udp://127.0.0.1:9"]}
    outputs = [word for name in output.split() for word in given[name]]
    shown = []
    monkeypatch.setattr(messages.LiveStatus, "show", lambda status, line, now=False: shown.append(line))
    if not seconds:
        interrupt(signal.SIGINT, lambda: any("no frames arrive" in line for line in shown))
    code = main(["track", "--live", "waits:Late", "--size", "M", *outputs, *seconds])
    said = capsys.readouterr().err.splitlines()[-1]
    assert code == (0 if output == "--send" and not seconds else 1)
    if code:
        waited = " in 0.5 s" if seconds else ""
        assert said == f"handsim track: waits:Late: 0 frames came{waited}; is the server playing?"
    assert not out.parent.exists() or not list(out.parent.iterdir())


@pytest.mark.parametrize("scheme", ["natnet", "qtm"])
def test_a_server_that_never_answers_ends_a_session_of_a_given_length(scheme, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("track.live.live_tracking._FIRST_FRAME_WAIT", 0.5)
    monkeypatch.setattr(f"track.streams.{'natnet' if scheme == 'natnet' else 'qualisys'}._PATIENCE", 0.2)
    with socket.socket(
        socket.AF_INET, socket.SOCK_DGRAM if scheme == "natnet" else socket.SOCK_STREAM
    ) as one:
        one.bind(("127.0.0.1", 0))
        address = f"{scheme}://127.0.0.1:{one.getsockname()[1]}"
        live = ["--live", address, "--seconds", "0.2", "--size", "M", "--out", str(tmp_path / "live.npz")]
        assert main(["track", *live]) == 1
    assert f"handsim track: {address}: no " in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("sends", [False, True])
def test_a_full_disk_ends_the_recording_and_the_hands_go_on(
    sends, capture, tmp_path, capsys, monkeypatch, interrupt, listener
):
    out, part = tmp_path / "live.npz", tmp_path / "live.npz.part"
    told, heard, say = threading.Event(), [set(), set()], messages.LiveStatus.say

    def note(status, line):
        say(status, line)
        if "tracking goes on" in line:
            heard[0] = numbers_heard(listener)
            told.set()

    def goes_on() -> bool:
        heard[1] |= numbers_heard(listener) if told.is_set() else set()
        return len(heard[1]) > 30

    monkeypatch.setattr(messages.LiveStatus, "say", note)
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server, file_size_limit(400_000):
        send = ["--send", address_of(listener)] if sends else []
        if sends:
            interrupt(signal.SIGINT, goes_on)
        assert main(["track", "--live", server.url, "--size", "M", "--out", str(out), *send]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    with pytest.warns(CutOffWarning):
        kept = load_take(part)
    assert (
        f"the recording ended after {kept.num_frames} frames (File too large); they are kept in {part}"
        in said
    )
    assert len(heard[1]) > 30 if sends else "; tracking" not in said
    if sends:
        assert int(re.search(r"; (\d+) frames after them were not recorded", said)[1]) >= len(heard[1])


@pytest.mark.parametrize("fault", ["removed", "renamed", "cut"])
def test_a_recording_folder_that_changes_meanwhile_costs_nothing_that_is_not_told(
    fault, capture, tmp_path, capsys, interrupt
):
    folder = tmp_path / "session"
    out, part = folder / "live.npz", folder / "live.npz.part"
    before = []

    def damage() -> bool:
        if len(before) == 0 and len(numbers := _numbers_in(part)) > 60:
            before.append(len(numbers))
            if fault == "removed":
                shutil.rmtree(folder)
            elif fault == "renamed":
                folder.rename(tmp_path / "other")
            else:
                os.truncate(part, part.stat().st_size // 2)
        return bool(before) and len(_numbers_in(part)) > 90

    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server:
        interrupt(signal.SIGINT, damage)
        assert main(["track", "--live", server.url, "--size", "M", "--out", str(out)]) == 0
    said, take = capsys.readouterr(), load_take(out)
    lost = re.search(r"was cut by another program: (\d+) of its (\d+) frames are lost", said.err)
    assert (lost is not None) == (fault == "cut")
    assert ("was removed or replaced by another program" in said.err) == (fault in ("removed", "renamed"))
    tracked = int(re.search(rf"{out}: (\d+) frames", said.out)[1])
    assert take.num_frames == tracked - (int(lost[1]) if lost else 0)
    assert os.listdir(folder) == ["live.npz"]


def test_hands_are_sent_as_they_are_tracked(capture, tmp_path, capsys, monkeypatch, listener):
    """A capture is played at its own rate; every frame reaches a UDP listener."""
    out, now = tmp_path / "take.npz", [50.0]
    monkeypatch.setattr(captures, "monotonic", lambda: now[0])
    monkeypatch.setattr(captures, "sleep", lambda seconds: now.append(now.pop() + seconds))
    sent = ["--size", "M", "--send", address_of(listener), "--no-smooth"]
    assert main(["track", str(capture), "--out", str(out), *sent]) == 0
    assert now[0] - 50.0 == pytest.approx((FRAMES - 1) / 120), "it waited until each frame's time"
    messages = heard(listener)
    take = load_take(out)
    assert messages[0]["type"] == "header" and messages[0]["sides"] == ["right", "left"]
    poses = {}  # a message that is too long for a datagram has its hands in several parts
    for one in messages:
        for hand in one["hands"] if one["type"] == "frame" and "hands" in one else ():
            if "wrist" in hand:
                poses[one["number"], hand["side"]] = hand
    assert sorted(poses) == [(number, side) for number in range(FRAMES) for side in ("left", "right")]
    for number, qpos in enumerate(take.qpos):
        for side, pose in zip(take.sides, qpos, strict=True):
            hand = poses[number, side]
            if hand["wrist"] is not None and np.isfinite(pose).all():
                np.testing.assert_allclose(hand["wrist"]["position"], pose[:3], atol=2e-6)
                np.testing.assert_allclose(hand["angles"], pose[7:], atol=2e-6)
    assert f"{FRAMES} frames sent to {address_of(listener)}" in capsys.readouterr().out
