"""Hostile XML ends in a sentence, soon."""

from __future__ import annotations

import pytest

from handsim.errors import RigError
from handsim.space import rig_formats
from handsim.space.rig_formats import load_cameras, read_xml
from tests.handsim.space.rig_formats.known_rig import XCP, check

BOMB = """<?xml version="1.0"?>
<!DOCTYPE lolz [<!ENTITY a "lol">{}]>
<Cameras>&j;</Cameras>""".format(
    "".join(f'<!ENTITY {chr(98 + n)} "{f"&{chr(97 + n)};" * 10}">' for n in range(9))
)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BOMB, "has a document type"),
        ('<!DOCTYPE c SYSTEM "file:///etc/passwd"><Cameras/>', "has a document type"),
        (
            '<!DOCTYPE c [<!ENTITY x SYSTEM "file:///etc/passwd">]><Cameras>&x;</Cameras>',
            "has a document type",
        ),
        ("<Cameras>&x;</Cameras>", "it is no XML"),
        ("<a>" * 100_000, "nested deeper than 64"),
        ("<Cameras>" + "<a/>" * 300_000 + "</Cameras>", "more than 200000 elements"),
        ("", "it is no XML"),
        ("\0" * 1000, "it is no XML"),
        ("Cameras", "it is no XML"),
        ('<Cameras a="1" a="2"/>', "it is no XML"),
    ],
)
def test_hostile_xml(tmp_path, content, message):
    path = tmp_path / "lab.xcp"
    path.write_text(content)
    with pytest.raises(RigError, match=message):
        load_cameras(path)


def test_a_giant_file(tmp_path):
    path = tmp_path / "lab.xcp"
    with path.open("wb") as file:
        file.truncate(rig_formats._MOST_BYTES + 1)
    with pytest.raises(RigError, match="bytes long, expected at most"):
        read_xml(path)


def test_bytes_that_are_no_text(tmp_path):
    path = tmp_path / "lab.xcp"
    path.write_bytes(b"<Cameras NAME='\xe9'/>")
    with pytest.raises(RigError, match="it is no XML text"):
        read_xml(path)
    path.write_bytes(b"<?xml version='1.0' encoding='ISO-8859-1'?><Cameras NAME='\xe9'/>")
    assert read_xml(path).get("NAME") == "é"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings(tmp_path, encoding):
    path = tmp_path / "lab.xcp"
    path.write_bytes(XCP.encode(encoding))
    check(load_cameras(path))
