"""The scripts in the documents run as they stand and print what the documents say."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_room_script_prints_what_its_page_says():
    page = (ROOT / "docs" / "room.md").read_text(encoding="utf-8")
    match = re.search(r"```python\n(.*?)```\s+prints\s+```\n(.*?)```", page, re.S)
    assert match is not None
    done = subprocess.run(
        [sys.executable, "-c", match[1]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said, printed = (
        re.findall(r"(\w+): ([\d.]+) %[^,]*, ([\d.]+)", text) for text in (match[2], done.stdout)
    )
    assert [row[0] for row in said] == [row[0] for row in printed] == ["figure5", "six"]
    for (_, missing, ghosts), (_, ours, our_ghosts) in zip(said, printed, strict=True):
        assert abs(float(missing) - float(ours)) < 2.0  # the last digits hang on the machine
        assert abs(float(ghosts) - float(our_ghosts)) < 0.2
