"""Machine code is cached on disk; damaged or missing entries are compiled again."""

import os
from pathlib import Path

import pytest

import reactorwatch as rw
from reactorwatch.codegen.compiled_function import CodeCache, _host
from reactorwatch.progress import reporting_to
from tests.unit.diagnosis.linear_tank import tank_record


class Maker:
    """Makes code, and counts how often."""

    def __init__(self, code: bytes = b"code") -> None:
        self.made, self._code = 0, code

    def __call__(self) -> bytes:
        self.made += 1
        return self._code


def test_what_was_made_once_is_not_made_again(tmp_path: Path) -> None:
    make = Maker()
    assert [CodeCache(tmp_path / "new").get_or_make("name", make) for _ in range(3)] == [b"code"] * 3
    assert make.made == 1


def test_another_name_is_other_code(tmp_path: Path) -> None:
    store = CodeCache(tmp_path)
    assert (store.get_or_make("one", Maker(b"1")), store.get_or_make("two", Maker(b"2"))) == (b"1", b"2")


@pytest.mark.parametrize("damage", [b"", b"short", bytes(32) + b"code", bytes(40)])
def test_a_damaged_entry_is_rebuilt_and_then_kept(tmp_path: Path, damage: bytes) -> None:
    store, make = CodeCache(tmp_path), Maker()
    store.get_or_make("name", make)
    (tmp_path / "name").write_bytes(damage)
    assert [store.get_or_make("name", make) for _ in range(2)] == [b"code"] * 2
    assert make.made == 2


def test_half_a_file_is_never_under_its_name(tmp_path: Path) -> None:
    """Whatever is in the folder afterwards is whole: one that is written has another name."""
    CodeCache(tmp_path).get_or_make("name", Maker())
    assert [item.name for item in tmp_path.iterdir()] == ["name"]


def test_without_a_folder_code_is_made_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    make = Maker()
    assert [CodeCache(tmp_path / "file" / "store").get_or_make("name", make) for _ in range(2)] == [b"code"] * 2
    assert make.made == 2


def test_of_too_many_those_go_that_were_used_longest_ago(tmp_path: Path) -> None:
    store, make = CodeCache(tmp_path, capacity=10, evicted=4), Maker()
    for number in range(10):
        store.get_or_make(f"{number:02}", make)
        os.utime(tmp_path / f"{number:02}", (number, number))
    store.get_or_make("00", make)
    store.get_or_make("10", make)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["00", *(f"{number:02}" for number in range(5, 11))]


PROCESS = """
import reactorwatch as rw
from tests.unit.diagnosis.linear_tank import tank

def process():
    return rw.Process("tank", (rw.Signal("u", "m", "input"), rw.Signal("h", "m", "output")), tank())
"""


def test_a_process_of_ones_own_is_compiled_at_its_first_diagnosis_and_not_again_when_its_file_was_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file, record, compiled = tmp_path / "own.py", tank_record(gain=1.1), list[int]()
    _host.cache_clear()
    try:
        for _ in range(2):
            file.write_text(PROCESS)
            stages: list[str] = []
            with reporting_to(lambda stage, _step, _steps, stages=stages: stages.append(stage)):  # type: ignore[misc]
                rw.diagnose(record, file)
            compiled.append(stages.count("compiling function"))
    finally:
        _host.cache_clear()
    assert compiled[0] > 0
    assert compiled[1] == 0
