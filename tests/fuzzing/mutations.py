"""Seeded damage to bytes: flips, cuts, insertions, copies, and numbers swapped for extremes."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from typing import Final

import numpy as np

_NUMBER: Final = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_TEXTS: Final = (
    b"nan", b"inf", b"-inf", b"NaN", b"-Infinity", b"1e308", b"-1e308", b"1e-320", b"0", b"-1", b"-0.0", b"1",
    b"2147483648", b"18446744073709551616", b"1" * 400, b"1" * 5000, b"", b"null", b"true", b"[]", b"{}",
    b'"x"',
    b"'", b'"', b"\xff\xfe", b"\0", b"\n", b"\t\t\t", b",,,,",
)  # fmt: skip
_LONG: Final = (b"[", b"{", b"(", b'{"a":', b"[[", b"a.", b"\t", b",", b"\n", b"1\n", b"0\t", b"A", b"\0")
_WORDS: Final = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
_FLOATS: Final = (np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -0.0)
_LARGEST: Final = 10_000_000

Mutation = Callable[[bytearray, np.random.Generator], None]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage bytes one to six times."""
    damaged = bytearray(data)
    for _ in range(int(rng.integers(1, 7))):
        _KINDS[int(rng.integers(len(_KINDS)))](damaged, rng)
    return bytes(damaged[:_LARGEST])


def mutate_archive(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a zip archive: as a whole, or one of its members, whose checksum is then right."""
    if rng.random() < 0.2:
        return mutate(data, rng)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {member.filename: archive.read(member) for member in archive.infolist()}
    except Exception:  # damaged before, in one of the many ways of zipfile
        return mutate(data, rng)
    if not members:
        return mutate(data, rng)
    name = sorted(members)[int(rng.integers(len(members)))]
    if rng.random() < 0.05:
        del members[name]
    else:
        members[name] = mutate(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return out.getvalue()


def _place(data: bytearray, rng: np.random.Generator) -> int:
    """A place anywhere, half of the time near the beginning, where the headers are."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 600)
    return int(rng.integers(end + 1))


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 9))):
        place = _place(data, rng)
        if place < len(data):
            data[place] ^= 1 << int(rng.integers(8))


def _overwrite(data: bytearray, rng: np.random.Generator) -> None:
    place, size = _place(data, rng), int(rng.integers(1, 9))
    data[place : place + size] = rng.bytes(size)


def _truncate(data: bytearray, rng: np.random.Generator) -> None:
    del data[_place(data, rng) :]


def _insert(data: bytearray, rng: np.random.Generator) -> None:
    place = _place(data, rng)
    data[place:place] = rng.bytes(int(rng.integers(1, 40)))


def _delete(data: bytearray, rng: np.random.Generator) -> None:
    place = _place(data, rng)
    del data[place : place + int(rng.integers(1, 200))]


def _duplicate(data: bytearray, rng: np.random.Generator) -> None:
    begin, size, place = _place(data, rng), int(rng.integers(1, 2000)), _place(data, rng)
    data[place:place] = bytes(data[begin : begin + size]) * int(rng.integers(1, 4))


def _swap_number(data: bytearray, rng: np.random.Generator) -> None:
    begin = _place(data, rng)
    found = _NUMBER.search(data, begin, begin + 4000) or _NUMBER.search(data, 0, 4000)
    if found is not None:
        data[found.start() : found.end()] = _TEXTS[int(rng.integers(len(_TEXTS)))]


def _swap_word(data: bytearray, rng: np.random.Generator) -> None:
    size = (1, 2, 4, 8)[int(rng.integers(4))]
    place = _place(data, rng) // size * size
    if size >= 4 and rng.random() < 0.5:
        value = np.array(_FLOATS[int(rng.integers(len(_FLOATS)))], f"<f{size}").tobytes()
    else:
        number = _WORDS[int(rng.integers(len(_WORDS)))] % (1 << (8 * size))
        value = number.to_bytes(size, "little" if rng.random() < 0.8 else "big")
    data[place : place + size] = value


def _swap_text(data: bytearray, rng: np.random.Generator) -> None:
    place = _place(data, rng)
    data[place : place + int(rng.integers(0, 12))] = _TEXTS[int(rng.integers(len(_TEXTS)))]


def _repeat(data: bytearray, rng: np.random.Generator) -> None:
    """Very deep brackets, very many columns or rows; rare, because they take long."""
    if rng.random() < 0.1:
        place = _place(data, rng)
        data[place:place] = _LONG[int(rng.integers(len(_LONG)))] * int(10 ** rng.uniform(2.0, 5.5))


_KINDS: Final[tuple[Mutation, ...]] = (
    _flip, _overwrite, _truncate, _insert, _delete, _duplicate, _swap_number, _swap_number, _swap_word,
    _swap_word, _swap_text, _repeat,
)  # fmt: skip
