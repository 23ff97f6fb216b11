"""Errors of reading a file are reported with its name."""

from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.decode import wrap_read_errors


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "none"
    with pytest.raises(InputError, match=f"^{path}: there is no such file$"), wrap_read_errors(path), path.open():
        pass


def test_another_error_of_the_system_is_reported_in_its_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path}: cannot be read: Is a directory$"), wrap_read_errors(tmp_path):
        tmp_path.read_bytes()
