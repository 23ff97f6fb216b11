"""Synced bytes are on the disk: fsync is called after all bytes were handed over."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from recorder.files.part_file import PART, PartFile

DATA = b"x" * 1000


@pytest.mark.parametrize(
    "act", [PartFile.sync, lambda file: file.finish(file.path.with_suffix(""))], ids=["sync", "finish"]
)
def test_the_system_is_asked_to_write_all_bytes_to_the_disk(
    act: Callable[[PartFile], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = list[tuple[int, bool, int]]()
    path = tmp_path / f"run.mcap{PART}"
    file = PartFile(path)
    number = path.stat().st_ino

    def record(descriptor: int) -> None:
        status = os.fstat(descriptor)
        synced.append((status.st_ino, path.exists(), status.st_size))

    monkeypatch.setattr(os, "fsync", record)
    file.write(DATA)
    act(file)
    file.abandon()
    assert synced == [(number, True, len(DATA))]
