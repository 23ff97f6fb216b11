"""Ctrl-C, also while a kernel is compiled.

The compiler drops exceptions in two places. What is raised within a callback of LLVM is printed and dropped, and the
kernel with it, as `ctypes` can pass nothing on; and Numba clears what is raised while it looks at argument types. An
interrupt would be lost, and the command go on. So none is raised within such a callback, and an interrupt is raised
again until the command handles it.
"""

import signal
import sys
from types import FrameType

AGAIN_S = 0.2

_CALLBACKS = "_raw_object_cache_"
"""Beginning of the names of the functions that LLVM calls; they are in llvmlite's `ExecutionEngine`."""


def raise_until_handled() -> None:
    """Let SIGINT raise KeyboardInterrupt in the main thread, again and again until `handled` is called."""
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGALRM, _interrupt)


def handled() -> None:
    """Raise no more for the interrupts so far."""
    signal.setitimer(signal.ITIMER_REAL, 0.0)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    if isinstance(sys.exception(), KeyboardInterrupt):  # it is on its way, and something is being cleaned up
        return
    while frame is not None:
        if frame.f_code.co_name.startswith(_CALLBACKS):
            return
        frame = frame.f_back
    raise KeyboardInterrupt
