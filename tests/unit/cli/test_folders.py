"""Expansion of folders where many files may be named."""

from pathlib import Path

import pytest

from reactorwatch.cli.batch import as_table, expand_files
from reactorwatch.errors import InputError
from recorder.files.metadata import FILE_INDEX
from recorder.files.writer import RecordingWriter


def recording(path: Path, **metadata: str) -> Path:
    with RecordingWriter(path, metadata):
        return path


def test_what_a_recorder_has_written_into_a_folder_is_one_recording(tmp_path: Path) -> None:
    recording(tmp_path / "run-1.mcap", **{FILE_INDEX: "1"})
    recording(tmp_path / "cut.mcap", cut="from 3min to the end of run-2.mcap")
    (tmp_path / "a.csv").touch()
    assert expand_files([tmp_path]) == [tmp_path, tmp_path / "a.csv"]


def test_recordings_of_another_origin_are_one_each_in_the_order_of_their_names(tmp_path: Path) -> None:
    files = [recording(tmp_path / f"{name}.mcap", source="a record") for name in "ca"]
    files.append(tmp_path / "b.csv")
    files[-1].touch()
    assert expand_files([tmp_path]) == sorted(files)


def test_a_damaged_recording_does_not_change_what_its_folder_stands_for(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(b"this is no recording")
    assert expand_files([tmp_path]) == [damaged]
    recording(tmp_path / "whole.mcap", **{FILE_INDEX: "1"})
    assert expand_files([tmp_path]) == [tmp_path]


def test_a_pattern_is_the_files_that_are_like_it_in_order_of_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["b.csv", "a.csv", "in/c.csv", "[x].csv"]
    Path("in").mkdir()
    for name in names:
        Path(name).touch()
    assert expand_files([Path("?.csv"), Path("z.csv")]) == [Path("a.csv"), Path("b.csv"), Path("z.csv")]
    assert expand_files([Path("**/*.csv")]) == [Path("[x].csv"), Path("a.csv"), Path("b.csv"), Path("in/c.csv")]
    assert expand_files([Path("[x].csv")]) == [Path("[x].csv")]  # a file of that name comes before what is like it
    assert expand_files([tmp_path / "*.csv"])[0] == tmp_path / "[x].csv"


def test_a_pattern_without_a_match_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run-\*.csv: no file is called like this"):
        expand_files([tmp_path / "run-*.csv"])


def test_a_table_has_columns_as_wide_as_what_is_in_them_and_none_that_are_empty() -> None:
    rows = [{"file": "a", "why": "", "count": "10"}, {"file": "longer", "why": "", "count": ""}]
    assert as_table(rows) == "file    count\na       10\nlonger"
