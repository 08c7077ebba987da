"""Steps of setuptools that pack handsim: they add the version, and archives repeat byte by byte.

setuptools runs this file alone, without the package.
"""

from __future__ import annotations

import os
import runpy
import tarfile
import time
from gzip import GzipFile
from pathlib import Path
from typing import Any, Final

from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

_HERE: Final = Path(__file__).parent
_VERSION: Final = runpy.run_path(str(_HERE / "_version.py"))


def _bake(package: Path, release: str) -> None:
    """Write the version into the copy of the package that is packed."""
    (package / _VERSION["BAKED"]).write_text(_VERSION["describe"](_HERE, release) + "\n", "utf-8")


class BuildPackages(build_py):  # type: ignore[misc]  # setuptools has no types
    """Copies the packages for a wheel."""

    def run(self) -> None:
        """Copy the packages and add the version, but not to an editable installation."""
        super().run()
        if not self.editable_mode:
            _bake(Path(self.build_lib) / _HERE.name, self.distribution.get_version())


class SourceArchive(sdist):  # type: ignore[misc]
    """Packs the sources; files have the time SOURCE_DATE_EPOCH, if that is set, and no owner."""

    def make_release_tree(self, base_dir: str, files: Any) -> None:
        """Copy the files to pack, and add the version."""
        super().make_release_tree(base_dir, files)
        _bake(Path(base_dir) / _HERE.name, self.distribution.get_version())

    def make_archive(self, base_name: Any, format: str, *_: Any, base_dir: Any = None, **__: Any) -> str:
        """Write the .tar.gz, its files in order of their names."""
        path, now = f"{base_name}.tar.gz", int(os.environ.get("SOURCE_DATE_EPOCH", time.time()))

        def plain(member: tarfile.TarInfo) -> tarfile.TarInfo:
            member.mtime, member.uid, member.gid, member.uname, member.gname = now, 0, 0, "", ""
            member.mode = 0o755 if member.isdir() or member.mode & 0o100 else 0o644
            return member

        with open(path, "wb") as raw, GzipFile("", "wb", fileobj=raw, mtime=now) as packed:
            with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
                archive.add(base_dir, filter=plain)  # adds the files of a folder sorted by their names
        return path
