from __future__ import annotations

import json
import re
import socket
import sys
from importlib import metadata

import numpy as np
import pytest

from handsim.cli import doctor
from handsim.cli.doctor import Finding, check_drawing, check_extra, check_names, check_requirement

NUMPY, ANEW = metadata.version("numpy"), "run `pip uninstall render`, then install handsim anew"


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ("numpy>=2.0", Finding("numpy", NUMPY, ">=2.0")),
        ("numpy>=99,<100", Finding("numpy", NUMPY, "<100,>=99", "run `pip install 'numpy>=99,<100'`")),
        (
            "no-such-thing>=1",
            Finding("no-such-thing", "missing", ">=1", "run `pip install 'no-such-thing>=1'`"),
        ),
    ],
)
def test_a_dependency_that_does_not_fit_comes_with_its_remedy(asked, expected):
    assert check_requirement(asked) == expected


@pytest.mark.parametrize(
    ("owners", "shadowed", "what", "remedy"),
    [
        ({"render": ["handsim", "render"], "train": ["handsim"]}, {}, "import render", ANEW),
        ({}, {"train": "/home/me/train.py"}, "import train", "rename that, or go elsewhere"),
        (
            {"pyrender": ["pyrender", "pyrender-maintained"]},
            {},
            "import pyrender",
            "install pyrender-maintained",
        ),
    ],
)
def test_names_in_other_hands_are_told(owners, shadowed, what, remedy):
    (finding,) = check_names(owners, shadowed)
    assert (finding.what, finding.needed) == (what, True) and remedy in finding.remedy
    assert all(place in finding.found for place in shadowed.values())
    assert list(check_names({"render": ["handsim"], "pyrender": ["pyrender-maintained"]}, {})) == []


def test_the_broken_pyrender_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_pyrender_version", lambda: "0.1.45")
    (finding,) = check_names({"pyrender": ["pyrender"]}, {})
    assert finding.found == "0.1.45"


def test_the_installed_pyrender_states_its_version() -> None:
    assert doctor._pyrender_version() == metadata.version("pyrender-maintained")


def test_failed_drawing_names_the_system_packages() -> None:
    finding = check_drawing(1, "ImportError: no library")
    assert finding.needed and ("libegl1" if sys.platform == "linux" else "") in finding.remedy != ""


def test_a_probe_tells_its_last_line_or_its_error() -> None:
    assert doctor._finish(doctor._start("print('noise'); print('answer')")) == (0, "answer")
    failed = doctor._finish(doctor._start("raise RuntimeError('no driver')"))
    assert failed == (1, "RuntimeError: no driver")
    code, output = doctor._finish(doctor._start("import os; os.abort()"))
    assert code != 0 and output


@pytest.mark.parametrize(
    ("requirements", "found"),
    [
        (["numpy>=2.0"], "installed"),
        (["no-such-thing>=1", "numpy>=2.0"], "no-such-thing missing"),
        (["numpy>=99", "no-such-thing"], f"numpy {NUMPY}, no-such-thing missing"),
    ],
)
def test_an_extra_is_told_with_what_it_is_for(requirements, found):
    finding = check_extra("view", "handsim view", requirements)
    assert (finding.what, finding.found, finding.needed) == ("handsim view", found, False)
    assert (found != "installed") == ("pip install 'handsim[view]'" in finding.remedy)


def test_every_extra_of_users_is_listed():
    stated = metadata.metadata("handsim").get_all("Provides-Extra")
    assert {*stated} - {"dev", "docs"} == {*doctor._EXTRA_PURPOSES}
    told = {finding.expected: finding for finding in doctor.check_requirements()}
    assert all(told[f"handsim[{extra}]"].found for extra in doctor._EXTRA_PURPOSES)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize("folder", ["/proc/nope", "/proc", "/proc/self/fd/nope", __file__])
def test_a_cache_that_cannot_be_written_is_named(folder, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", folder)
    finding = doctor.check_learned_gloves()
    assert finding.found == f"{folder}/handsim/gloves, which cannot be written"
    assert "XDG_CACHE_HOME" in finding.remedy
    monkeypatch.setenv("NUMBA_CACHE_DIR", f"{folder}/kernels")
    assert "cannot be written" in doctor.check_kernel_cache().found


def test_a_cache_that_is_yet_to_be_made_is_fine(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "new" / "cache"))
    assert doctor.check_learned_gloves().remedy == "" and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("findings", "code"),
    [
        ([Finding("torch", "2.13.0", ">=2.8")], 0),
        ([Finding("disk", "0.1 GB", "1 GB", "free some space", needed=False)], 0),
        ([Finding("torch", "missing", ">=2.8", "run `pip install torch`")], 1),
    ],
)
def test_exit_code_and_report(findings, code, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "examine", lambda: findings)
    assert doctor.doctor() == code
    out = capsys.readouterr().out
    assert all(finding.found in out and finding.remedy in out for finding in findings)


def test_this_machine_is_examined() -> None:
    findings = {finding.what: finding for finding in doctor.examine()}
    assert "drawing (EGL)" in findings
    assert int(findings["CPU cores"].found) >= 1
    try:
        metadata.version("handsim")
    except metadata.PackageNotFoundError:
        assert findings["handsim"].remedy
    else:
        assert findings["Python"].remedy == ""
        assert findings["numpy"].found == metadata.version("numpy")


@pytest.mark.parametrize("axes", ["world", "ros", "openxr", "unity", "unreal"])
@pytest.mark.parametrize("forward", ["x", "-z"])
def test_a_hand_points_along_the_axes_of_the_room_in_turn(axes, forward, monkeypatch):
    """What is received, by the numbers alone: the tip lies ahead of the wrist forward, to the left and up."""
    seen = {
        "ros": ["+x", "+y", "+z"],
        "openxr": ["-z", "-x", "+y"],
        "unity": ["+z", "-x", "+y"],
        "unreal": ["+x", "-y", "+z"],
        "world": ["+x", "-z", "+y"] if forward == "x" else ["-z", "-x", "+y"],
    }[axes]
    monkeypatch.setattr(doctor, "_POINTING_FRAMES", 3)
    monkeypatch.setattr(doctor, "_HAND_RATE", 1e3)
    told, frames = [], []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)

        def ended() -> bool:
            try:
                while True:
                    document = json.loads(receiver.recv(1401))
                    frames.extend(document.get("hands", []))
            except BlockingIOError:
                return len(told) > 3

        address = (
            f"udp://127.0.0.1:{receiver.getsockname()[1]}?axes={axes}&up=y&forward={forward}&velocities=yes"
        )
        doctor.send_pointing_hand(address, ended, told.append)
    poses = [hand for hand in frames if "positions" in hand]
    unit = 100.0 if axes == "unreal" else 1.0
    for along in range(3):
        hand = poses[3 * along]
        wrist, tip = np.array(hand["wrist"]["position"]), np.array(hand["positions"][8])
        room = np.array([(-1 if one[0] == "-" else 1) * np.eye(3)["xyz".index(one[1])] for one in seen])
        np.testing.assert_allclose(room @ wrist, unit * np.array([0.1, 0.2, 0.3]), atol=1e-6 * unit)
        ahead = room @ (tip - wrist) / unit
        assert 0.15 < ahead[along] < 0.22 and np.abs(np.delete(ahead, along)).max() < 0.04
        assert f"{('forward', 'left', 'up')[along]}, along {seen[along]}," in told[along]
        said = [float(one) for one in re.findall(r"-?\d+\.\d+", told[along])]
        np.testing.assert_allclose(said, tip, atol=6e-4)
    assert hand["angles"][4:8] == [0.0] * 4
