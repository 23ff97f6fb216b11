"""Large blocks are taken from the system and given back, however many there were before."""

import ctypes
import os
import subprocess
import sys

import pytest

from reactorwatch.runtime.bus_zenoh.sessions import LARGE_BYTES

SIZES = f"""
import ctypes, sys
from reactorwatch.runtime.bus_zenoh import sessions as heap
class Counts(ctypes.Structure):
    _fields_ = [(f"field{{place}}", ctypes.c_size_t) for place in range(10)]
library = ctypes.CDLL(None)
library.mallinfo2.restype = Counts
if sys.argv[1] == "limited":
    assert heap.release_large_blocks()
for _ in range(3):
    before = library.mallinfo2().field4  # hblkhd: bytes of blocks that were taken one by one
    block = bytes({2 * LARGE_BYTES})
    print(library.mallinfo2().field4 - before)
    del block
"""

pytestmark = pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="the C library is not glibc")


def taken_one_by_one(how: str) -> list[bool]:
    """Of three large blocks, one after the other: True if it was taken from the system by itself."""
    usual = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    command = [sys.executable, "-c", SIZES, how]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, env=usual).stdout
    return [int(line) >= 2 * LARGE_BYTES for line in printed.split()]


def test_a_large_block_is_taken_from_the_system_also_after_one_was_freed() -> None:
    assert taken_one_by_one("limited") == [True, True, True]
    assert taken_one_by_one("as it is") == [True, False, False]
