"""Write track/benchmark/published.json: the checksums that `handsim benchmark make` compares its files with.

    python benchmarks/publish_benchmark.py [OUT]

Makes every size in OUT (a temporary folder when not given), or checks what is there again. Only for a new
version of the benchmark: results of a version are comparable because its files do not change.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from handsim.files.atomic import atomic_write
from track.benchmark.difficulties import BENCHMARK, SIZES
from track.benchmark.making import make_benchmark
from track.benchmark.manifest import PUBLISHED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path)
    out = parser.parse_args().out
    with tempfile.TemporaryDirectory() as temporary:
        folder = out or Path(temporary)
        files = {size: make_benchmark(plan, folder / size).files for size, plan in SIZES.items()}
    with atomic_write(PUBLISHED) as path:
        path.write_text(json.dumps({"benchmark": BENCHMARK, "files": files}, indent=1) + "\n", "utf-8")
    print(f"{PUBLISHED}: {', '.join(f'{len(names)} files of {size}' for size, names in files.items())}")


if __name__ == "__main__":
    main()
