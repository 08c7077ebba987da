"""The parameter section of a C3D file, and its three ways of writing numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gloves.captures._text import Tell
from handsim.errors import CaptureError, shortened

_INTEL, _DEC, _SGI = 84, 85, 86
INTEGER_DTYPES: Final = {_INTEL: "<i2", _DEC: "<i2", _SGI: ">i2"}
FLOAT_DTYPES: Final = {_INTEL: "<f4", _DEC: "<u4", _SGI: ">f4"}  # DEC floats are bits until `to_native`
_CHARACTER, _BYTE, _INTEGER, _FLOAT = -1, 1, 2, 4
_BLOCK: Final = 512
_GROUPS: Final = {"POINT", "ANALOG", "TRIAL"}  # which say where points are; damage to others does not matter
_MOST_BYTES: Final = 1 << 22  # of all values together; records that overlap could state far more
_LONGEST_RECORD: Final = 1 << 17  # records are chained by 16-bit offsets; the last one has a little room more


def to_native(values: NDArray[np.generic], processor: int) -> NDArray[np.float64]:
    """Floats of a file as doubles; a DEC float has its halves swapped and is four times too big."""
    if processor != _DEC:
        with np.errstate(invalid="ignore"):  # a damaged file may hold signaling NaNs
            return values.astype(np.float64)
    bits = values.astype(np.uint32)
    swapped = ((bits >> np.uint32(16)) | (bits << np.uint32(16))).astype("<u4")
    return to_native(swapped.view("<f4"), _INTEL) / 4.0


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters by upper-case group and name: numbers, or strings for characters."""

    processor: int
    """Which of the three number formats the whole file uses."""
    values: dict[tuple[str, str], list[float] | list[str]]

    @staticmethod
    def parse(data: bytes, start: int, tell: Tell) -> Parameters:
        """Read the records from byte `start` of a file of a block or more; nothing outside it is touched."""
        if not 0 < start <= len(data) - 4 or data[start + 3] not in INTEGER_DTYPES:
            raise CaptureError("damaged: the parameter section is missing or in an unknown number format")
        processor = data[start + 3]
        try:
            groups, found = _walk(data, start + 4, processor, tell)
            read = [(groups[group], name, raw) for group, name, raw in found if groups.get(group) in _GROUPS]
            if sum(_num_bytes(raw) for _, _, raw in read) > _MOST_BYTES:
                raise CaptureError(f"damaged: the parameters hold more than {_MOST_BYTES} bytes")
            values = {(group, name): _read_values(bytes(raw), processor) for group, name, raw in read}
        except (ValueError, IndexError) as error:
            raise CaptureError("damaged: the parameter section cannot be read") from error
        return Parameters(processor, values)

    def number(self, group: str, name: str, *, default: float | None = None) -> float:
        """The first number of a parameter.

        Raises:
            CaptureError: It is not finite, or there is none and no default.
        """
        values = self.values.get((group, name), [])
        if values and isinstance(values[0], float):
            if not math.isfinite(values[0]):
                raise CaptureError(f"damaged: {group}:{name} is {values[0]}")
            return values[0]
        if default is None:
            raise CaptureError(f"damaged: the file states no number {group}:{name}")
        return float(default)

    def words(self, group: str, name: str) -> list[int]:
        """A parameter as unsigned 16-bit words; empty if it is absent or holds other values."""
        values = self.values.get((group, name), [])
        numbers = [value for value in values if isinstance(value, float) and math.isfinite(value)]
        return [int(value) & 0xFFFF for value in numbers]

    def strings(self, group: str, name: str) -> list[str]:
        """A parameter of characters as strings without padding; empty if it is absent."""
        return [value for value in self.values.get((group, name), []) if isinstance(value, str)]


def _walk(
    data: bytes, at: int, processor: int, tell: Tell
) -> tuple[dict[int, str], list[tuple[int, str, memoryview]]]:
    """Names of groups by number; and of each parameter its group, name and record from the type on."""
    order: Literal["little", "big"] = "big" if processor == _SGI else "little"
    groups: dict[int, str] = {}
    found: list[tuple[int, str, memoryview]] = []
    view = memoryview(data)
    points_at = (int.from_bytes(data[16:18], order) - 1) * _BLOCK
    end = points_at if points_at > at else len(data)  # of the section
    while at + 2 <= len(data):
        name_length = abs(int.from_bytes(data[at : at + 1], "little", signed=True))
        group = int.from_bytes(data[at + 1 : at + 2], "little", signed=True)
        if name_length == 0:
            break
        offset_at = at + 2 + name_length
        name = data[at + 2 : offset_at].decode("latin-1").upper().strip()
        offset = int.from_bytes(data[offset_at : offset_at + 2], order)
        if group < 0:
            groups[-group] = name
        else:
            found.append((group, name, view[offset_at + 2 : offset_at + 2 + _LONGEST_RECORD]))
        if offset == 0:
            break
        at = offset_at + offset
        if at > end:
            tell(f"the parameter section ends with {shortened(name)!r}, which points behind it")
            break
    return groups, found


def _num_bytes(raw: memoryview) -> int:
    """Bytes that a parameter record takes and states."""
    return 64 + math.prod(raw[2 : 2 + raw[1]]) * abs(int.from_bytes(raw[:1], "little", signed=True))


def _read_values(raw: bytes, processor: int) -> list[float] | list[str]:
    """The values of one parameter record, `raw` beginning at its type."""
    kind = int.from_bytes(raw[:1], "little", signed=True)
    dimensions = list(raw[2 : 2 + raw[1]])
    count = math.prod(dimensions)
    size = abs(kind)
    body = raw[2 + raw[1] : 2 + raw[1] + count * size]
    if (
        kind not in {_CHARACTER, _BYTE, _INTEGER, _FLOAT}
        or len(body) < count * size
        or len(dimensions) < raw[1]
    ):
        raise ValueError("not a parameter")
    if kind == _CHARACTER:
        width = dimensions[0] if dimensions else 1
        return [_text(body[at : at + width]) for at in range(0, count, width)] if count else []
    if kind == _BYTE:
        return [float(value) for value in body]
    if kind == _INTEGER:
        return [float(value) for value in np.frombuffer(body, INTEGER_DTYPES[processor])]
    return [float(value) for value in to_native(np.frombuffer(body, FLOAT_DTYPES[processor]), processor)]


def _text(raw: bytes) -> str:
    raw = raw.partition(b"\0")[0].strip(b" ")  # what follows a zero byte is left over from another text
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")
