"""The README's script runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_script_runs_and_mostly_agrees_with_the_truth():
    script = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    assert script is not None
    done = subprocess.run(
        [sys.executable, "-c", script[1]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    labels, truth = (list(map(int, re.findall(r"-?\d+", row))) for row in done.stdout.split("]")[:2])
    assert len(labels) == len(truth) >= 14
    assert sum(a == b for a, b in zip(labels, truth, strict=True)) > 0.8 * len(truth)
