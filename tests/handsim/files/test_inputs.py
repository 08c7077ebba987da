"""Files of others: pipes, devices, archives whose headers lie, and keys of a hundred parts."""

from __future__ import annotations

import io
import os
import tomllib
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gloves import load_layout, load_take, read_capture
from handsim.errors import CaptureError, LayoutError
from handsim.files.arrays import read_npz
from handsim.files.inputs import read_bytes, toml_string


@pytest.mark.parametrize("name", ["take.trc", "take.truth.npz", "glove.toml"])
def test_a_pipe_is_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    read, error = {
        "take.trc": (read_capture, CaptureError),
        "take.truth.npz": (load_take, CaptureError),
        "glove.toml": (load_layout, LayoutError),
    }[name]
    with pytest.raises(error, match="this is a pipe, expected a regular file"):
        read(tmp_path / name)


def test_a_device_through_a_link_is_refused(tmp_path):
    (tmp_path / "take.c3d").symlink_to("/dev/zero")
    with pytest.raises(CaptureError, match="this is a device, expected a regular file"):
        read_capture(tmp_path / "take.c3d")


def test_a_file_that_is_too_long_is_not_read(tmp_path):
    (tmp_path / "long").write_bytes(bytes(11))
    assert len(read_bytes(tmp_path / "long", error=CaptureError, max_bytes=11)) == 11
    with pytest.raises(CaptureError, match="the file is 11 bytes long, expected at most 10"):
        read_bytes(tmp_path / "long", error=CaptureError, max_bytes=10)


def member(shape: tuple[int, ...], descr: str, content: bytes) -> bytes:
    file = io.BytesIO()
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue() + content


@pytest.mark.parametrize(
    "content",
    [
        member((10**12,), "<f8", b""),
        member((2,), "<f8", bytes(8)),
        member((2,), "|O", bytes(16)),
        member((10**9,), "|V0", b""),
        member((2,), "<f8", bytes(16)).replace(b"{", b"("),
    ],
)
def test_arrays_whose_headers_lie_are_refused(tmp_path, content):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("points.npy", content)
    with pytest.raises(ValueError, match="an array"):
        read_npz(tmp_path / "a.npz")


def test_an_archive_of_far_more_bytes_than_its_file_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("points.npy", "w") as file:
            for _ in range(300):
                file.write(bytes(1 << 20))
    with pytest.raises(ValueError, match="1 members of 314572800 bytes, expected at most 268435456 bytes"):
        read_npz(tmp_path / "a.npz")


def test_keys_of_many_parts_are_refused(tmp_path):
    path = tmp_path / "glove.toml"
    path.write_text("a." * 100_000 + "a = 1\n")
    with pytest.raises(LayoutError, match="has too many parts"):
        load_layout(path)
    path.write_bytes(b"#" * 300_000)
    with pytest.raises(LayoutError, match="the file is 300000 bytes long"):
        load_layout(path)


def test_more_cells_than_a_text_file_can_hold_are_refused(tmp_path):
    path = tmp_path / "take.trc"
    names = "a\t\t\t" * 20_000
    header = f"PathFileType\t4\tx\ty\nDataRate\tUnits\n120\tmm\nFrame#\tTime\t{names}\n\t\tX\n"
    path.write_text(header + "1\n" * 20_000)
    with pytest.raises(CaptureError, match="20000 rows of 60002 columns are more than"):
        read_capture(path)


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_any_text_comes_back(text):
    assert tomllib.loads(f"name = {toml_string(text)}")["name"] == text


def test_the_delete_character_is_escaped():
    assert toml_string("a\x7fb") == '"a\\u007Fb"'
