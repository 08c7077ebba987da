"""Atomic writing: a file is whole or not there, on success, errors, interrupts and a full disk."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gloves import load_layout
from gloves.takes.motion_formats import MOTION_FORMATS
from handsim.cli.main import main
from handsim.errors import ArgumentError, DatasetError
from handsim.files.inputs import load_json
from handsim.files.outputs import (
    as_text,
    atomic_write,
    available_bytes,
    check_free,
    check_memory,
    check_outputs,
    claim,
    plain_path,
    remove_leftovers,
    save_json,
    shown_bytes,
    temporary_beside,
    written_together,
)
from handsim.files.signals import ENDING, Stopped, signals_raise
from tests.programs import run_python
from tests.renames import fails_at
from tests.sentences import error_names
from track import load_user
from track.user import nominal_user

NAME = os.fsdecode(b"t\xe4ke")  # of an old Windows system
SHOWN = "t\N{REPLACEMENT CHARACTER}ke"
SAID = {".mot": f"{SHOWN}\n", ".html": "<title>Take t?ke.truth.npz</title>"}
"""What files say of names, by their endings."""
names_are_bytes = pytest.mark.skipif(sys.platform != "linux", reason="names are text")
SETTINGS = {"train": {"samples": 100, "seed": 3, "network": {"width": 64}}, "names": ["a", "b"]}


def entries(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_writes_and_makes_folders(tmp_path: Path) -> None:
    path = tmp_path / "new" / "deep" / "take.truth.npz"
    with atomic_write(path) as temporary:
        assert temporary.parent == path.parent
        assert temporary.suffix == ".npz"
        assert temporary.name != path.name
        temporary.write_bytes(b"whole")
        assert not path.exists()
    assert path.read_bytes() == b"whole"
    assert entries(path.parent) == ["take.truth.npz"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, OSError])
def test_leaves_nothing_behind(tmp_path: Path, error: type[BaseException]) -> None:
    for old in (None, "old"):
        if old is not None:
            (tmp_path / "a.trc").write_text(old)
        with pytest.raises(error), atomic_write(tmp_path / "a.trc") as temporary:
            temporary.write_text("half")
            raise error
        assert contents(tmp_path) == ({} if old is None else {"a.trc": old})


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.trc"):
        pass
    assert entries(tmp_path) == []


def test_folders_and_devices_are_refused_before_any_work(tmp_path: Path) -> None:
    for target in (tmp_path, Path(os.devnull)):
        with pytest.raises(FileExistsError, match="not a regular file"), atomic_write(target):
            pytest.fail("the block must not run")
    assert Path(os.devnull).exists()


def test_files_that_belong_together_come_together(tmp_path: Path) -> None:
    first, second = tmp_path / "a.trc", tmp_path / "b" / "a.npz"
    with pytest.raises(OSError, match="full"), written_together():
        write(first, "whole")
        with atomic_write(second) as two:
            two.write_text("half")
            raise OSError("full")
    assert entries(tmp_path) == ["b"] and entries(tmp_path / "b") == []
    with written_together():
        write(first, "whole")
        with written_together():
            write(second, "whole")
        assert not first.exists() and not second.exists(), "they wait for the outer block"
    assert first.read_text() == second.read_text() == "whole"
    assert entries(tmp_path) == ["a.trc", "b"] and entries(tmp_path / "b") == ["a.npz"]


def write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text)


@given(
    old=st.lists(st.booleans(), min_size=2, max_size=4),
    at=st.integers(0, 4),
    number=st.sampled_from([None, *ENDING]),
    links=st.booleans(),
)
def test_all_new_or_all_old(old: list[bool], at: int, number: int | None, links: bool) -> None:
    """Whichever files were there, a rename fails or a signal comes at one of them."""
    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        folder = Path(name)
        files = [folder / f"take.{kind}" for kind in ("c3d", "truth.npz", "trc", "html")[: len(old)]]
        for file, is_there in zip(files, old, strict=True):
            if is_there:
                file.write_text(f"old {file.name}")
        before = contents(folder)
        fails_at(patch, at, number)
        if not links:
            patch.setattr(os, "link", refuse)
        came: list[int] = []
        handlers = {one: signal.signal(one, lambda one, _: came.append(one)) for one in ENDING}
        try:
            with suppress(OSError), written_together():
                for file in files:
                    write(file, f"new {file.name}")
        finally:
            for one, handler in handlers.items():
                signal.signal(one, handler)
        if at >= len(files) or number is not None:
            assert contents(folder) == {file.name: f"new {file.name}" for file in files}
            assert came == [number] * (at < len(files))
        else:
            assert contents(folder) == before and not came


def refuse(source: object, target: object) -> None:
    """As a file system without hard links."""
    raise OSError(errno.EPERM, "Operation not permitted", str(source), None, str(target))


def contents(folder: Path) -> dict[str, str]:
    return {entry.name: entry.read_text() for entry in folder.iterdir()}


def test_signals_wait_for_the_renames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fails_at(monkeypatch, 0, signal.SIGTERM)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Stopped) as caught, signals_raise(), written_together():
        write(tmp_path / "a.trc", "new")
        write(tmp_path / "a.npz", "new")
    assert caught.value.number == signal.SIGTERM and signal.getsignal(signal.SIGTERM) is before
    assert contents(tmp_path) == {"a.trc": "new", "a.npz": "new"}


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_what_a_process_that_was_killed_between_renames_left_is_removed(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from handsim.files.outputs import atomic_write, written_together\n"
        "rename = os.replace\n"
        "def last(source, target):\n"
        "    rename(source, target)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "os.replace = last\n"
        "with written_together():\n"
        "    for name in sys.argv[1:]:\n"
        "        with atomic_write(name) as temporary:\n"
        "            temporary.write_text('newer')\n"
    )
    files = [tmp_path / "take.c3d", tmp_path / "take.truth.npz"]
    for file in files:
        write(file, "old")
    assert run_python(script, *map(str, files), check=False).returncode == -signal.SIGKILL
    assert [file.read_text() for file in files] == ["newer", "old"]
    assert len(entries(tmp_path)) == 5, "a temporary file and two older ones"
    with written_together():
        for file in files:
            write(file, "new")
    assert contents(tmp_path) == {"take.c3d": "new", "take.truth.npz": "new"}


@pytest.mark.skipif(sys.platform == "win32", reason="no modes")
def test_the_mode_is_what_the_umask_asks_for(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        with atomic_write(tmp_path / "weights") as temporary:
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT, 0o600))  # as safetensors does
    finally:
        os.umask(before)
    assert (tmp_path / "weights").stat().st_mode & 0o777 == 0o640


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    final, here = tmp_path / "take[1].npz", str(os.getpid())
    left = tmp_path / temporary_beside(final).name.replace(here, str(gone.pid))
    others = [
        tmp_path / temporary_beside(final).name.replace(here, str(os.getppid())),
        tmp_path / temporary_beside(tmp_path / "b.npz").name.replace(here, str(gone.pid)),
        tmp_path / f".take[1].tmp-another-{gone.pid}.npz",
    ]
    for file in (left, *others):
        file.write_text("half")
    with atomic_write(final) as temporary:
        temporary.write_text("whole")
    assert not left.exists()
    assert all(file.exists() for file in others), "of a running process, another file, another machine"


@pytest.mark.parametrize("ending", [".npy", "-older.npy", ""])
def test_what_another_process_is_writing_stays(ending: str, tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    name = temporary_beside(tmp_path / "shard").name
    written, *left = (
        tmp_path / (name.replace(str(os.getpid()), str(process)) + ending)
        for process in (os.getppid(), os.getpid(), gone.pid)
    )
    for file in (written, *left):
        file.touch()
    remove_leftovers(tmp_path)
    assert [*tmp_path.iterdir()] == [written]


def test_a_folder_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError) as caught, atomic_write(tmp_path / "a.trc"):
        pytest.fail("the block must not run")
    assert caught.value.filename == str(tmp_path / "a.trc")


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
    for named in (True, False):
        with pytest.raises(OSError) as caught, atomic_write(tmp_path / "take.c3d") as temporary:
            raise OSError(errno.ENOSPC, "No space left on device", *[str(temporary)] * named)
        assert caught.value.filename == str(tmp_path / "take.c3d")


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "there").mkdir()
    file, link = tmp_path / "there" / "real.txt", tmp_path / "link.txt"
    for content in ("first", "second"):  # it points to nothing at first
        if not link.is_symlink():
            link.symlink_to(file)
        with atomic_write(link) as temporary:
            temporary.write_text(content)
        assert link.is_symlink() and file.read_text() == content
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["link.txt", "real.txt", "there"]


def test_a_file_in_the_place_of_a_folder_is_told(tmp_path):
    (tmp_path / "take.c3d").write_text("")
    with pytest.raises(NotADirectoryError, match=r"take\.c3d is a file, not a folder"):
        with atomic_write(tmp_path / "take.c3d" / "x.c3d"):
            pass


def test_an_input_is_refused_by_every_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "take.c3d"
    source.write_text("x")
    os.link(source, tmp_path / "hard.c3d")
    (tmp_path / "soft.c3d").symlink_to(source)
    (tmp_path / "folder").mkdir()
    for name in ("take.c3d", "hard.c3d", "soft.c3d", "folder/../take.c3d", str(source)):
        with pytest.raises(ArgumentError, match=r"is the input take\.c3d, expected another file"):
            check_outputs([None, "dense19", "take.c3d"], [None, tmp_path / name])
    (tmp_path / "same.c3d").write_text("x")
    check_outputs([source, "dense19"], [tmp_path / "same.c3d", tmp_path / "new.c3d", None])


def test_an_output_below_a_file_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "take.c3d").write_text("x")
    for name in ("take.c3d/x.npz", "take.c3d/folder/x.npz", str(tmp_path / "take.c3d" / "x.npz")):
        with error_names(ArgumentError, "x.npz lies in take.c3d, which is a file, expected a folder"):
            check_outputs([], [tmp_path / name])
    check_outputs([], [tmp_path / "new" / "folder" / "x.npz"])


def test_links_that_lead_nowhere_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "self.c3d").symlink_to("self.c3d")
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    (tmp_path / "gone").symlink_to("nothing")
    for name, link in (("self.c3d", "self.c3d"), ("one/a.c3d", "one"), ("./two", "two")):
        with error_names(
            ArgumentError, f"{Path(name)} cannot be written: | {link} is a link that leads to itself"
        ):
            check_outputs([], [tmp_path / name])
    with pytest.raises(ArgumentError, match=r"gone is a link to a folder that is not there"):
        check_outputs([], [tmp_path / "gone" / "a.c3d"])
    check_outputs([], [tmp_path / "gone"])  # the file that it points to will be written
    assert main(["label", "take.c3d", "--out", "self.c3d"]) == 1
    assert "self.c3d is a link that leads to itself" in capsys.readouterr().err


def test_commands_refuse_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "take.c3d").write_text("x")
    for ending in ("json", "npz", "toml", "glb", "markers.csv"):
        (tmp_path / f"take.{ending}").symlink_to("take.c3d")
    for command in (
        ["label", "take.c3d", "--out", "take.c3d"],
        ["label", "take.c3d", "--out", "./take.c3d"],
        ["evaluate", "take.c3d", "--json", "take.json"],
        ["track", "take.c3d", "--out", "take.npz"],
        ["track", "take.c3d", "--out", "new.npz", "--labeled", "take.c3d"],
        ["calibrate", "take.c3d", "--out", "take.json"],
        ["body", "take.c3d", "--out", "take.toml"],
        ["export", "take.npz", "--out", "take.glb"],
        ["report", "take.c3d", "--out", "take.html"],
    ):
        assert main(command) == 1
        assert f"is the input {command[1]}, expected another file" in capsys.readouterr().err
    assert (tmp_path / "take.c3d").read_text() == "x"


def test_what_does_not_fit_is_refused(tmp_path):
    check_free(tmp_path / "new" / "set", 10, "2 frames", "ask for fewer", error=DatasetError)
    with error_names(DatasetError, "2 frames need 1 EB, but the disk of | set has | free; ask for fewer or"):
        check_free(tmp_path / "new" / "set", 10**18, "2 frames", "ask for fewer", error=DatasetError)


@pytest.mark.parametrize(("count", "text"), [(0, "0 bytes"), (1234, "1.23 kB"), (7.01e11, "701 GB")])
def test_bytes_with_units(count, text):
    assert shown_bytes(count) == text


def test_free_memory_is_less_than_what_is_built_in():
    built_in = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < available_bytes() <= built_in


def test_memory_that_is_not_there_is_refused_with_both_sizes():
    check_memory(1000, "1 frames", "ask for fewer frames")
    with pytest.raises(ArgumentError, match=r"^5 frames need 1e\+03 EB of memory, but .* are free; ask for"):
        check_memory(10**21, "5 frames", "ask for fewer frames")


@names_are_bytes
def test_what_is_not_printable_is_replaced():
    assert as_text(NAME) == SHOWN and as_text("a\tb\n") == as_text("a\nb\t") and as_text("täke 1") == "täke 1"


@names_are_bytes
def test_a_path_that_is_no_text_has_a_link_that_is(tmp_path):
    (tmp_path / NAME).mkdir()
    path = tmp_path / NAME / f"{NAME}.c3d"
    with plain_path(path) as plain:
        assert str(plain).isascii() and plain.suffix == ".c3d"
        plain.write_text("written")
    assert path.read_text() == "written"
    with plain_path(path) as plain:
        assert plain.read_text() == "written"
        (tmp_path / "other").write_text("replaced")
        (tmp_path / "other").replace(plain)
    assert path.read_text() == "replaced" and os.listdir(path.parent) == [path.name]
    with plain_path(tmp_path / "text.c3d") as plain:
        assert plain == tmp_path / "text.c3d"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work") / NAME
    out = str(folder / f"{NAME}.c3d")
    assert main(["simulate", "--kind", "single-hand", "--num-frames", "30", "--out", out]) == 0
    return folder


@names_are_bytes
@pytest.mark.parametrize(
    ("command", "ending"),
    [
        *(
            ("simulate --kind single-hand --num-frames 20 --out", ending)
            for ending in (".trc", ".csv", ".c3d")
        ),
        *(("export {0}.truth.npz --out", ending) for ending in MOTION_FORMATS),
        *(("hand --out", ending) for ending in (".xml", ".urdf", ".osim", ".glb")),
        ("hand --out hand.xml --mesh", ".obj"),
        ("export dense19 --out", ".onnx"),
        ("report {0}.truth.npz --out", ".html"),
        ("rig import rig.toml --out", ".toml"),
        pytest.param("view {0}.truth.npz --video", ".mp4", marks=pytest.mark.slow),
        pytest.param("label {0}.c3d --out", ".c3d", marks=pytest.mark.slow),
    ],
)
def test_commands_write_under_such_a_name(command, ending, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "rig.toml").unlink(missing_ok=True)
    assert main(["rig", "new", "rig.toml"]) == 0
    out = folder / "new" / f"{NAME}{ending}"
    assert main([*(word.format(NAME) for word in command.split()), str(out)]) == 0
    assert out.stat().st_size > 0
    if ending in SAID:
        assert SAID[ending] in out.read_text("utf-8")
    assert not [one for one in os.listdir(out.parent) if one.startswith(".")]


@names_are_bytes
def test_a_user_calibrated_from_such_a_capture_is_kept(tmp_path):
    user = nominal_user(load_layout("dense19"), "M", ["right"])
    dataclasses.replace(user, notes=f"calibrated from {NAME}.c3d").save(tmp_path / "user.json")
    assert load_user(tmp_path / "user.json").notes == "calibrated from t?ke.c3d"


def claim_again(folder, *, grows="train.samples", **train):
    settings = {**SETTINGS, "train": {**SETTINGS["train"], **train}}
    result = folder / "manifest.json"
    claim(folder / "config.json", settings, noun="run", error=DatasetError, grows=grows, result=result)


def test_equal_settings_go_on_and_leftovers_go(tmp_path):
    claim_again(tmp_path)
    (tmp_path / "png").mkdir()
    for name in (".rows.tmp-1.npy", "png/.a.tmp-77.png"):
        (tmp_path / name).write_text("half")
    claim_again(tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["config.json", "png"]


def test_a_difference_is_named_with_both_values(tmp_path):
    claim_again(tmp_path)
    sentence = (
        r"holds a run begun with other settings \(train.network.depth: nothing there, 5 here; "
        r"train.network.width: 64 there, nothing here\)"
    )
    with pytest.raises(DatasetError, match=sentence):
        claim_again(tmp_path, network={"depth": 5})
    with pytest.raises(DatasetError, match=r"\(train.seed: 3 there, 4 here\); use them or another folder$"):
        claim_again(tmp_path, seed=4)


def test_one_setting_may_grow(tmp_path):
    claim_again(tmp_path)
    (tmp_path / "manifest.json").write_text("{}")
    claim_again(tmp_path)
    assert (tmp_path / "manifest.json").exists()
    claim_again(tmp_path, samples=200)
    assert load_json(tmp_path / "config.json")["train"]["samples"] == 200
    assert not (tmp_path / "manifest.json").exists(), "it was true for the old settings"
    with error_names(DatasetError, "train.samples: 200 there, 100 here | train.samples may only grow"):
        claim_again(tmp_path, samples=100)
    with error_names(DatasetError, "train.samples: 200 there, 300 here; train.seed: 3 there, 4 here"):
        claim_again(tmp_path, samples=300, seed=4)


def test_a_run_killed_at_its_first_file_goes_on(tmp_path):
    (tmp_path / ".config.tmp-77.json").write_text("{")
    claim_again(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    (tmp_path / "config.json").unlink()
    (tmp_path / "mine.txt").write_text("")
    with pytest.raises(DatasetError, match="is not empty and holds no run"):
        claim_again(tmp_path)


def test_json_nested_without_end_is_damage(tmp_path):
    (tmp_path / "config.json").write_text("[" * 200_000)
    with pytest.raises(DatasetError, match=r"config.json is damaged: it does not hold JSON"):
        load_json(tmp_path / "config.json")


def test_what_is_not_finite_becomes_null(tmp_path):
    path = tmp_path / "figures.json"
    save_json(path, {"recall": float("nan"), "curve": [1.0, float("inf")], "runs": {"a": (2, 0.5)}})
    assert json.loads(path.read_text(), parse_constant=pytest.fail) == {
        "recall": None, "curve": [1.0, None], "runs": {"a": [2, 0.5]}
    }  # fmt: skip


@pytest.mark.parametrize(
    "name", ["a" * 251, "\N{LATIN SMALL LETTER A WITH DIAERESIS}" * 125, "\N{GRINNING FACE}" * 62]
)
def test_the_longest_names_are_written(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.csv"
    for text in ("old", "new"):
        with atomic_write(path) as temporary:
            assert len(os.fsencode(temporary.name)) <= len(os.fsencode(path.name))
            temporary.write_text(text)
    assert path.read_text() == "new"
    assert entries(tmp_path) == [path.name]


def test_long_names_that_begin_alike_have_temporary_names_of_their_own(tmp_path: Path) -> None:
    assert len({temporary_beside(tmp_path / f"{'a' * 100}{end}.csv") for end in "xyz"}) == 3


@pytest.mark.parametrize("name", ["~/take.csv", "~/deep/take.csv", "~/take.npz"])
def test_no_folder_is_made_for_the_tilde(tmp_path: Path, monkeypatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with (
        pytest.raises(ArgumentError, match=r"only shells replace ~, expected .*expanduser"),
        atomic_write(name),
    ):
        pass
    assert entries(tmp_path) == []


@pytest.mark.parametrize("code", [errno.EPERM, errno.ENOTSUP, errno.EACCES])
def test_a_file_system_without_modes_is_written_to(tmp_path: Path, monkeypatch, code: int) -> None:
    def refuse(path: object, mode: int) -> None:
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(os, "chmod", refuse)
    with atomic_write(tmp_path / "take.csv") as temporary:
        temporary.write_text("whole")
    assert (tmp_path / "take.csv").read_text() == "whole"
    assert entries(tmp_path) == ["take.csv"]
