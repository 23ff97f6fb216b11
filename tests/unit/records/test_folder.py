"""A folder is made with its parents, or the reason of the failure is reported."""

from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.write import make_folder


def test_a_folder_is_made_with_those_above_it_and_may_be_there_already(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    assert make_folder(folder).is_dir()
    assert make_folder(folder) == folder


def test_a_folder_that_must_be_new_is_refused_if_it_is_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder cannot be made: File exists"):
        make_folder(tmp_path, may_exist=False)


def test_a_folder_below_a_file_is_refused_with_the_option_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(InputError, match=f"^--out {file}/in: the folder cannot be made: Not a directory$"):
        make_folder(file / "in", "--out")
    with pytest.raises(InputError, match=f"^{file}/in: the folder cannot be made"):
        make_folder(file / "in")
