"""Files as European labs and Excel write them: every reader gives what it gives for the plain file."""

import csv
import io
import re
from pathlib import Path

import numpy as np
import pytest

from gloves import Capture, read_capture
from handsim.errors import CaptureError
from tests.gloves.captures.test_formats import DEVICES, LABELED, QUOTED, UNLABELED, motive, nexus, qtm, trc

ROWS = [f"{row}\t{row / 119.88:.6f}\t{row}.25\t-0.05\t3.00\t\t\t" for row in range(4)]
PLAIN = {
    "motive": ("take.csv", motive(LABELED, UNLABELED, QUOTED)),
    "motive with time codes": ("take.csv", motive(LABELED, UNLABELED, timecode=True)),
    "vicon": ("take.csv", DEVICES + nexus(rate="119.88")),
    "qualisys": ("take.tsv", qtm(frequency="99.5", names=("a", "b"))),
    "qualisys without columns": ("take.tsv", qtm(columns=False, leading=False)),
    "trc": ("take.trc", trc(*ROWS, rate="119.88").decode()),
}


def rewritten(text: str, separator: str, *, quoted: bool = False, commas: bool = False) -> str:
    """The file with other separators, quotes and decimals, and rows of one length, as from a table."""
    rows = list(csv.reader(text.splitlines(), delimiter="\t" if "\t" in text else ","))
    width = max(map(len, rows))
    out = io.StringIO()
    writer = csv.writer(out, delimiter=separator, quoting=csv.QUOTE_ALL if quoted else csv.QUOTE_MINIMAL)
    for row in rows:
        cells = [re.sub(r"^(-?\d+)\.(\d+)$", r"\1,\2", cell) if commas else cell for cell in row]
        writer.writerow(cells + [""] * (width - len(cells)))
    return out.getvalue()


def same(path: Path, data: bytes, plain: Capture) -> None:
    path.write_bytes(data)
    read = read_capture(path)
    assert (read.names, read.rate) == (plain.names, plain.rate)
    np.testing.assert_array_equal(read.positions, plain.positions)


@pytest.fixture(params=PLAIN)
def plain(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str, Capture]:
    name, text = PLAIN[request.param]
    (tmp_path / name).write_text(text)
    return tmp_path / name, text, read_capture(tmp_path / name)


@pytest.mark.parametrize("quoted", [False, True])
@pytest.mark.parametrize(("separator", "commas"), [(";", True), ("\t", True), (";", False), (",", False)])
def test_other_separators_and_decimal_commas(
    plain: tuple[Path, str, Capture], separator: str, commas: bool, quoted: bool
) -> None:
    path, text, expected = plain
    same(path, rewritten(text, separator, quoted=quoted, commas=commas).encode(), expected)


def test_commas_for_decimals_and_between_quoted_cells(plain: tuple[Path, str, Capture]) -> None:
    path, text, expected = plain
    same(path, rewritten(text, ",", quoted=True, commas=True).encode(), expected)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_encodings_of_excel(plain: tuple[Path, str, Capture], encoding: str) -> None:
    path, text, expected = plain
    bom = "\ufeff" if encoding == "utf-16-be" else ""
    same(path, (bom + rewritten(text, "\t", commas=True)).encode(encoding), expected)


def test_commas_for_decimals_and_between_cells_are_refused(plain: tuple[Path, str, Capture]) -> None:
    path, text, _ = plain
    if path.suffix == ".tsv":
        pytest.skip("Qualisys writes tabs")
    rows = csv.reader(text.splitlines(), delimiter="\t" if "\t" in text else ",")
    decimal = [[re.sub(r"^(-?\d+)\.(\d+)$", r"\1,\2", cell) for cell in row] for row in rows]
    path.write_text("\n".join(",".join(row) for row in decimal) + "\n")
    with pytest.raises(CaptureError, match="commas are both between cells and in numbers"):
        read_capture(path)


def test_the_word_null_is_a_gap(tmp_path: Path) -> None:
    text = qtm().replace("10.500\t11.500\t12.500", "NULL\tNULL\tNULL")
    (tmp_path / "take.tsv").write_text(text)
    assert np.isnan(read_capture(tmp_path / "take.tsv").positions[1, 0]).all()
    (tmp_path / "take.tsv").write_text(qtm(columns=False, leading=False).replace("0.500\t", "NULL\t", 1))
    assert np.isnan(read_capture(tmp_path / "take.tsv").positions[0, 0, 0])


def test_names_of_windows(tmp_path: Path) -> None:
    path = tmp_path / "take.tsv"
    path.write_bytes(qtm(names=("Zeigefingerspitze ü", "Fuß")).encode("cp1252"))
    assert read_capture(path).names == ("Zeigefingerspitze ü", "Fuß")


@pytest.mark.parametrize(
    "cell", ["-1.#IND00", "1.#QNAN0", "1.#IND", "-1.#QNAN", "nan(ind)", "-nan(ind)", "NAN(SNAN)", "N/A", "--"]
)
def test_what_programs_write_for_no_number_is_a_gap(tmp_path: Path, cell: str) -> None:
    (tmp_path / "take.tsv").write_text(qtm().replace("10.500\t", f"{cell}\t"))
    assert np.isnan(read_capture(tmp_path / "take.tsv").positions[1, 0]).all()


@pytest.mark.parametrize("cell", ["1_0.500", "10_500", "1_000"])
def test_numbers_of_python_alone_are_refused(tmp_path: Path, cell: str) -> None:
    (tmp_path / "take.tsv").write_text(qtm().replace("10.500\t", f"{cell}\t"))
    with pytest.raises(CaptureError, match=f"'{cell}' is not a number"):
        read_capture(tmp_path / "take.tsv")
