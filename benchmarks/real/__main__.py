"""Public recordings of real hands: fetch a set from its authors, check its bytes."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from benchmarks.record import run_commands
from handsim.app.messages import print_line
from handsim.errors import FileError, HandSimError, choices
from handsim.files.inputs import checksum

SETS: Final = Path(__file__).with_name("sets.toml")


def fetch(name: Annotated[str, tyro.conf.Positional], out: Path) -> None:
    """Fetch a set of recordings with git into a folder, or check a folder that has it.

    Args:
        name: A set of benchmarks/real/sets.toml, such as sig18.
        out: Folder for the recordings, the DATA of other benchmarks.
    """
    known = recordings()
    if name not in known:
        raise HandSimError(choices(name, known, noun="set of recordings"))
    one = known[name]
    if not out.exists():
        _copy(one, out)
    found = digest(out, one["parts"])
    if found != (one["files"], one["sha256"]):
        raise FileError(
            f"{out} has {found[0]} files of SHA-256 {found[1]}, expected {one['files']} of {one['sha256']}; "
            "remove the folder and run the same command again"
        )
    print_line(f"{out}: {one['what']}; {one['files']} files as published, license {one['license']}")


def recordings() -> dict[str, dict[str, Any]]:
    """All sets by name: address, commit, parts, license and checksum of each."""
    return tomllib.loads(SETS.read_text("utf-8"))


def digest(folder: Path, parts: list[str]) -> tuple[int, str]:
    """Number of files in parts of a folder, and the SHA-256 of the list of their checksums."""
    files = sorted(
        path.relative_to(folder).as_posix()
        for part in parts
        for path in (folder / part).rglob("*")
        if path.is_file()
    )
    lines = "".join(f"{checksum(folder / file)}  {file}\n" for file in files)
    return len(files), hashlib.sha256(lines.encode()).hexdigest()


def _copy(one: dict[str, Any], out: Path) -> None:
    """Clone one commit of an address, without files that are not wanted, and keep its parts."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".fetched-") as made:
        clone = Path(made) / "clone"
        paths = [f"{one['folder']}/{part}" for part in one["parts"]]
        for words in (
            ["clone", "--quiet", "--no-checkout", "--filter=blob:none", one["address"], str(clone)],
            ["-C", str(clone), "sparse-checkout", "set", *paths],
            ["-C", str(clone), "checkout", "--quiet", one["commit"]],
        ):
            done = subprocess.run(["git", *words], capture_output=True, text=True, check=False)
            if done.returncode:
                raise FileError(f"git found no {one['address']}: {' '.join(done.stderr.split())}")
        shutil.move(clone / one["folder"], out)


COMMANDS: Final[dict[str, Callable[..., None]]] = {"fetch": fetch}

if __name__ == "__main__":
    sys.exit(run_commands("benchmarks.real", __doc__, COMMANDS))
