r"""Text for terminals: control characters are shown as escapes, and not sent.

Names, comments and units come from files and from the bus, which other programs write.
"""

import unicodedata
from collections.abc import Iterable

_ACTED_ON = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories: controls (C0, DEL and C1), formats such as those that reverse the direction, halves of surrogate
pairs, private and unassigned characters, and separators of lines and paragraphs."""


def printable(text: str) -> str:
    r"""Return a text in one line, with what a terminal would act on as escapes of JSON.

    So a JSON document stays one, and means the same.

    >>> print(printable("a\x1b[31mb\nc\x9b\u202ed"))
    a\u001b[31mb\u000ac\u009b\u202ed
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escape(letter) if unicodedata.category(letter) in _ACTED_ON else letter for letter in text)


def printable_lines(lines: Iterable[str]) -> str:
    """Join lines, each of which stays one, whatever is in it."""
    return "\n".join(map(printable, lines))


def _escape(letter: str) -> str:
    units = letter.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[place : place + 4]}" for place in range(0, len(units), 4))
