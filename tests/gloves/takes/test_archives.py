"""Archives that grow: whole blocks are read whatever follows them, and the finished file holds the same."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from gloves import load_take
from gloves.takes import archives as growing
from gloves.takes.archives import (
    Column,
    GrowingArchive,
    GrownArchive,
    finish_archive,
    growing_path,
    is_growing,
)
from handsim import HandSimError, HandSimWarning
from handsim.errors import CaptureError
from handsim.files import arrays as array_files
from handsim.files.arrays import read_npz, write_npz
from handsim.hand.shape import HAND_DTYPE
from tests.limits import file_size_limit
from train import simulate_take

COLUMNS = (
    Column("times", "<f8", ("T",)),
    Column("nothing", "<f8", ("T", 0, 7)),
    Column("points", "<f8", ("P", 3)),
    Column("ids", "<i4", ("P",)),
)
EMPTY = {"times": 0.0, "nothing": np.zeros((0, 7)), "points": np.zeros((0, 3)), "ids": np.zeros(0)}
FIXED = {"places": np.arange(12.0).reshape(4, 3), "none": np.zeros((0, 3))}
VALUES = (np.nan, np.inf, 0.0, 1e-200, 1e200, -1.0, 100.0)
FRAMES = ("qpos", "body_poses", "points", "times", "body_markers", "attachment_normals")
SHAPES = [name for name in HAND_DTYPE.names if name != "left"]


def record(path, rng, counts, *, every: int = 4) -> list[dict]:
    """A recording of frames with so many points, in blocks of `every` frames."""
    rows = []
    with GrowingArchive(path, {"kind": "test"}, FIXED, COLUMNS) as archive:
        for number, count in enumerate(counts):
            rows.append(
                {
                    "times": np.array(0.01 * number),
                    "nothing": np.zeros((0, 7)),
                    "points": rng.normal(size=(count, 3)),
                    "ids": np.arange(count),
                }
            )
            archive.add(rows[-1], count)
            if number % every == every - 1:
                archive.flush()
        assert archive.num_frames == len(counts)
    return rows


def check(read, rows) -> None:
    np.testing.assert_array_equal(read["times"], [row["times"] for row in rows])
    np.testing.assert_array_equal(read["point_counts"], [len(row["ids"]) for row in rows])
    assert read["nothing"].shape == (len(rows), 0, 7)
    points = np.concatenate([np.zeros((0, 3)), *(row["points"] for row in rows)])
    np.testing.assert_array_equal(read["points"], points)
    np.testing.assert_array_equal(read["ids"], np.concatenate([[], *(row["ids"] for row in rows)]))
    for name, array in FIXED.items():
        np.testing.assert_array_equal(read[name], array)


def test_what_was_added_is_read_and_finished(rng, tmp_path):
    path = growing_path(tmp_path / "take.npz")
    rows = record(path, rng, [3, 0, 5, 1, 2, 2, 7, 0, 1, 4])
    assert path.name == "take.npz.part" and is_growing(path)
    grown = GrownArchive(path)
    assert (grown.num_frames, grown.header) == (10, {"kind": "test"})
    check(grown.read(), rows)
    np.testing.assert_array_equal(grown.first("times", 5), 0.01 * np.arange(8))
    assert grown.read(2)["times"].tolist() == [0.01 * n for n in (0, 1, 2, 3, 8, 9)]
    finish_archive(grown, tmp_path / "take.npz", {"kind": "test", "rate": 100.0})
    with np.load(tmp_path / "take.npz", allow_pickle=False) as stored:
        check(stored, rows)
        assert json.loads(str(stored["header"])) == {"kind": "test", "rate": 100.0}


def test_the_head_of_a_recording_is_replaced_while_it_grows(rng, tmp_path):
    path, other = tmp_path / "x.part", {**FIXED, "places": -FIXED["places"]}
    row = {"times": 0.0, "nothing": np.zeros((0, 7)), "points": rng.normal(size=(2, 3)), "ids": np.arange(2)}
    with GrowingArchive(path, {"kind": "test"}, FIXED, COLUMNS) as archive:
        archive.add(row, 2)
        archive.flush()
        archive.replace_head({"kind": "test", "sizes": [1, 2]}, other)
        archive.add(row, 2)
    grown = GrownArchive(path)
    assert grown.header == {"kind": "test", "sizes": [1, 2]} and grown.num_lost_bytes == 0
    np.testing.assert_array_equal(grown.read()["places"], other["places"])
    np.testing.assert_array_equal(grown.read()["points"], [*row["points"], *row["points"]])
    with GrowingArchive(tmp_path / "y.part", {}, FIXED, COLUMNS) as archive:
        archive.replace_head({"long": "x" * 5000}, FIXED)  # no room
        archive.replace_head({}, {**FIXED, "places": np.zeros((5, 3))})
    check(GrownArchive(tmp_path / "y.part").read(), [])


def test_an_empty_recording_is_one(tmp_path):
    with GrowingArchive(tmp_path / "x.part", {}, FIXED, COLUMNS):
        pass
    check(GrownArchive(tmp_path / "x.part").read(), [])


def test_every_cut_leaves_whole_blocks(rng, tmp_path):
    path, cut = tmp_path / "x.part", tmp_path / "cut.part"
    rows, content = record(path, rng, [3, 0, 5, 1, 2, 2, 7, 0, 1, 4]), path.read_bytes()
    begin = content.index(b"blk\n")
    frames = set()
    for length in range(0, len(content), 5):
        cut.write_bytes(content[:length])
        if length < begin:
            with pytest.raises(ValueError):
                GrownArchive(cut)
            continue
        grown = GrownArchive(cut)
        check(grown.read(), rows[: grown.num_frames])
        frames.add(grown.num_frames)
    assert frames == {0, 4, 8}
    for rest in (bytes(10_000), rng.bytes(10_000), content[begin:]):
        cut.write_bytes(content + rest)
        check(GrownArchive(cut).read(), rows)


def test_damage_ends_a_recording_before_it(rng, tmp_path):
    path = tmp_path / "x.part"
    rows, content = record(path, rng, [3] * 12), path.read_bytes()
    second = content.index(b"blk\n", content.index(b"blk\n") + 4)
    for at in range(second, second + 80):
        damaged = bytearray(content)
        damaged[at] ^= 0x41
        path.write_bytes(damaged)
        check(GrownArchive(path).read(), rows[:4])


def test_a_recording_is_never_overwritten(rng, tmp_path):
    record(tmp_path / "x.part", rng, [1])
    before = (tmp_path / "x.part").read_bytes()
    with pytest.raises(CaptureError, match=r"x\.part exists: a recording that was cut off"):
        record(tmp_path / "x.part", rng, [1])
    assert (tmp_path / "x.part").read_bytes() == before


def test_frames_wait_no_longer_than_half_a_second(rng, tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(growing.time, "monotonic", lambda: now[0])
    with GrowingArchive(tmp_path / "x.part", {}, FIXED, COLUMNS) as archive:
        archive.add(EMPTY, 0)
        assert GrownArchive(archive.path).num_frames == 0
        now[0] += 0.51
        archive.flush_due()
        assert GrownArchive(archive.path).num_frames == 1, "read while it grows"
        for _ in range(60):
            now[0] += 0.01
            archive.add(EMPTY, 0)
        assert GrownArchive(archive.path).num_frames > 45


def test_a_full_disk_keeps_what_was_written(rng, tmp_path):
    path = tmp_path / "x.part"
    archive = GrowingArchive(path, {}, FIXED, COLUMNS)
    archive.add(EMPTY, 0)
    archive.flush()
    archive.add(EMPTY, 0)
    with file_size_limit(path.stat().st_size + 10), pytest.raises(OSError) as error:
        archive.flush()
    assert error.value.errno == errno.EFBIG and archive.num_frames == 1
    archive.close()
    grown = GrownArchive(path)
    assert grown.num_frames == 1 and grown.num_lost_bytes == 0


def half_a_recording(path):
    """An archive with three blocks of two frames."""
    archive = GrowingArchive(path, {"kind": "test"}, FIXED, COLUMNS)
    for number in range(6):
        archive.add({**EMPTY, "times": number}, 0)
        if number % 2:
            archive.flush()
    return archive


def remove_folder(path):
    shutil.rmtree(path.parent)


def remove_file(path):
    path.unlink()


def rename_folder(path):
    path.parent.rename(path.parent.with_name("renamed"))


def put_a_copy_in_its_place(path):
    shutil.copy(path, path.with_name("copy"))
    os.replace(path.with_name("copy"), path)


def put_a_file_in_place_of_its_folder(path):
    shutil.rmtree(path.parent)
    path.parent.write_text("a file")


GONE = (remove_folder, remove_file, rename_folder, put_a_copy_in_its_place, put_a_file_in_place_of_its_folder)


@pytest.mark.parametrize("when", ["while frames come", "before the end"])
@pytest.mark.parametrize("gone", GONE)
def test_a_recording_that_is_removed_is_written_again(gone, when, tmp_path):
    path = tmp_path / "session" / "x.part"
    archive = half_a_recording(path)
    gone(path)
    with pytest.warns(HandSimWarning, match="x.part was removed or replaced by another"):
        if when == "while frames come":
            archive.add({**EMPTY, "times": 6.0}, 0)
            archive.flush()
        archive.close()
    times = GrownArchive(archive.path).read()["times"]
    np.testing.assert_array_equal(times, np.arange(6 + (when == "while frames come")))
    assert (archive.path == path) == (gone not in GONE[3:])
    if not archive.path.is_relative_to(tmp_path):
        archive.path.unlink()  # in the folder of temporary files, as there was no other


def test_a_recording_is_written_again_where_it_was_from_another_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    archive = half_a_recording(Path("x.part"))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    archive.add({**EMPTY, "times": 6.0}, 0)
    archive.flush()
    (tmp_path / "x.part").unlink()
    with pytest.warns(HandSimWarning, match="was removed"):
        archive.close()
    assert GrownArchive(tmp_path / "x.part").num_frames == 7 and not list(elsewhere.iterdir())


@pytest.mark.parametrize(("length", "left"), [("nothing", 0), ("head", 0), ("block", 2), ("longer", 6)])
def test_a_recording_that_is_cut_goes_on_after_its_last_whole_block(length, left, tmp_path):
    path = tmp_path / "x.part"
    archive = half_a_recording(path)
    whole = path.stat().st_size
    ends = [end for end, _ in archive._blocks]
    size = {"nothing": 0, "head": ends[0] // 2, "block": ends[2] - 1, "longer": whole + 100}[length]
    os.truncate(path, size)
    archive.add({**EMPTY, "times": 6.0}, 0)
    told = f"x.part was cut by another program: {6 - left} of its 6 frames are lost"
    with pytest.warns(HandSimWarning, match=told) if left < 6 else contextlib.nullcontext():
        archive.close()
    grown = GrownArchive(path)
    assert archive.num_frames == grown.num_frames == left + 1 and grown.header == {"kind": "test"}
    np.testing.assert_array_equal(grown.read()["times"], [*range(left), 6])


def test_headers_that_lie_take_no_memory(rng, tmp_path):
    path = tmp_path / "x.part"
    record(path, rng, [2] * 4)
    content = path.read_bytes()
    huge = content.replace(b'"shape": ["P", 3]', b'"shape": ["P", 99999999]')
    assert len(huge) > len(content)
    for damaged in (
        b"handsim recording 1\n" + b"\xff\xff\xff\x7f" + bytes(100),
        huge,
        content.replace(b"<f8", b"|O8"),
        content.replace(b"(4, 3)", b"(9, 9)"),
        content.replace(b'"columns"', b'"kolumns"'),
    ):
        path.write_bytes(damaged)
        with pytest.raises((ValueError, KeyError, TypeError)):
            GrownArchive(path)


def test_a_crowded_frame_makes_nothing_larger(rng, tmp_path):
    path = tmp_path / "take.npz.part"
    rows = record(path, rng, [0] * 20_000 + [300_000, 2], every=1000)
    grown = GrownArchive(path)
    check(grown.read(), rows)
    finish_archive(grown, tmp_path / "take.npz", {"kind": "test"})
    check(read_npz(tmp_path / "take.npz"), rows)


def test_hours_in_which_nothing_moves_are_read(tmp_path, monkeypatch):
    """What compresses far better than the reader allows is written without compression."""
    monkeypatch.setattr(array_files, "_ALWAYS_ALLOWED", 1 << 16)
    columns = (Column("qpos", "<f8", ("T", 50)),)
    with GrowingArchive(tmp_path / "x.part", {}, {}, columns) as archive:
        for _ in range(2000):
            archive.add({"qpos": np.full(50, np.nan)}, 0)
    finish_archive(GrownArchive(tmp_path / "x.part"), tmp_path / "x.npz", {})
    assert np.isnan(read_npz(tmp_path / "x.npz")["qpos"]).all()
    with (tmp_path / "small.npz").open("wb") as file:
        np.savez_compressed(file, qpos=np.full((2000, 50), np.nan))
    with pytest.raises(ValueError, match="expected at most"):
        read_npz(tmp_path / "small.npz")


def test_what_cannot_be_read_back_is_not_written(rng, tmp_path, monkeypatch):
    """The disk returns other bytes than were written."""
    record(tmp_path / "x.part", rng, [3] * 12)

    def damage(path, members):
        write_npz(path, members)
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 0xFF
        path.write_bytes(content)

    monkeypatch.setattr(growing, "write_npz", damage)
    with pytest.raises(OSError, match="read back"):
        finish_archive(GrownArchive(tmp_path / "x.part"), tmp_path / "x.npz", {})
    assert [path.name for path in tmp_path.iterdir()] == ["x.part"]


def refused_or_exported(folder, arrays) -> None:
    np.savez(folder / "altered.npz", **arrays)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with contextlib.suppress(HandSimError):
            take = load_take(folder / "altered.npz")
            for ending in (".glb", ".bvh", ".mot", ".csv"):
                take.export(folder / f"altered{ending}")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("take") / "take.npz"
    simulate_take("hand-controller", num_frames=5).save(path)
    return path


@pytest.fixture
def arrays(saved):
    return dict(np.load(saved))


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", (*SHAPES, *FRAMES))
def test_impossible_numbers_are_refused_or_exported(arrays, tmp_path, name, value):
    if name in SHAPES:
        arrays["hands"][name][0] = value
    else:
        arrays[name][-1] = value
    refused_or_exported(tmp_path, arrays)


@pytest.mark.parametrize("rate", [1e-300, 1e-3, 1e9, 1e300])
def test_rates(arrays, tmp_path, rate):
    header = json.loads(str(arrays["header"])) | {"rate": rate}
    arrays["header"] = np.array(json.dumps(header))
    refused_or_exported(tmp_path, arrays)


def test_arrays_of_ones_own_are_told_from_a_damaged_take(tmp_path):
    np.savez(tmp_path / "own.npz", places=np.zeros((2, 1, 3)), names=["a"], rate=120.0)
    with pytest.raises(CaptureError, match=r"own\.npz: not a take, .*; gloves\.Capture"):
        load_take(tmp_path / "own.npz")


@pytest.mark.parametrize("name", ["qpos", "body_poses"])
def test_orientations_have_unit_length(arrays, tmp_path, name):
    arrays[name][..., 3:7] *= 1.000001  # as rounded
    np.savez(tmp_path / "rounded.npz", **arrays)
    load_take(tmp_path / "rounded.npz")
    arrays[name][..., 3:7] *= 1e-200
    np.savez(tmp_path / "tiny.npz", **arrays)
    with pytest.raises(CaptureError, match=r"tiny\.npz: not a take, or a damaged one"):
        load_take(tmp_path / "tiny.npz")
