"""The folder of a fleet's states: each is there whole, or as it was before."""

import os
from pathlib import Path

import pytest

from monitor_node.storage.fleet_states import FleetStates
from reactorwatch.errors import InputError


def test_monitors_that_start_at_the_same_moment_do_not_refuse_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each tries whether it can write there; the other one takes that trial away before this one does."""
    unlink = Path.unlink

    def after_the_other(self: Path, missing_ok: bool = False) -> None:
        if self.name == "..state":
            unlink(self)
        unlink(self, missing_ok)

    monkeypatch.setattr(Path, "unlink", after_the_other)
    FleetStates(tmp_path).close()


def test_what_was_put_is_there_when_it_is_closed_the_newest_of_each_plant(tmp_path: Path) -> None:
    states = FleetStates(tmp_path)
    for number in range(100):
        states.put("a", b"%d" % number)
        states.put("b", b"of b")
    assert states.read("a") == b"99"
    states.close()
    again = FleetStates(tmp_path)
    assert (again.plants, again.read("a"), again.read("b"), again.read("c")) == (["a", "b"], b"99", b"of b", None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.state", "b.state"]
    again.close()


def test_what_cannot_be_written_is_told_and_what_was_there_is_still_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = FleetStates(tmp_path)
    before.put("a", b"before")
    before.close()

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    states = FleetStates(tmp_path)
    states.put("a", b"now")
    states.close()
    ((plant, why),) = states.pop_failures()
    assert plant == "a"
    assert "No space left on device" in why
    assert (tmp_path / "a.state").read_bytes() == b"before"


def test_a_state_that_cannot_be_used_is_kept_under_another_name(tmp_path: Path) -> None:
    (tmp_path / "a.state").write_bytes(b"rubbish")
    states = FleetStates(tmp_path)
    assert states.keep_aside("a", ".damaged") == "a.state.damaged"
    assert states.plants == []
    assert (tmp_path / "a.state.damaged").read_bytes() == b"rubbish"
    states.close()


def test_who_was_replaced_writes_over_no_newer_state_and_is_told_so(tmp_path: Path) -> None:
    first, second = FleetStates(tmp_path), FleetStates(tmp_path)
    assert first.read("a") is None
    first.put("a", b"of the first")
    first.close()
    assert second.read("a") == b"of the first"
    second.put("a", b"of the second")
    second.close()
    again = FleetStates(tmp_path)
    again._marks = first._marks  # it has not ended, but was cut off
    assert again.adopted_elsewhere(["a", "b"]) == ["a"]
    again.put("a", b"later, of the first")
    again.close()
    assert (again.pop_lost(), again.pop_lost()) == (["a"], [])
    assert again.read("a") == b"of the second"
    assert again.adopted_elsewhere(["a"]) == []


def test_who_is_replaced_while_he_writes_writes_over_no_newer_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one that is frozen in the middle of it."""
    (tmp_path / "a.state").write_bytes(b"before")
    states = FleetStates(tmp_path)
    states.read("a")
    monkeypatch.setattr("os.fsync", lambda _descriptor: (tmp_path / "a.state").write_bytes(b"of another"))
    states.put("a", b"too late")
    states.close()
    assert (states.pop_lost(), (tmp_path / "a.state").read_bytes()) == (["a"], b"of another")
    assert [path.name for path in tmp_path.iterdir()] == ["a.state"]


def test_what_is_being_written_is_read_unless_another_has_written_since(tmp_path: Path) -> None:
    states = FleetStates(tmp_path)
    states.read("a")
    states.close()  # nothing is written any more
    states.put("a", b"waits")
    assert states.read("a") == b"waits"
    (tmp_path / "a.state").write_bytes(b"of another")
    assert states.read("a") == b"of another"


def test_a_state_that_was_removed_by_a_person_is_written_again(tmp_path: Path) -> None:
    (tmp_path / "a.state").write_bytes(b"before")
    states = FleetStates(tmp_path)
    states.read("a")
    (tmp_path / "a.state").unlink()
    states.put("a", b"now")
    states.close()
    assert (states.pop_lost(), (tmp_path / "a.state").read_bytes()) == ([], b"now")


def test_what_a_writer_has_left_that_was_killed_is_removed_at_the_next_start(tmp_path: Path) -> None:
    left, fresh = tmp_path / ".a.state.123.tmp", tmp_path / ".b.state.124.tmp"
    for path in (left, fresh):
        path.write_bytes(b"half")
    os.utime(left, (0.0, 0.0))
    FleetStates(tmp_path).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == [fresh.name]


@pytest.mark.parametrize("name", ["missing", "file"])
def test_a_folder_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=f"state folder .*{name}"):
        FleetStates(tmp_path / name)
