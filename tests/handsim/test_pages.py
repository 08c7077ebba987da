"""`write_page` finds the page of a thing."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import Take, load_layout
from gloves.fit import nominal_fit
from handsim import join_qpos, write_page
from handsim.errors import ArgumentError
from handsim.pages import Section, write_sections
from tests.programs import run_python

BROKEN = "font.size: 3\n# \xe9\n"
ODD = "font.size: 30\nlines.linewidth: 9\ntext.usetex: True\nsvg.fonttype: none\nbackend: nonsense\n"


DRAWN = """
from handsim.pages import picture
def drawn():
    return picture((4, 3), lambda figure: figure.subplots().set_title("title $x$"))
"""


def drawn_here():
    names = {}
    exec(DRAWN, names)
    return names["drawn"]()


def test_a_take_has_a_page_and_tables(tmp_path):
    hand = nominal_fit(load_layout("sparse13"), "M", "right")
    take = Take.of_poses([hand], join_qpos(np.zeros((30, 20)))[:, None], rate=60.0)
    write_page(tmp_path / "page.html", take)
    assert "<html" in (tmp_path / "page.html").read_text("utf-8")
    assert {path.suffix for path in tmp_path.iterdir()} == {".html", ".csv"}


def test_what_has_no_page_is_told(tmp_path):
    with pytest.raises(ArgumentError, match="thing is 5, expected a Take, a Dataset"):
        write_page(tmp_path / "page.html", 5)
    with pytest.raises(ArgumentError, match=r"page\.pdf, expected a file name that ends in \.html"):
        write_page(tmp_path / "page.pdf", 5)
    assert not list(tmp_path.iterdir())


def test_a_page_escapes_what_it_shows(tmp_path):
    table, pictures = [["<i>"], ["1"]], [("x.png", 'a "b" & c')]
    section = Section("a < b", "text", pictures=pictures, table=table, notes=["<n>"])
    write_sections(tmp_path / "index.html", [section], title="<title>", lead="x & y")
    page = (tmp_path / "index.html").read_text("utf-8")
    for shown in (
        "<title>&lt;title&gt;</title>",
        "x &amp; y</p>",
        "a &lt; b",
        "<th>&lt;i&gt;</th>",
        "&lt;n&gt;",
    ):
        assert shown in page
    assert 'alt="a &quot;b&quot; &amp; c"' in page and "http" not in page


@pytest.mark.parametrize(
    ("files", "variables"),
    [
        ({}, {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}),
        ({}, {"MPLBACKEND": "nonsense"}),
        ({}, {"MPLBACKEND": "TkAgg"}),
        ({"matplotlibrc": BROKEN}, {"MPLBACKEND": "nonsense"}),
        ({"mine/matplotlibrc": BROKEN}, {"MATPLOTLIBRC": "mine"}),
        ({"mine/matplotlibrc": BROKEN}, {"MPLCONFIGDIR": "mine"}),
        ({"mine/stylelib/own.mplstyle": BROKEN}, {"MPLCONFIGDIR": "mine"}),
        ({"matplotlibrc": ODD}, {}),
        ({}, {"MPLCONFIGDIR": "/proc/nowhere"}),
    ],
)
def test_pictures_are_the_same_whatever_the_users_matplotlib_is(files, variables, tmp_path):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, "latin-1")
    done = run_python(f"{DRAWN}print(drawn())", folder=tmp_path, **variables)
    assert done.stdout.strip() == drawn_here()


def test_the_users_own_settings_stay(monkeypatch):
    import matplotlib

    monkeypatch.setitem(matplotlib.rcParams, "font.size", 33.0)
    before = dict(matplotlib.rcParams)
    drawn_here()
    assert dict(matplotlib.rcParams) == before
