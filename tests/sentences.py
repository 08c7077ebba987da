"""What an error must name, whatever the words around it."""


def assert_names(error: object, words: str) -> None:
    """The error is one sentence on one line that holds each of the words, which ` | ` separates."""
    sentence = str(error).strip()
    assert "\n" not in sentence
    assert [word for word in words.split(" | ") if word not in sentence] == [], sentence
