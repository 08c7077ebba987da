"""From a glove of ten markers, nothing but a TOML file, to a labeler: three commands, timed and measured.

python -m benchmarks.new_layout [--frames 170330] [--samples 800000]
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

from benchmarks.record import describe, report, run
from handsim.cli.main import main as handsim

GLOVE = Path(__file__).parents[1] / "examples" / "ten_markers.toml"


def main(frames: int = 170_330, samples: int = 800_000, save: str | None = None) -> None:
    print(describe("torch", "mujoco"))
    with tempfile.TemporaryDirectory() as folder:
        data, run = Path(folder) / "data", Path(folder) / "run"
        commands = (
            ["glove", "check", str(GLOVE), "--out", str(Path(folder) / "glove.png")],
            ["generate", "--glove", str(GLOVE), "--num-frames", str(frames), "--out", str(data)],
            ["train", str(data), "--samples", str(samples), "--out", str(run)],
        )
        begin = time.perf_counter()
        for command in commands:
            start = time.perf_counter()
            assert handsim(command) == 0
            print(f"handsim {command[0]}: {time.perf_counter() - start:.0f} s")
        total = time.perf_counter() - begin
        figures = json.loads((run / "labeler.json").read_text())["held_out_simulated"]
    for name, held_out in figures.items():
        print(f"held-out frames, {name}: {100 * held_out['slot_accuracy']:.2f} % of slots right")
    corrupted = list(figures.values())[-1]["slot_accuracy"]
    clean = next(iter(figures.values()))["slot_accuracy"]
    kept = {
        "corrupted": ("ten markers: slots right with two drops and two ghosts [%]", 100 * corrupted),
        "clean": ("ten markers: slots right on clean frames [%]", 100 * clean),
        "minutes": ("minutes from the TOML file to the trained labeler", total / 60),
    }
    report(save, kept)


if __name__ == "__main__":
    run(main, __doc__)
