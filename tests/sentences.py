"""Errors that name what a user must know, whatever the words around it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest


def assert_names(sentence: str, words: str) -> None:
    """The sentence is one line that holds each of the words, which ` | ` separates."""
    assert "\n" not in sentence
    assert [word for word in words.split(" | ") if word not in sentence] == [], sentence


@contextlib.contextmanager
def error_names(kind: type[Exception], words: str) -> Iterator[None]:
    """An error of this kind comes, whose sentence names each of the words, which ` | ` separates."""
    with pytest.raises(kind) as caught:
        yield
    assert_names(str(caught.value), words)
