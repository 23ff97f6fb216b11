"""Errors in the user's input, each reported in one line."""

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """Input that cannot be used: a file, an option, a setting.

    Its text is one line that names the thing, the rule and the value, and the cure if it is known. Commands print
    that line and end with exit code 2; every other error is a fault of this software (`runtime/crash.py`).
    """


def describe_unknown(what: str, name: str, valid: Iterable[str]) -> str:
    """Describe an unknown name, with a hint at the closest valid one, and the valid names.

    >>> describe_unknown("input", "flwo", ("flow",))
    "unknown input 'flwo'; did you mean 'flow'? (valid: flow)"
    """
    names = list(valid)
    return f"unknown {what} {name!r}{hint_at_closest(name, names)} (valid: {', '.join(names) or 'none'})"


def hint_at_closest(name: str, valid: Iterable[str]) -> str:
    """Hint at the closest valid name, in any case of its letters; empty if none is close.

    >>> hint_at_closest("ti-310", ("FIC-7", "TI-301"))
    "; did you mean 'TI-301'?"
    """
    names = {item.casefold(): item for item in valid}
    close = difflib.get_close_matches(name.casefold(), names, n=1)
    return f"; did you mean {names[close[0]]!r}?" if close else ""


@contextmanager
def prefix_errors(what: object, kind: type[ValueError] = InputError) -> Iterator[None]:
    """Start the text of an error with what it is about, such as the path of a file.

    Args:
        what: the start of the text.
        kind: kind of the errors; `ValueError` includes those of code that does not know about the user's input.
    """
    try:
        yield
    except kind as error:
        raise InputError(f"{what}: {error}") from error
