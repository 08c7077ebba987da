"""Text as TOML files hold it."""

from __future__ import annotations

import tomllib

from hypothesis import given
from hypothesis import strategies as st

from handsim.files.inputs import quoted


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_any_text_comes_back(text):
    assert tomllib.loads(f"name = {quoted(text)}")["name"] == text


def test_the_delete_character_is_escaped():
    assert quoted("a\x7fb") == '"a\\u007Fb"'
