"""A folder whose files appear together or not at all."""

from pathlib import Path

import pytest

from reactorwatch.errors import InputError
from reactorwatch.records.write import fill_folder


def tree(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() if path.is_file() else "" for path in folder.rglob("*")}


@pytest.mark.parametrize("there", [False, True])
def test_all_files_appear_at_the_end(tmp_path: Path, there: bool) -> None:
    out = tmp_path / "a" / "report"
    if there:
        out.mkdir(parents=True)
        (out / "old.csv").write_text("old")
        (out / "kept.csv").write_text("kept")
    with fill_folder(out) as folder:
        (folder / "new.csv").write_text("new")
        (folder / "old.csv").write_text("new")
        assert not (out / "new.csv").exists()
    others = {"kept.csv": "kept"} if there else {}
    assert tree(out) == {"new.csv": "new", "old.csv": "new", **others}


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("error", [ValueError("text"), KeyboardInterrupt(), InputError("text")])
def test_an_exception_leaves_the_folder_as_it_was(tmp_path: Path, error: BaseException, there: bool) -> None:
    out = tmp_path / "a" / "report"
    if there:
        out.mkdir(parents=True)
        (out / "old.csv").write_text("old")
    before = tree(tmp_path)

    def fail() -> None:
        with fill_folder(out) as folder:
            (folder / "old.csv").write_text("new")
            raise error

    with pytest.raises(type(error)):
        fail()
    assert tree(tmp_path) == before


def test_where_no_folder_can_be_made_it_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"--out .*cannot be made"), fill_folder(tmp_path / "file" / "in"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
