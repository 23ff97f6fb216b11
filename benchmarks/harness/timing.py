"""Times of benchmarks: the fastest of several runs, as other load on the machine makes single times only longer."""

import time
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def fastest(run: Callable[[], Result], repeats: int) -> tuple[float, Result]:
    """Seconds of the fastest of some runs, after one that is not counted as it may compile, and a result."""
    result, seconds = run(), []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds), result
