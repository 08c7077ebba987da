"""`python -m tests.fuzzing.coverage`: damaged files that lead each reader where none has led it yet.

Needs atheris (`pip install atheris`), which keeps the files that reach new branches and damages them further.
Each target runs in a process of its own, beginning with its valid files and those that failed once.
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import atheris
import numpy as np

_PACKAGES: Final = ["film", "handsim", "gloves", "poses", "render", "track", "train"]
_ENVIRONMENT: Final = os.environ | {"NUMBA_DISABLE_JIT": "1"}  # numba cannot compile what is instrumented
_HERE: Final = "--here"  # in the process that fuzzes a target, whose imports are instrumented

with atheris.instrument_imports(include=_PACKAGES) if _HERE in sys.argv else nullcontext():
    from tests.fuzzing.engine import CORPUS, keep, limit_memory, run_case
    from tests.fuzzing.targets import TARGETS

_LONGEST: Final = 1 << 20  # bytes of a damaged file
_OWN: Final = 0.5  # share of the damage that is done by the target's own mutations


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing.coverage", description=__doc__)
    parser.add_argument("--seconds", type=int, default=600, help="of each target")
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="all when not given")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="folder for files that fail")
    parser.add_argument(_HERE, action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        fuzz(options.target[0], options.seconds, options.keep)
    failed = []
    for name in options.target or TARGETS:
        command = [sys.executable, "-m", "tests.fuzzing.coverage", _HERE, "--target", name]
        command += ["--seconds", str(options.seconds), "--keep", str(options.keep)]
        done = subprocess.run(
            command,
            env=_ENVIRONMENT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            failed.append(name)
            print("\n".join(line for line in done.stdout.splitlines()[-60:] if not line.startswith("INFO")))
        told = [line for line in done.stdout.splitlines() if "cov:" in line or line.startswith("Done")]
        print(f"{name}: {'failed' if done.returncode else '0 failed'}; {' '.join(told[-2:])}", flush=True)
    return int(bool(failed))


def fuzz(name: str, seconds: int, kept: Path) -> None:
    """Fuzz one target and end the process: with 0, or with another code after the first failure.

    Args:
        name: The target.
        seconds: For how long.
        kept: Folder for the file that fails.
    """
    target = TARGETS[name]
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as corpus:
        files = target.seeds(Path(folder))
        contents = [file.read_bytes() for file in files]
        numbers = {file.name: number for number, file in enumerate(files)}
        for number, content in enumerate(contents):
            (Path(corpus) / f"valid-{number}").write_bytes(bytes([number]) + content)
        for path in (CORPUS / name).glob("*"):
            number = numbers[path.name.split("-", 1)[1]]
            (Path(corpus) / path.name).write_bytes(bytes([number]) + path.read_bytes())
        limit_memory(4000)

        def read(data: bytes) -> None:
            """Read a file; its first byte says which of the valid ones it stands for."""
            if not data:
                return
            number = data[0] % len(files)
            failure = run_case(target, files[number], data[1:])
            files[number].write_bytes(contents[number])
            if failure is not None:
                raise RuntimeError(f"{failure.what}\nkept as {keep(failure, kept)}")

        def damage(data: bytes, most: int, seed: int) -> bytes:
            """The target's own damage, or atheris's."""
            if data and random.Random(seed).random() < _OWN:
                return data[:1] + target.mutate(data[1:], np.random.default_rng(seed))[: most - 1]
            return bytes(atheris.Mutate(data, most))

        arguments = [f"-max_total_time={seconds}", f"-max_len={_LONGEST}", "-rss_limit_mb=0", "-timeout=60"]
        atheris.Setup([sys.argv[0], *arguments, corpus], read, custom_mutator=damage)
        atheris.Fuzz()


if __name__ == "__main__":
    raise SystemExit(main())
