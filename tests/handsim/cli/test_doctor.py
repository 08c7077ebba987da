from __future__ import annotations

import sys
from importlib import metadata

import pytest

from handsim.cli import doctor
from handsim.cli.doctor import Finding, check_drawing, check_names, check_requirement


def test_a_present_dependency_is_fine() -> None:
    assert check_requirement("numpy>=2.0") == Finding("numpy", metadata.version("numpy"), ">=2.0")


def test_an_old_dependency_comes_with_its_remedy() -> None:
    finding = check_requirement("numpy>=99,<100")
    assert finding.remedy == "run `pip install 'numpy>=99,<100'`"
    assert finding.needed


def test_an_absent_dependency_comes_with_its_remedy() -> None:
    finding = check_requirement("no-such-thing>=1")
    assert (finding.found, finding.remedy) == ("missing", "run `pip install 'no-such-thing>=1'`")


def test_names_in_good_hands_need_no_word() -> None:
    assert list(check_names({"render": ["handsim"], "pyrender": ["pyrender-maintained"]}, {})) == []


def test_a_second_owner_of_a_name_is_told() -> None:
    (finding,) = check_names({"render": ["handsim", "render"], "train": ["handsim"]}, {})
    assert finding.what == "import render"
    assert finding.remedy == "run `pip uninstall render`, then install handsim anew"


def test_a_shadowed_sibling_is_told() -> None:
    (finding,) = check_names({}, {"train": "/home/me/train.py"})
    assert (finding.found, finding.needed) == ("/home/me/train.py", True)


def test_two_pyrenders_are_told() -> None:
    (finding,) = check_names({"pyrender": ["pyrender", "pyrender-maintained"]}, {})
    assert "pip install pyrender-maintained" in finding.remedy


def test_the_broken_pyrender_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_pyrender_version", lambda: "0.1.45")
    (finding,) = check_names({"pyrender": ["pyrender"]}, {})
    assert finding.found == "0.1.45"


def test_the_installed_pyrender_states_its_version() -> None:
    assert doctor._pyrender_version() == metadata.version("pyrender-maintained")


def test_failed_drawing_names_the_system_packages() -> None:
    finding = check_drawing(1, "ImportError: no library")
    assert finding.needed
    assert finding.remedy
    if sys.platform == "linux":
        assert "libegl1" in finding.remedy


def test_a_probe_tells_its_last_line_or_its_error() -> None:
    assert doctor._finish(doctor._start("print('noise'); print('answer')")) == (0, "answer")
    code, output = doctor._finish(doctor._start("raise RuntimeError('no driver')"))
    assert (code, output) == (1, "RuntimeError: no driver")
    code, output = doctor._finish(doctor._start("import os; os.abort()"))
    assert code != 0
    assert output


@pytest.mark.parametrize(
    ("findings", "code"),
    [
        ([Finding("torch", "2.13.0", ">=2.8")], 0),
        ([Finding("disk", "0.1 GB", "1 GB", "free some space", needed=False)], 0),
        ([Finding("torch", "missing", ">=2.8", "run `pip install torch`")], 1),
    ],
)
def test_exit_code_and_report(
    findings: list[Finding], code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "examine", lambda: findings)
    assert doctor.doctor() == code
    out = capsys.readouterr().out
    for finding in findings:
        assert finding.found in out
        assert finding.remedy in out


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
