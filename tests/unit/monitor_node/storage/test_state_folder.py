"""The folder of a fleet's states: each is there whole, or as it was before."""

import os
from pathlib import Path

import pytest

from monitor_node.state_files import CLAIM, StateStore
from reactorwatch.errors import InputError


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != CLAIM)


def test_the_newest_state_of_each_plant_is_there_when_the_folder_is_closed(tmp_path: Path) -> None:
    states = StateStore(tmp_path)
    for number in range(100):
        states.put("a", b"%d" % number)
        states.put("b", b"of b")
    states.close()
    assert names(tmp_path) == ["a.state", "b.state"]
    assert [(tmp_path / f"{plant}.state").read_bytes() for plant in "ab"] == [b"99", b"of b"]
    again = StateStore(tmp_path)
    assert again.plants == ["a", "b"]
    again.close()


def test_a_failed_write_is_reported_and_leaves_the_state_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = StateStore(tmp_path)
    before.put("a", b"before")
    before.close()

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    states = StateStore(tmp_path)
    states.put("a", b"now")
    states.close()
    ((plant, why),) = states.pop_failures()
    assert plant == "a"
    assert "No space left on device" in why
    assert (tmp_path / "a.state").read_bytes() == b"before"


def test_a_state_that_was_removed_by_a_person_is_written_again(tmp_path: Path) -> None:
    (tmp_path / "a.state").write_bytes(b"before")
    states = StateStore(tmp_path)
    (tmp_path / "a.state").unlink()
    states.put("a", b"now")
    states.close()
    assert (tmp_path / "a.state").read_bytes() == b"now"


def test_temporary_files_of_a_killed_writer_are_removed_at_the_next_start(tmp_path: Path) -> None:
    left, fresh = tmp_path / ".a.state.123.tmp", tmp_path / ".b.state.124.tmp"
    for path in (left, fresh):
        path.write_bytes(b"half")
    os.utime(left, (0.0, 0.0))
    StateStore(tmp_path).close()
    assert names(tmp_path) == [fresh.name]


@pytest.mark.parametrize("name", ["missing", "file"])
def test_a_folder_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=f"state folder .*{name}"):
        StateStore(tmp_path / name)
