"""XML that somebody else wrote: no entities, no document types, a bounded number of elements."""

from __future__ import annotations

import codecs
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final
from xml.parsers import expat

from handsim.errors import RigError
from handsim.files.inputs import read_bytes

_MOST_BYTES: Final = 1 << 25  # masks and thresholds of cameras lie in these files too
_MOST_ELEMENTS: Final = 200_000
_DEEPEST: Final = 64
_DECLARATION: Final = re.compile(r"^\s*<\?xml[^>]*\?>")
_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


class _Refused(Exception):
    """What the parser must not go on with."""


def read_xml(path: Path) -> ET.Element:
    """The root of an XML file in UTF-8, UTF-16 or Latin-1."""
    text = _decoded(path, read_bytes(path, error=RigError, most=_MOST_BYTES))
    try:
        return _parsed(text)
    except _Refused as error:
        raise RigError(f"{path}: {error}") from error
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise RigError(f"{path}: not a calibration: it is no XML (line {error.lineno}: {reason})") from error


def _decoded(path: Path, data: bytes) -> str:
    """The text without its declaration, whose encoding some programs state wrongly."""
    mark, encoding = next((pair for pair in _MARKS if data.startswith(pair[0])), (b"", ""))
    if not encoding:
        encoding = {b"<\0": "utf-16-le", b"\0<": "utf-16-be"}.get(data[:2], "utf-8")
    try:
        text = data[len(mark) :].decode(encoding)
    except UnicodeDecodeError as error:
        if encoding != "utf-8" or not re.match(rb"\s*<\?xml[^>]*(8859-1|1252)", data[:200], re.I):
            raise RigError(f"{path}: not a calibration: it is no XML text") from error
        text = data.decode("latin-1")
    return _DECLARATION.sub("", text, count=1)


def _parsed(text: str) -> ET.Element:
    builder, parser = ET.TreeBuilder(), expat.ParserCreate("utf-8")
    elements = depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal elements, depth
        elements, depth = elements + 1, depth + 1
        if elements > _MOST_ELEMENTS or depth > _DEEPEST:
            raise _Refused(
                f"the XML has more than {_MOST_ELEMENTS} elements or is nested deeper than {_DEEPEST}, "
                "expected the calibration of a camera system"
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise _Refused("the XML has a document type, which no calibration has; it is not read")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.Parse(text.encode("utf-8", "surrogatepass"), True)
    return builder.close()
