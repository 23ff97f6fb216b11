"""`scale` on a busy machine: its parts start, and one that does not reports the reason."""

import itertools
from pathlib import Path

import pytest

from benchmarks import scale
from benchmarks.scale import LEARNED_ROWS, plant_name
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, encode
from recorder.tools.player import samples_of

ROWS = 200


@pytest.fixture(scope="module")
def short_record() -> list[Encoded]:
    """Messages of a plant, as many as are needed here."""
    return [
        encode(item) for item in samples_of(simulate_record(PlantConfig(seed=1), LEARNED_ROWS + ROWS), plant_name(0))
    ]


def test_the_part_without_a_bus_uses_a_clock_that_runs_while_other_processes_have_the_machine(
    short_record: list[Encoded], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A monitor that did not run for more than five seconds asks its bus for the router."""
    clock_ns = itertools.count(10**18, 60 * 10**9)
    monkeypatch.setattr("time.time_ns", lambda: next(clock_ns))
    monkeypatch.setattr(scale, "record", lambda: short_record)
    assert scale.without_bus(1) > 0


def test_a_part_that_ends_early_shows_its_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    part = tmp_path / "part.py"
    part.write_text("raise SystemExit('no port is free')")
    monkeypatch.setattr(scale, "__file__", str(part))
    with pytest.raises(SystemExit, match=r"^scale\.py monitor 7: ended with 1 and without a result, see above$"):
        scale.start_part("monitor", 7)
    assert "no port is free" in capfd.readouterr().err
