"""Cases one after the other: only a `HandSimError` may escape, within five seconds and 500 MB.

Its sentence, and that of a warning, has 500 characters at most, and nothing is printed.
"""

from __future__ import annotations

import contextlib
import io
import resource
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from handsim import HandSimError
from tests.fuzzing.mutations import mutate

CORPUS: Final = Path(__file__).parent / "corpus"
MOST_SECONDS: Final = 5.0  # of computing, which other programs on the machine do not lengthen
MOST_MEGABYTES: Final = 500.0
MOST_CHARACTERS: Final = 500
_SCREEN: Final = 200  # characters of a message that is shown


@dataclass(frozen=True)
class Target:
    """A reader and the valid files that it starts from."""

    name: str
    seeds: Callable[[Path], list[Path]]
    """Writes the valid files into a folder, and names those of them that are to be damaged."""
    read: Callable[[Path], object]
    """Reads the damaged file, which lies among the other valid ones."""
    mutate: Callable[[bytes, np.random.Generator], bytes] = mutate
    refusals: tuple[type[Exception], ...] = (HandSimError,)
    """Errors that a damaged file may end in."""


@dataclass(frozen=True)
class Failure:
    """A case that broke the rule."""

    target: str
    file: str
    """Name of the damaged file."""
    data: bytes
    what: str


def run(target: Target, folder: Path, *, cases: int, seed: int) -> Iterator[Failure | None]:
    """Damage the valid files of a target again and again; None for each case that is as it should be."""
    files = target.seeds(folder)
    contents = [file.read_bytes() for file in files]
    for file in files:
        target.read(file)  # they are valid, and whatever loads at first use is loaded
    for number in range(cases):
        rng = np.random.default_rng((seed, number))
        chosen = int(rng.integers(len(files)))
        data = target.mutate(contents[chosen], rng)
        yield run_case(target, files[chosen], data)
        for file, content in zip(files, contents, strict=True):
            file.write_bytes(content)


def run_corpus(target: Target, folder: Path) -> Iterator[Failure | None]:
    """All files that failed once; a file's name is `N-` and the name of the valid file it stands for."""
    files = {file.name: file for file in target.seeds(folder)}
    contents = {name: file.read_bytes() for name, file in files.items()}
    for path in sorted((CORPUS / target.name).glob("*")):
        yield run_case(target, files[path.name.split("-", 1)[1]], path.read_bytes())
        for name, content in contents.items():
            files[name].write_bytes(content)


def run_case(target: Target, file: Path, data: bytes) -> Failure | None:
    """Read one damaged file; what took too long is read again, because kernels are compiled at first use."""
    file.write_bytes(data)
    what, seconds, grown = _read(target, file)
    if what is None and seconds > MOST_SECONDS:
        file.write_bytes(data)
        what, seconds, _ = _read(target, file)
    if what is None and seconds > MOST_SECONDS:
        what = f"took {seconds:.1f} s"
    if what is None and grown > MOST_MEGABYTES:
        what = f"took {grown:.0f} MB"
    return None if what is None else Failure(target.name, file.name, data, what)


def _read(target: Target, file: Path) -> tuple[str | None, float, float]:
    """What escaped, if anything; the seconds, and the megabytes by which the largest memory grew."""
    memory, began = _peak_megabytes(), time.process_time()
    what = None
    try:
        with (
            warnings.catch_warnings(record=True) as told,
            contextlib.redirect_stderr(io.StringIO()),
            contextlib.redirect_stdout(io.StringIO()) as printed,
        ):
            warnings.simplefilter("always")
            target.read(file)
        what = next((_fault(str(one.message)) for one in told), None)
    except target.refusals as error:
        what = _fault(str(error))
    except Exception:
        what = traceback.format_exc().strip()
    if what is None and printed.getvalue():
        what = f"printed {printed.getvalue()[:_SCREEN]!r}"
    return what, time.process_time() - began, _peak_megabytes() - memory


def _fault(sentence: str) -> str | None:
    """What is wrong with a sentence, if anything is."""
    if not sentence.strip() or "\n" in sentence:
        return f"not one sentence: {sentence[:_SCREEN]!r}"
    return f"a sentence of {len(sentence)} characters" if len(sentence) > MOST_CHARACTERS else None


def keep(failure: Failure, folder: Path) -> Path:
    """Write a failed case in the corpus's form."""
    place = folder / failure.target
    place.mkdir(parents=True, exist_ok=True)
    path = place / f"{len(list(place.glob('*')))}-{failure.file}"
    path.write_bytes(failure.data)
    return path


def limit_memory(megabytes: int) -> None:
    """Let allocations fail before the machine is out of memory."""
    if sys.platform == "linux":
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (used + (megabytes << 20), hard))


def _peak_megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
