"""Names of files, which need not be text: on Linux they are any bytes."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

_REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"


def as_text(name: str) -> str:
    """A file's name as a line of text, with a replacement character for what is not printable."""
    return "".join(one if one.isprintable() else _REPLACEMENT for one in name)


@contextmanager
def plain_path(path: Path) -> Iterator[Path]:
    """The path, or where it is not UTF-8 a link to it whose path is: some libraries take no other.

    The file need not exist: what is written to the link is written to the file.

    Raises:
        OSError: The link cannot be made.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / f"link{as_text(path.suffix)}"
            link.symlink_to(path.absolute())
            yield link
            if not link.is_symlink():  # some writers replace what is there
                shutil.copyfile(link, path)
    else:
        yield path
