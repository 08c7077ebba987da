"""`write_page` finds the page of a thing."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import Take, load_layout
from gloves.fit import nominal_fit
from handsim import join_qpos, write_page
from handsim.errors import ArgumentError
from handsim.pages import Section, write_sections


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
