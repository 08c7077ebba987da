"""The script in docs/sensors.md runs as it stands and prints what the page says."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_script_prints_what_its_page_says():
    page = (ROOT / "docs" / "sensors.md").read_text(encoding="utf-8")
    match = re.search(r"```python\n(.*?)```\s+prints\s+```\n(.*?)```", page, re.S)
    assert match is not None
    done = subprocess.run(
        [sys.executable, "-c", match[1]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == match[2]
