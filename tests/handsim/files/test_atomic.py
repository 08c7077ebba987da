"""Atomic writing: a file is whole or not there, on success, errors, interrupts and a full disk."""

import errno
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

from handsim.files.outputs import atomic_write, temporary_beside, written_together
from handsim.files.signals import ENDING, Stopped, signals_raise
from tests.renames import fails_at


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


def test_replaces_only_on_success(tmp_path: Path) -> None:
    path = tmp_path / "take.trc"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), atomic_write(path) as temporary:
        temporary.write_text("half")
        _ = 1 / 0
    assert path.read_text() == "old"
    assert entries(tmp_path) == ["take.trc"]
    with atomic_write(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, OSError])
def test_leaves_nothing_behind(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), atomic_write(tmp_path / "a.trc") as temporary:
        temporary.write_text("half")
        raise error
    assert entries(tmp_path) == []


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "a.trc"):
        pass
    assert entries(tmp_path) == []


def test_folders_and_devices_are_refused_before_any_work(tmp_path: Path) -> None:
    for target in (tmp_path, Path(os.devnull)):
        with pytest.raises(FileExistsError, match="not a regular file"), atomic_write(target):
            pytest.fail("the block must not run")
    assert Path(os.devnull).exists()


def test_a_file_where_a_folder_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError), atomic_write(tmp_path / "file" / "a.trc"):
        pytest.fail("the block must not run")


@pytest.mark.skipif(sys.platform == "win32", reason="no file size limits")
def test_a_write_that_does_not_fit_leaves_nothing(tmp_path: Path) -> None:
    """A file size limit stands in for the full disk: the same OSError from the same system call."""
    script = (
        "import resource, sys\n"
        "from handsim.files.outputs import atomic_write\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n"
        "    with atomic_write(sys.argv[1]) as temporary:\n"
        "        temporary.write_bytes(bytes(5000))\n"
        "except OSError as error:\n"
        "    print(type(error).__name__)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "a.trc")], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "OSError"
    assert entries(tmp_path) == []


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


def test_one_file_that_is_replaced_outlives_a_signal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a.trc", "old")
    fails_at(monkeypatch, 0, signal.SIGINT)
    with pytest.raises(Stopped), signals_raise():
        write(tmp_path / "a.trc", "new")
    assert contents(tmp_path) == {"a.trc": "new"}


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
    done = subprocess.run([sys.executable, "-c", script, *map(str, files)], check=False)
    assert done.returncode == -signal.SIGKILL
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
