"""Files and folders: errors in one line, and writes that leave no damaged file."""

import errno
import os
from pathlib import Path

import pytest

from reactorwatch.errors import InputError, is_passing
from reactorwatch.records.decode import wrap_read_errors
from reactorwatch.records.write import atomic_write, fill_folder, make_folder


def test_the_new_file_takes_the_place_of_the_old_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("old")
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("error", "raised", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), InputError, "cannot write .*run.csv: No space left"),
        (OSError(errno.EIO, "Input/output error", "other.csv"), OSError, "other.csv"),
        (ValueError("text"), ValueError, "text"),
        (KeyboardInterrupt(), KeyboardInterrupt, "^$"),
    ],
)
def test_an_exception_leaves_the_old_file_and_nothing_beside_it(
    tmp_path: Path, error: BaseException, raised: type[BaseException], said: str
) -> None:
    path = tmp_path / "run.csv"
    path.write_text("old")

    def fail() -> None:
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            temporary.with_name(f"{temporary.name}.part").write_text("of a writer with a name of its own")
            raise error

    with pytest.raises(raised, match=said) as caught:
        fail()
    assert is_passing(caught.value) == is_passing(error)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no/such/run.csv", "the folder .*no/such does not exist"),
        ("a_file/run.csv", "the folder .*a_file does not exist"),
        ("a_folder", "it is a folder"),
        ("x" * 300, "File name too long"),
    ],
)
def test_where_nothing_can_be_written_it_is_reported_before_the_work(tmp_path: Path, name: str, said: str) -> None:
    (tmp_path / "a_file").write_text("")
    (tmp_path / "a_folder").mkdir()
    with pytest.raises(InputError, match=said), atomic_write(tmp_path / name):
        pytest.fail("the block must not run")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_an_input_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"), atomic_write(tmp_path / "run.csv"):
        pytest.fail("the block must not run")


def test_a_link_stays_and_the_file_that_it_leads_to_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    file, link, dangling = tmp_path / "folder" / "run.csv", tmp_path / "link.csv", tmp_path / "new.csv"
    file.write_text("old")
    link.symlink_to(file)
    dangling.symlink_to(tmp_path / "folder" / "later.csv")
    for path in (link, dangling):
        with atomic_write(path) as temporary:
            temporary.write_text("new")
        assert path.is_symlink()
        assert path.read_text() == "new"
    assert sorted(path.name for path in (tmp_path / "folder").iterdir()) == ["later.csv", "run.csv"]


def test_what_is_no_regular_file_is_never_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    (tmp_path / "round").symlink_to(tmp_path / "round")
    for name, said in (("pipe", "no regular file"), ("link", "no regular file"), ("round", "symbolic links")):
        with pytest.raises(InputError, match=said), atomic_write(tmp_path / name):
            pytest.fail("the block must not run")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "pipe", "round"]


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


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "none"
    with pytest.raises(InputError, match=f"^{path}: there is no such file$"), wrap_read_errors(path), path.open():
        pass


def test_another_error_of_the_system_is_reported_in_its_words(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path}: cannot be read: Is a directory$"), wrap_read_errors(tmp_path):
        tmp_path.read_bytes()
