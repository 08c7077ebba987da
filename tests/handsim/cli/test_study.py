"""A study in one command: a table of captures, interruptions, a damaged file, and the long table."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from gloves import load_take, write_capture
from gloves.captures.formats import read_capture
from handsim.cli.main import main
from handsim.hand.angles import ISB_NAMES
from handsim.hand.shape import JOINT_NAMES
from track import captures as tracking
from train import simulate_take

FRAMES = 15
NAMES = [
    f"p{person}/s{session}-{trial}.trc" for person in "123" for session in "12" for trial in ("flat", "go")
]


@pytest.fixture(scope="module")
def simulated():
    return simulate_take(kind="single-hand", hands=("right",), num_frames=FRAMES * len(NAMES))


def write_table(path: Path, separator: str = ",", **changed: str) -> None:
    """The table of the study: 12 captures of 3 people in 2 sessions; cells of the last capture may change."""
    rows = [
        {
            "capture": name,
            "person": f"0{name[1]}",
            "session": name[4],
            "side": "right",
            "neutral": name.replace("go", "flat"),
            "glove": "dense19",
        }
        for name in NAMES
    ]
    rows[-1] |= changed
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), delimiter=separator)
        writer.writeheader()
        writer.writerows(rows)


def read_table(path: Path, separator: str = ",") -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file, delimiter=separator))


@pytest.fixture
def counted(monkeypatch):
    """The names of the captures that are tracked; each one in `stops` interrupts the command once."""
    tracked, stops = list[str](), list[str]()
    track = tracking.track_capture

    def track_one(capture, *arguments, **options):
        if capture.name in stops:
            stops.remove(capture.name)
            raise KeyboardInterrupt
        tracked.append("/".join(capture.parts[-2:]))
        return track(capture, *arguments, **options)

    monkeypatch.setattr(tracking, "track_capture", track_one)
    monkeypatch.setattr("track.takes.take_page.picture", lambda *drawn, **options: "data:,")
    return tracked, stops


@pytest.mark.slow
def test_a_study_is_done_once_past_interruptions_and_a_damaged_file(simulated, tmp_path, capsys, counted):
    tracked, stops = counted
    table, takes, pages = tmp_path / "table.csv", tmp_path / "takes", tmp_path / "pages"
    for number, name in enumerate(NAMES):
        part = simulated.cut(FRAMES * number, FRAMES * (number + 1))
        write_capture(tmp_path / name, part.capture())
    bad, good = NAMES[5], [name for name in NAMES if name != NAMES[5]]
    (tmp_path / bad).write_bytes((tmp_path / bad).read_bytes()[:100])
    write_table(table)
    track = ["track", str(table), "--size", "M", "--out", str(takes)]
    report = ["report", str(takes), "--out", str(pages)]

    stops += ["s2-go.trc", "s1-flat.trc"]
    assert main(track) == 130 and main(track) == 130 and not stops
    done = len(tracked)
    assert 0 < done < len(NAMES)
    assert main(track) == 1
    said = capsys.readouterr()
    assert said.err.splitlines()[-1] == f"handsim track: 1 of 12 files were not tracked: {tmp_path / bad}"
    assert f"{tmp_path / bad}: not tracked: the header is cut" in said.err
    assert sorted(tracked) == sorted([*good, bad]), "each was tracked once, the damaged one tried once"

    tracked.clear()
    assert main(track) == 1 and tracked == [bad]
    write_capture(tmp_path / bad, read_capture(tmp_path / NAMES[0]))
    tracked.clear()
    for name in NAMES:  # new dates are no new content
        (tmp_path / name).touch()
    assert main(track) == 0 and tracked == [bad]

    assert main(report) == 0
    rows = read_table(pages / "study.csv")
    assert list(rows[0]) == [
        "capture", "person", "session", "side", "joint", "measure", "value [deg]", "SD", "SD constant", "MDD",
        "share measured", "convention", "made of",
    ]  # fmt: skip
    assert len(rows) == len(NAMES) * 4 * (len(JOINT_NAMES) + len(ISB_NAMES))
    assert {row["convention"] for row in rows} == {
        "model, zero in the neutral pose", "isb, zero in the neutral pose"
    }  # fmt: skip
    for name in NAMES:
        take = load_take((takes / name).with_suffix(".npz"))
        flat = load_take((takes / name.replace("go", "flat")).with_suffix(".npz"))
        mine = [row for row in rows if (row["capture"], row["person"]) == (name[3:], f"0{name[1]}")]
        angles = np.rad2deg(take.angles("right", neutral=flat)["index_PIP_flexion"])
        zero = np.rad2deg(flat.angles("right")["index_PIP_flexion"].mean())
        np.testing.assert_allclose(angles, np.rad2deg(take.angles("right")["index_PIP_flexion"]) - zero)
        (mean, low, high, span) = (
            row for row in mine if row["joint"] == "index_PIP_flexion" and row["convention"][0] == "m"
        )
        assert [row["measure"] for row in (mean, low, high, span)] == [
            "mean", "5th percentile", "95th percentile", "range of motion"
        ]  # fmt: skip
        assert mean["session"] == name[4] and mean["side"] == "right" and mean["share measured"] == "1"
        assert float(mean["value [deg]"]) == pytest.approx(angles.mean(), abs=1e-3)
        assert float(span["value [deg]"]) == pytest.approx(np.ptp(np.percentile(angles, (5, 95))), abs=1e-3)
        parts = np.array(take.settings["budget"]["right"])[JOINT_NAMES.index("index_PIP_flexion")]
        assert float(mean["SD constant"]) == pytest.approx(np.hypot(parts[1], parts[3]), rel=1e-4)
        assert float(mean["SD"]) > 0.0 and float(span["MDD"]) > float(mean["MDD"]) > 0.0 and span["SD"] == ""

    before = (pages / "study.csv").read_bytes()
    tracked.clear()
    write_table(table, ";", person="3b")  # a person's name is no setting of tracking
    assert main(track) == 0 and tracked == []
    write_table(table, ";", glove="sparse13")  # a setting of one capture
    assert main(track) in (0, 1) and tracked == [NAMES[-1]]
    write_table(table, ";")
    tracked.clear()
    assert main(track) == 0 and tracked == [NAMES[-1]]
    capsys.readouterr()
    assert main(report) == 0
    assert (pages / "study.csv").read_bytes() == before
    assert "0 files reported now, 12 before" in capsys.readouterr().out

    (takes / NAMES[3]).with_suffix(".npz").write_bytes(b"damaged")
    assert main(report) == 1
    left = read_table(pages / "study.csv")
    assert {row["capture"] for row in left if row["person"] == "01"} == {
        "s1-flat.trc",
        "s1-go.trc",
        "s2-flat.trc",
    }
    tracked.clear()
    assert main(track) == 0 and tracked == [NAMES[3]], "a damaged output is made again"

    assert main([*report, "--decimal", ","]) == 0
    numbers = {"value [deg]", "SD", "SD constant", "MDD", "share measured"}
    for one, other in zip(rows, read_table(pages / "study.csv", ";"), strict=True):
        assert other == {
            name: cell.replace(".", "," if name in numbers else ".") for name, cell in one.items()
        }
    tracked.clear()
    # A setting of all.
    assert main([*track, "--known", "index_PIP_flexion=20"]) == 0 and sorted(tracked) == sorted(NAMES)
    known = [load_take((takes / name).with_suffix(".npz")).settings["known"] for name in NAMES]
    assert known == [{"index_PIP_flexion": 20.0}] * len(NAMES)
    record = json.loads((takes / "study.json").read_text())
    assert list(record["study"]) == [name.replace(".trc", ".npz") for name in NAMES]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("capture,glvoe\na.c3d,dense19\n", "unknown column 'glvoe'"),
        ("capture,side\na.c3d,R\n", "line 2: unknown side 'R'"),
        ("capture,person\n,P1\n", "line 2: there is no capture"),
        ("capture\na.c3d\na.trc\n", "two outputs are"),
    ],
)
def test_mistakes_in_a_table_are_told_first(text, words, tmp_path, capsys):
    (tmp_path / "table.csv").write_text(text)
    assert main(["track", str(tmp_path / "table.csv"), "--out", str(tmp_path / "takes")]) == 1
    assert words in capsys.readouterr().err and not (tmp_path / "takes").exists()


def test_captures_that_cannot_be_read_are_counted(tmp_path, capsys):
    (tmp_path / "a.c3d").touch()
    (tmp_path / "b.c3d").touch()
    both = [str(tmp_path / "a.c3d"), str(tmp_path / "b.c3d")]
    for command in ("track", "calibrate"):
        assert main([command, *both, "--out", str(tmp_path / command)]) == 1
        assert (
            f"2 of 2 files were not {command.rstrip('e')}ed: {both[0]}, {both[1]}" in capsys.readouterr().err
        )
