"""`python -m tests.fuzzing`: damaged files for every reader; exit code 1 if one broke the rule."""

from __future__ import annotations

import argparse
import collections
import tempfile
import time
from pathlib import Path

from tests.fuzzing.engine import Failure, keep, limit_memory, run, run_corpus
from tests.fuzzing.targets import TARGETS


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing", description=__doc__)
    parser.add_argument("--cases", type=int, default=20_000, help="of each target")
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="all when not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files that failed")
    options = parser.parse_args()
    failed = 0
    for name in options.target or TARGETS:
        kinds: collections.Counter[str] = collections.Counter()
        began, count = time.perf_counter(), 0
        with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
            for failure in run_corpus(TARGETS[name], Path(one)):
                kinds.update(_told(failure, options.keep, kinds))
            cases = run(TARGETS[name], Path(other), cases=options.cases, seed=options.seed)
            for count, failure in enumerate(cases, 1):
                if count == 1:
                    limit_memory(4000)
                kinds.update(_told(failure, options.keep, kinds))
        failed += kinds.total()
        print(
            f"{name}: {count} cases, {kinds.total()} failed, {time.perf_counter() - began:.0f} s", flush=True
        )
    return int(failed > 0)


def _told(failure: Failure | None, folder: Path | None, known: collections.Counter[str]) -> list[str]:
    """The kind of a failure, by the end of its traceback; the first of a kind is printed and kept."""
    if failure is None:
        return []
    lines = failure.what.splitlines()
    kind = next((line for line in reversed(lines) if line.startswith('  File "')), "") + lines[-1][:60]
    if kind not in known:
        print(f"{failure.target}, {failure.file}, {len(failure.data)} bytes:\n{failure.what}\n")
        if folder is not None:
            print(f"kept as {keep(failure, folder)}")
    return [kind]


if __name__ == "__main__":
    raise SystemExit(main())
