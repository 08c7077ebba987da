from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import pytest

from handsim.cli.main import main


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href")]


@pytest.mark.slow
def test_demo_leaves_a_page_with_its_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from train.labelers.storage import shipped_labelers

    if "dense19" not in shipped_labelers():
        pytest.skip("no labeler is shipped")
    assert main(["demo", "--out", str(tmp_path / "demo"), "--num-frames", "60"]) == 0
    out = capsys.readouterr().out
    assert "Slot accuracy" in out
    assert str(tmp_path / "demo" / "index.html") in out
    page = (tmp_path / "demo" / "index.html").read_text("utf-8")
    links = Links()
    links.feed(page)
    pictures = sorted(path.name for path in (tmp_path / "demo").iterdir() if path.name != "index.html")
    assert sorted(set(links.found)) == pictures
    assert all(name.endswith(".png") for name in pictures)  # and no leftover of the run
    for name in pictures:
        assert cv2.imread(str(tmp_path / "demo" / name)).std() > 5, name
    accuracy = re.search(r"Slot accuracy</td><td>([\d.]+)</td><td>([\d.]+)", page)
    assert accuracy is not None
    clean, occluded = map(float, accuracy.groups())
    assert clean > 90
    assert occluded > 75
