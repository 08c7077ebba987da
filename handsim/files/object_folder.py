"""A folder of an object store, as fsspec reaches it: objects are put whole, a listing tells them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

from handsim._extras import import_extra
from handsim.errors import ArgumentError, HandSimError

_EXTRA: Final = "object-stores"
_PROTOCOL: Final = re.compile(r"[a-z][a-z0-9+.-]*")
_PASSWORD: Final = re.compile(r"[^/@]*:[^/]*@")
_HERE: Final = ("file", "local")
_AGAIN: Final = "what is there stays, and the same command goes on after it"


@dataclass(frozen=True, slots=True)
class ObjectFolder:
    """Objects whose names begin alike: `s3://bucket/prefix`, or another address of fsspec.

    Credentials are not part of it: each process takes its own from its environment.
    """

    address: str
    """Protocol, bucket and prefix."""

    def __post_init__(self) -> None:
        protocol, separator, path = self.address.partition("://")
        if not separator or not _PROTOCOL.fullmatch(protocol) or not path.strip("/"):
            raise ArgumentError(
                f"the address is '{self.address[:200]}', expected one like s3://bucket/prefix"
            )
        if _PASSWORD.match(path):  # it would be in messages, and be sent to workers
            raise ArgumentError(
                f"the {protocol}:// address holds a password; credentials come from the environment"
            )
        if protocol in _HERE:
            raise ArgumentError(f"the address is '{self.address[:200]}', expected the folder's path alone")
        if "::" in self.address or ".." in path.split("/"):
            raise ArgumentError(f"the address is '{self.address[:200]}', expected one without :: and ..")
        object.__setattr__(self, "address", self.address.rstrip("/"))

    def __str__(self) -> str:
        return self.address

    def check(self) -> None:
        """Load what the protocol needs.

        Raises:
            ArgumentError: fsspec, or its package for this protocol, is not installed.
            HandSimError: The store cannot be reached like this.
        """
        self._opened()

    def sizes(self) -> dict[str, int]:
        """Names of all objects in the folder, without its own, and their lengths [bytes].

        Raises:
            HandSimError: The store does not answer or refuses.
        """
        system, start = self._opened()
        with self._one_sentence("listing"):
            system.invalidate_cache()  # other machines write there too
            try:
                found = system.find(start, detail=True)
            except FileNotFoundError:
                return {}
        prefix = start.rstrip("/") + "/"
        names = {path.removeprefix(prefix): about for path, about in found.items() if path.startswith(prefix)}
        return {name: int(about["size"]) for name, about in names.items() if _is_inside(name)}

    def put(self, folder: Path, names: Collection[str]) -> None:
        """Put files of a folder; each object is there with all its bytes, or as it was before.

        Raises:
            HandSimError: The store does not take them.
        """
        self._transfer("put", "writing", {str(folder / name): self._name(name) for name in names})

    def get(self, names: Collection[str], folder: Path) -> None:
        """Copy objects into a folder.

        Raises:
            HandSimError: The store does not give them.
        """
        for name in names:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
        self._transfer("get", "reading", {self._name(name): str(folder / name) for name in names})

    def remove(self, name: str) -> None:
        """Remove an object.

        Raises:
            HandSimError: The store refuses.
        """
        system, _ = self._opened()
        with self._one_sentence("removing"):
            system.rm_file(self._name(name))

    def _transfer(self, method: str, doing: str, pairs: dict[str, str]) -> None:
        if pairs:
            system, _ = self._opened()
            with self._one_sentence(doing):
                getattr(system, method)(list(pairs), list(pairs.values()))

    def _name(self, name: str) -> str:
        """The full name of an object, as its file system has it."""
        return f"{self._opened()[1].rstrip('/')}/{name}"

    def _opened(self) -> tuple[Any, str]:
        """The file system, which fsspec keeps, and the folder's path in it."""
        core = import_extra("fsspec.core", self.address, _EXTRA)
        try:
            with self._one_sentence("opening"):
                system, path = core.url_to_fs(self.address)
        except ImportError as error:
            raise ArgumentError(
                f"{self.address} needs a package that cannot be imported ({' '.join(str(error).split())}); "
                f"for s3:// run `pip install 'handsim[{_EXTRA}]'`"
            ) from error
        return system, path

    @contextmanager
    def _one_sentence(self, doing: str) -> Iterator[None]:
        """Tell trouble with the store in one sentence: each protocol has errors of its own."""
        try:
            yield
        except ImportError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise HandSimError(f"{self.address}: {doing} failed: {reason}; {_AGAIN}") from error


def folder_or_objects(text: str) -> Path | ObjectFolder:
    """What an option names: a folder, or a folder of an object store, whose address has `://`.

    Raises:
        ArgumentError: It is an address, but none of an object store.
    """
    return ObjectFolder(text) if "://" in text else Path(text)


def _is_inside(name: str) -> bool:
    """Whether an object's name is that of a file in a folder."""
    parts = PurePosixPath(name).parts
    return bool(parts) and "/".join(parts) == name and not {"..", "/"} & set(parts)
