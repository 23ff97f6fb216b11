"""Messages as they come from Zenoh, and the memory of a session: large blocks are given back to the system."""

import ctypes
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import zenoh

from reactorwatch.runtime.bus_zenoh.messages import MAX_KEY, SEQUENCE_ATTACHMENT, SampleReader
from reactorwatch.runtime.bus_zenoh.sessions import LARGE_BYTES


@pytest.mark.parametrize(("length", "is_numbered"), [(MAX_KEY, True), (MAX_KEY + 1, False), (60_000, False)])
def test_a_key_longer_than_any_of_the_contract_is_not_put_in_order(length: int, is_numbered: bool) -> None:
    """The names of streams are kept, so that a made-up key of 65,535 characters would take as many bytes."""
    sample = SimpleNamespace(
        key_expr="x" * length,
        encoding=zenoh.Encoding.ZENOH_BYTES,
        payload=zenoh.ZBytes(b"1"),
        attachment=zenoh.ZBytes(SEQUENCE_ATTACHMENT.pack(3, 4)),
    )
    publisher, message = SampleReader().read(sample, 5)  # type: ignore[arg-type]
    assert (publisher, message.payload, len(message.key)) == ((3, 4) if is_numbered else None, b"1", length)


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


def taken_one_by_one(how: str) -> list[bool]:
    """Of three large blocks, one after the other: True if it was taken from the system by itself."""
    usual = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    command = [sys.executable, "-c", SIZES, how]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, env=usual).stdout
    return [int(line) >= 2 * LARGE_BYTES for line in printed.split()]


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="the C library is not glibc")
def test_a_large_block_is_taken_from_the_system_also_after_one_was_freed() -> None:
    assert taken_one_by_one("limited") == [True, True, True]
    assert taken_one_by_one("as it is") == [True, False, False]
