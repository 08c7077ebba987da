"""A small training set, and what a folder or a store holds."""

from __future__ import annotations

from pathlib import Path

from upath import UPath

from handsim.files.inputs import checksum
from train import GenerateSettings, SceneMix

ROWS = 100
ALONE = SceneMix(alone=1.0, together=0.0, holding=0.0)
CONFIG = GenerateSettings(num_frames=4 * ROWS - 30, seed=5, frames_per_hand=50, scenes=ALONE)


def contents(folder: Path) -> dict[str, str]:
    """Checksums of all files, hidden ones too."""
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: checksum(path) for name, path in files.items()}


def names(store: UPath) -> set[str]:
    """Names of all that a store's folder holds."""
    return {path.path.removeprefix(store.path + "/") for path in store.rglob("*") if path.is_file()}


def copied(store: UPath, folder: Path) -> dict[str, str]:
    """The same as `contents` of what a store holds, copied into a folder."""
    for name in names(store):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((store / name).read_bytes())
    return contents(folder)


def write_three(folder: Path, number: int) -> int:
    (folder / "part").mkdir()
    for name in ("a", "part/b", "part/c"):
        (folder / f"{name}-{number}").write_text(name * number)
    return number
