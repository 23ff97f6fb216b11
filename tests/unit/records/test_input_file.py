"""What keeps a file from being read is told with its name."""

from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.input_file import wrap_read_errors


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    path = tmp_path / "none"
    with pytest.raises(InputError, match=f"^{path}: there is no such file$"), wrap_read_errors(path), path.open():
        pass


def test_what_else_the_system_refuses_is_told_in_its_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path}: cannot be read: Is a directory$"), wrap_read_errors(tmp_path):
        tmp_path.read_bytes()
