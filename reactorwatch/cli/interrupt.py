"""Ctrl-C, also while a kernel is compiled.

The compiler drops exceptions in three places. One within a callback of LLVM is printed and dropped, and the kernel with
it, because `ctypes` cannot propagate it; one within the constructor of an object of LLVM leaves it half made, and its
destructor prints another; and Numba clears one raised while it inspects argument types. The interrupt would be lost and
the command continue, or a traceback be shown. So none is raised within the binding of LLVM, and an interrupt is raised
again until the command handles it.
"""

import atexit
import signal
import sys
from types import FrameType

AGAIN_S = 0.2

_BINDING = "llvmlite.binding"
"""Package whose code calls LLVM; a callback of LLVM runs within it."""


def raise_until_handled() -> None:
    """Let SIGINT raise KeyboardInterrupt in the main thread, repeatedly until `clear_interrupt` is called."""
    signal.signal(signal.SIGINT, _interrupt)
    atexit.register(clear_interrupt)


def clear_interrupt() -> None:
    """Stop raising for the interrupts so far; an alarm that comes yet is ignored, also while the interpreter ends."""
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    signal.setitimer(signal.ITIMER_REAL, 0.0)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if number == signal.SIGINT:
        signal.signal(signal.SIGALRM, _interrupt)
    elif signal.getsignal(signal.SIGALRM) is signal.SIG_IGN:  # it was on its way when the interrupts were cleared
        return
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    if _is_handled(sys.exception()):
        return
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith(_BINDING):
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _is_handled(error: BaseException | None) -> bool:
    """True while an interrupt is handled, also by closing a generator, whose GeneratorExit has it as context."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__context__
    return False
