"""A clock that is set deletes nothing; the time that a monotonic clock confirms does."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from recorder.keep import DAY_NS
from recorder.recording_files import Ages, read_boot_clock
from tests.unit.recorder import golden
from tests.unit.recorder.recording import SECOND, Confirmed, Fed, recorder, samples

START = golden.RECEIVED_NS
LIMITS: dict[str, dict[str, Any]] = {"keep_files": {"keep_files": 3.0}, "keep_mb": {"keep_mb": 0.04}}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("*.mcap")}


def fill(fed: Fed, minutes: int, first: int = 0) -> int:
    """Record for so many minutes, which makes as many files; returns the next number."""
    count = 6 * minutes
    fed.receive(samples(count, first=first), 10 * SECOND)
    return first + count


@pytest.mark.parametrize("days", [6, 463, 36_500, -463])
def test_a_jump_of_the_wall_clock_deletes_no_recording(tmp_path: Path, days: int) -> None:
    fed = recorder(tmp_path / "run.mcap", START, rotate_min=1.0, keep_days=5.0, black_box_min=0.0)
    following = fill(fed, 3)
    fed.jump(days * DAY_NS)
    following = fill(fed, 3, following)
    fed.jump(-days * DAY_NS)
    fill(fed, 3, following)
    fed.stop()
    assert len(names(tmp_path)) >= 9


def test_days_that_the_monotonic_clock_confirms_delete_what_ended_before_them(tmp_path: Path) -> None:
    fed = recorder(
        tmp_path / "run.mcap", START, rotate_min=1.0, keep_days=5.0, black_box_min=0.0, health_period_s=3600.0
    )
    following = fill(fed, 3)
    before = names(tmp_path)
    fed.pass_time(6 * DAY_NS)
    fill(fed, 2, following)
    fed.stop()
    assert not names(tmp_path) & before
    assert names(tmp_path)


def test_a_wrong_clock_at_a_start_deletes_nothing_that_earlier_recorders_left(tmp_path: Path) -> None:
    """The machine starts again, with a clock that is 463 days ahead."""
    first = recorder(tmp_path, START, rotate_min=1.0, keep_days=5.0, black_box_min=0.0)
    following = fill(first, 3)
    first.stop()
    before = names(tmp_path)
    late_ns = START + 463 * DAY_NS
    fed = recorder(tmp_path, late_ns, boot="another boot", rotate_min=1.0, keep_days=5.0, black_box_min=0.0)
    fill(fed, 2, following)
    fed.stop()
    assert before < names(tmp_path)


@pytest.mark.parametrize("limit", LIMITS)
def test_of_files_on_both_sides_of_a_jump_the_oldest_by_the_confirmed_time_goes_first(
    tmp_path: Path, limit: str
) -> None:
    """The clock was ahead by a year for a while: what was recorded then is not younger than what came after."""
    fed = recorder(tmp_path / "run.mcap", START, rotate_min=1.0, black_box_min=0.0, **LIMITS[limit])
    fed.jump(365 * DAY_NS)
    following = fill(fed, 3)
    fed.jump(-365 * DAY_NS)
    fill(fed, 20, following)
    fed.stop()
    numbers = sorted(int(name.removeprefix("run").removesuffix(".mcap") or -1) for name in names(tmp_path))
    assert min(-number for number in numbers) > 3


def test_a_new_file_of_an_old_name_is_not_as_old(tmp_path: Path) -> None:
    clock = Confirmed(0)
    ages = Ages(tmp_path / ".ages", clock.read)
    ages.update([("run.mcap", 1)])
    clock.now_ns = 500
    assert ages.update([("run.mcap", 2)]) == {"run.mcap": 500}


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff" * 20, b'{"boot": 1}'])
def test_a_damaged_file_of_ages_counts_them_from_now(tmp_path: Path, content: bytes) -> None:
    (tmp_path / ".ages").write_bytes(content)
    ages = Ages(tmp_path / ".ages", Confirmed(500).read)
    assert ages.update([("a", 1)]) == {"a": 0}


@given(steps=st.lists(st.tuples(st.sampled_from(["run", "off", "store"]), st.integers(0, 10**6)), max_size=20))
def test_no_age_is_more_than_the_time_in_which_the_machine_ran(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    path, clock, ran_ns = tmp_path_factory.mktemp("ages") / ".ages", Confirmed(0), 0
    ages = Ages(path, clock.read)
    ages.update([("a", 1)])
    for number, (what, span_ns) in enumerate(steps):
        if what == "run":
            clock.now_ns += span_ns
            ran_ns += span_ns
        elif what == "store":
            ages.store()
        else:
            clock = Confirmed(span_ns, f"boot {number}")
            ages = Ages(path, clock.read)
        assert 0 <= ages.now_ns() - ages.update([("a", 1)])["a"] <= ran_ns


def stored_ages(path: Path, boot: str, since_ns: int) -> None:
    """A file of ages: one recording, first seen at 0, and 100 ns since."""
    clock = Confirmed(since_ns, boot)
    ages = Ages(path, clock.read)
    ages.update([("a", 1)])
    clock.now_ns += 100
    ages.store()


@pytest.mark.parametrize(
    ("before", "after", "since_ns", "now_ns"),
    [
        ("a boot", "a boot", 1400, 400),  # it was stored at 1100
        ("a boot", "a boot", 1100, 100),
        ("a boot", "a boot", 1099, 100),  # no clock since boot goes back
        ("a boot", "another", 1400, 100),
        ("", "", 1400, 100),  # unknown boots
    ],
)
def test_the_time_between_two_recorders_is_confirmed_by_the_clock_of_one_boot(
    tmp_path: Path, before: str, after: str, since_ns: int, now_ns: int
) -> None:
    stored_ages(tmp_path / ".ages", before, 1000)
    ages = Ages(tmp_path / ".ages", Confirmed(since_ns, after).read)
    assert ages.now_ns() == now_ns
    assert ages.update([("a", 1), ("b", 1)]) == {"a": 0, "b": now_ns}


def test_a_recording_is_as_old_as_its_completion_though_it_is_listed_later(tmp_path: Path) -> None:
    clock = Confirmed(0)
    ages = Ages(tmp_path / ".ages", clock.read)
    clock.now_ns = 500
    ages.add("a", 1)
    ages.add("b", 1)
    clock.now_ns = 900
    assert ages.update([("a", 1), ("b", 2), ("c", 1)]) == {"a": 500, "b": 900, "c": 900}
    clock.now_ns = 1000
    assert ages.update([("a", 1), ("c", 1)]) == {"a": 500, "c": 900}
    assert ages.update([("a", 1), ("b", 2), ("c", 1)]) == {"a": 500, "b": 1000, "c": 900}, "b was deleted in between"


def test_without_the_identifier_of_the_boot_no_boot_is_claimed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    identifier = tmp_path / "boot_id"
    identifier.write_text("7-7\n")
    monkeypatch.setattr("recorder.recording_files._BOOT_ID", identifier)
    assert read_boot_clock().boot == "7-7"
    identifier.unlink()
    first, second = read_boot_clock(), read_boot_clock()
    assert first.boot == second.boot == ""
    assert 0 < first.since_ns <= second.since_ns
