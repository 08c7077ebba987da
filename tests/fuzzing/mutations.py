"""Seeded damage to bytes: flips, cuts, insertions, copies, and numbers swapped for extremes.

And to the values in archives and checkpoints, whose form is then right.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

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
_VALUES: Final = (
    None, True, [], {}, "", "x", "A" * 100_000, 0, -1, 1.5, 10**400, -(1 << 70), 1e308, float("nan"), [[]],
    [None], {"": 0}, list(range(1000)),
)  # fmt: skip
_DTYPES: Final = ("<f8", "<f4", "<i8", "|i1", "<u4", "|b1", "<U3", "<c16", "|S2", "<M8[s]")
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)

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


def mutate_take(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage an `.npz` with a JSON header: its bytes, or one to three values of its header and arrays."""
    kind = rng.random()
    if kind < 0.3:
        return mutate_archive(data, rng)
    stored = _stored_arrays(data)
    arrays = {name: array for name, (array, _) in stored.items()}
    for _ in range(int(rng.integers(1, 4))):
        name = sorted(arrays)[int(rng.integers(len(arrays)))]
        if rng.random() < 0.4 and "header" in arrays:
            header = json.loads(str(arrays["header"]))
            arrays["header"] = np.array(json.dumps(_swapped(header, rng)))
        elif name != "header":
            arrays[name] = _damaged_array(arrays[name], rng)
    method = _METHODS[int(rng.integers(len(_METHODS)))]
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, array in arrays.items():
            known, content = stored[name]
            archive.writestr(f"{name}.npy", content if array is known else _npy(array))
    return out.getvalue() if kind < 0.8 else mutate(out.getvalue(), rng)


@lru_cache(maxsize=8)
def _stored_arrays(data: bytes) -> dict[str, tuple[np.ndarray[Any, Any], bytes]]:
    """The arrays of a valid file, which is damaged again and again, and the content of their members."""
    with np.load(io.BytesIO(data)) as stored:
        return {name: (array, _npy(array)) for name, array in stored.items()}


def _npy(array: np.ndarray[Any, Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def mutate_checkpoint(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage what `torch.save` wrote: its bytes, or one to three of its values."""
    if rng.random() < 0.4:
        return mutate_archive(data, rng)
    import torch

    content = torch.load(io.BytesIO(data), weights_only=True)
    for _ in range(int(rng.integers(1, 4))):
        content = _swapped(content, rng, odd=_odd_tensor)
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()


def mutate_tail(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a packet behind the count of its parts, which the client's library believes."""
    return data[:24] + mutate(data[24:], rng)


def _odd_tensor(value: Any, rng: np.random.Generator) -> Any:
    """A tensor like one, but for its shape, type or numbers; or one of far more entries than are stored."""
    import torch

    if not isinstance(value, torch.Tensor):
        return _VALUES[int(rng.integers(len(_VALUES)))]
    makers: tuple[Callable[[], Any], ...] = (
        value.double,
        lambda: value[None],
        lambda: value.flatten()[:1],
        lambda: torch.full_like(value, 1) * _FLOATS[int(rng.integers(len(_FLOATS)))],
        lambda: torch.zeros(1, dtype=value.dtype).expand(int(10 ** rng.uniform(3.0, 12.0))),
        lambda: torch.zeros(1).expand(value.shape),
        lambda: torch.zeros(()),
        lambda: torch.zeros(0),
        value.to_sparse,
        lambda: value.to(torch.complex64),
        lambda: [value],
        lambda: None,
    )
    return makers[int(rng.integers(len(makers)))]()


def _swapped(
    value: Any, rng: np.random.Generator, odd: Callable[[Any, np.random.Generator], Any] | None = None
) -> Any:
    """Nested tables in which one value, wherever it is, is another, is missing, or is there twice."""
    entries: list[tuple[Any, Any]] = []
    if isinstance(value, dict | list):
        entries = list(value.items() if isinstance(value, dict) else enumerate(value))
    if not entries or rng.random() < 0.15:
        return odd(value, rng) if odd is not None else _VALUES[int(rng.integers(len(_VALUES)))]
    key, entry = entries[int(rng.integers(len(entries)))]
    changed = value.copy()
    kind = rng.random()
    if kind < 0.1:
        del changed[key]
    elif kind < 0.15 and isinstance(changed, list):
        changed.insert(key, entry)
    else:
        changed[key] = _swapped(entry, rng, odd)
    return changed


def _damaged_array(array: np.ndarray[Any, Any], rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """An array of another type or shape, or with other numbers."""
    kind = int(rng.integers(6))
    if kind == 0:
        return np.zeros(array.shape, _DTYPES[int(rng.integers(len(_DTYPES)))])
    if kind == 1:
        return array[: int(rng.integers(len(array) + 1))] if array.ndim else array[None]
    if kind == 2:
        return np.repeat(array, 2, axis=int(rng.integers(array.ndim))) if array.ndim else array
    if kind == 3:
        return np.swapaxes(array, 0, -1)[..., None] if array.ndim > 1 else array.reshape(1, -1)
    changed = np.frombuffer(bytearray(array.tobytes()), np.uint8)
    if not len(changed):
        return array
    if kind == 4 and array.dtype == np.float64:
        numbers = changed.view(np.float64)
        numbers[int(rng.integers(len(numbers)))] = _FLOATS[int(rng.integers(len(_FLOATS)))]
    else:
        changed[int(rng.integers(len(changed)))] = int(rng.integers(256))
    return changed.view(array.dtype).reshape(array.shape)


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
