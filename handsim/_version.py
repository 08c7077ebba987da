"""The version of this copy of handsim: the release and, between two releases, the commit.

A wheel and a source archive hold it as a file, which `handsim._building` writes.
"""

from __future__ import annotations

import datetime
import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

BAKED: Final = "version.txt"


@functools.cache
def full_version() -> str:
    """The version that files, pages and `handsim --version` state, such as "0.2.0+12.g5e3e440.dirty"."""
    release: str = sys.modules["handsim"].__version__
    return describe(Path(__file__).parent, release)


def provenance() -> dict[str, str]:
    """The version and the date, as results record them."""
    return {"handsim": full_version(), "date": datetime.date.today().isoformat()}


def describe(package: Path, release: str) -> str:
    """The version of a package's folder: baked, else by git; the mere release without both.

    The part after "+" is missing at the commit with the release's tag. Elsewhere it holds the number of
    commits since that tag, the commit, and "dirty" if files differ from it.
    """
    baked, checkout = package / BAKED, package.parent
    if baked.is_file():
        return baked.read_text("utf-8").strip()
    if not (checkout / ".git").exists():  # as in site-packages, even within a repository of the user's
        return release
    tag = f"v{release}"
    options = ("--always", "--tags", "--long", "--dirty", "--match", tag)
    command = ["git", "-C", str(checkout), "describe", *options]
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    try:
        output = subprocess.run(command, capture_output=True, text=True, env=own, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return release
    described = output.strip()
    # If no ancestor has the tag, git prints the hash of the commit alone.
    local = described.removeprefix(f"{tag}-") if described.startswith(tag) else f"g{described}"
    is_release = local.startswith("0-") and not local.endswith("-dirty")
    return release if is_release else f"{release}+{local.replace('-', '.')}"
