"""Claims on plants in a folder: the last one counts, and one that cannot be written or read hides no alarm."""

import os
from pathlib import Path

import pytest

from monitor_node.storage.claims import Claims
from monitor_node.storage.fleet_states import FleetStates


def test_the_last_claim_counts_and_a_plant_without_one_is_claimed_by_no_other_monitor(tmp_path: Path) -> None:
    first, second = Claims(tmp_path), Claims(tmp_path)
    assert not first.is_claimed_elsewhere("a")
    for own, other in ((first, second), (second, first), (first, second)):
        assert own.claim("a") is None
        assert (own.is_claimed_elsewhere("a"), other.is_claimed_elsewhere("a")) == (False, True)


@pytest.mark.parametrize("kind", ["folder", "pipe", "empty", "no access"])
def test_a_claim_that_cannot_be_written_or_read_withholds_no_alarm(tmp_path: Path, kind: str) -> None:
    path, claims = tmp_path / ".a.owner", Claims(tmp_path / "missing" if kind == "no access" else tmp_path)
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "empty":
        path.touch()
    assert not claims.is_claimed_elsewhere("a")
    why = claims.claim("a")
    assert (why is None) == (kind == "empty")
    assert why is None or "cannot be written" in why
    assert not claims.is_claimed_elsewhere("a")


def test_after_a_claim_that_failed_the_older_one_of_another_monitor_withholds_no_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = Claims(tmp_path), Claims(tmp_path)
    second.claim("a")

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr("os.write", full)
        assert "No space left" in (first.claim("a") or "")
    assert not first.is_claimed_elsewhere("a")
    assert first.claim("a") is None
    assert second.is_claimed_elsewhere("a")


def test_only_a_plant_with_a_state_is_claimed_and_a_failure_is_reported(tmp_path: Path) -> None:
    first, second = FleetStates(tmp_path), FleetStates(tmp_path)
    assert (first.claim("a"), [path.name for path in tmp_path.iterdir()]) == (False, [])
    (tmp_path / "a.state").write_bytes(b"state")
    assert first.claim("a")
    assert (second.adopted_elsewhere(["a", "b"]), first.adopted_elsewhere(["a", "b"])) == (["a"], [])
    (tmp_path / ".b.owner").mkdir()
    (tmp_path / "b.state").write_bytes(b"state")
    assert not first.claim("b")
    assert "cannot be written" in first.pop_failures()[0][1]
    first.close()
    second.close()
