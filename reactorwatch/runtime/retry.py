"""Retry what a passing state of the machine refuses: a full disk, a folder without rights, an address that is taken.

Which errors pass is decided by `errors.is_passing`. The others are raised at once.
"""

from collections.abc import Callable
from typing import TypeVar

from reactorwatch.errors import is_passing

FIRST_RETRY_S = 0.1
MAX_RETRY_S = 2.0

Result = TypeVar("Result")


def retry(
    attempt: Callable[[], Result],
    wait: Callable[[float], bool],
    on_failure: Callable[[str, bool], object],
    passes: Callable[[BaseException], bool] = is_passing,
) -> Result | None:
    """Call a function until it raises no passing error.

    Args:
        attempt: the function.
        wait: waits for so many seconds; returns True, early, once a stop is requested.
        on_failure: called after each failure with its reason, and True if the failure before had another reason.
        passes: True for an error that can pass.

    Returns:
        The result of the function; None if a stop was requested first.
    """
    retry_s, before = FIRST_RETRY_S, ""
    while not wait(0.0):
        try:
            return attempt()
        except Exception as error:
            if not passes(error):
                raise
            reason = describe(error)
        on_failure(reason, reason != before)
        before = reason
        if wait(retry_s):
            break
        retry_s = min(2 * retry_s, MAX_RETRY_S)
    return None


def describe(error: BaseException) -> str:
    """Reason of a failure in one line; an error of the system names its file."""
    if isinstance(error, OSError) and error.strerror is not None:
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    return next(iter(str(error).splitlines()), type(error).__name__)
