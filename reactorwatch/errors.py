"""Errors in the user's input, each reported in one line."""

import difflib
import errno
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from math import isfinite
from typing import ClassVar


class InputError(ValueError):
    """Input that cannot be used: a file, an option, a setting.

    Its text is one line that names the thing, the rule and the value, and the cure if it is known. Commands print
    that line and end with `exit_code`; every other error is a fault of this software (`runtime/node_main.py`).
    """

    exit_code: ClassVar[int] = 2


class UnfitRecordError(InputError):
    """A record that can be read, but holds too little to be watched, diagnosed or identified."""

    exit_code = 3


class UnavailableError(Exception):
    """A node ends for a reason that can pass without a person, so that a supervisor restarts it."""

    exit_code: ClassVar[int] = 1


_PASSING = frozenset(
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EROFS", "EACCES", "EPERM", "EIO", "ESTALE", "EBUSY"),  # of a folder or a disk
        *("EADDRINUSE", "EADDRNOTAVAIL", "ENETDOWN", "ENETUNREACH", "EHOSTDOWN", "EHOSTUNREACH"),  # of an address
        *("EMFILE", "ENFILE", "ENOMEM", "EAGAIN"),  # of the machine
    )
)


def is_passing(error: BaseException | None) -> bool:
    """True if an error, or a cause of it, is a state of the machine that can pass: a full disk, a port that is taken.

    At its start a node waits until it has passed (`runtime/event_loop.py`); other errors are for a person to mend.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in _PASSING:
            return True
        error = error.__cause__
    return False


def describe_unknown(what: str, name: str, valid: Iterable[str]) -> str:
    """Describe an unknown name, with a hint at the closest valid one, and the valid names.

    >>> describe_unknown("input", "flwo", ("flow",))
    "unknown input 'flwo'; did you mean 'flow'? (valid: flow)"
    """
    names = list(valid)
    return f"unknown {what} {name!r}{hint_at_closest(name, names)} (valid: {', '.join(names) or 'none'})"


def describe_exception(error: BaseException) -> str:
    """Describe an exception that any code may have raised, even one whose text cannot be made.

    >>> describe_exception(KeyError("k0"))
    "KeyError: 'k0'"
    """
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 (the text is made by code that is not known here)
        text = "(its text cannot be made)"
    return f"{type(error).__name__}: {text}"


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
        raise (type(error) if isinstance(error, UnfitRecordError) else InputError)(f"{what}: {error}") from error


def positive(name: str, value: float) -> float:
    """The value itself.

    Raises:
        InputError: it is not a positive number.
    """
    if not (value > 0 and isfinite(value)):
        raise InputError(f"{name} must be a positive number, got {value}")
    return float(value)
