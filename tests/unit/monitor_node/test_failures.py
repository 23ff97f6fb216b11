"""An error of this software in the work on one plant is contained, counted and reported, and harms no other plant."""

from typing import Any

import pytest

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.causes.isolation import Isolation
from monitor_node.charts.charts import ChartWatch
from monitor_node.checks.signal_checks import SilenceCheck
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.health import Failures
from monitor_node.watch.pipeline import PlantPipeline
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Health
from reactorwatch.errors import InputError

from .fleets import QUICK, SECOND_NS, alarms, alone, fleet, of, row_by_row

BROKEN = "b"
MINUTE_NS = 60_000_000_000


def fail_from(monkeypatch: pytest.MonkeyPatch, owner: type, name: str, from_ns: int = 25 * MINUTE_NS) -> None:
    """Let a method fail for the broken plant, in its rows from a time on."""
    method = getattr(owner, name)

    def failing(self: Any, *arguments: Any, **others: Any) -> Any:
        config = (self.board if isinstance(self, SilenceCheck) else self)._config
        times = [item for item in arguments if isinstance(item, int) and not isinstance(item, bool)]
        times += [item.time_ns for item in arguments if hasattr(item, "time_ns")]
        if config.plant == BROKEN and max(times, default=from_ns) >= from_ns:
            raise ZeroDivisionError("a number that was never zero before")
        return method(self, *arguments, **others)

    monkeypatch.setattr(owner, name, failing)


def health_message(said: list[Publication], plant: str) -> Health:
    (found,) = [item.message for item in said if item.key == f"reactor/{plant}/health/monitor"]
    assert isinstance(found, Health)
    return found


@pytest.mark.parametrize(
    ("owner", "name", "stage"),
    [
        (PlantPipeline, "update", "row"),
        (ChartWatch, "update", "row"),
        (SilenceCheck, "update", "row"),
        (Annunciator, "end_row", "row"),
        (PlantPipeline, "snapshots", "models"),
    ],
)
def test_an_error_in_one_plant_of_a_fleet_changes_nothing_for_the_others(
    owner: type,
    name: str,
    stage: str,
    runs: dict[str, list[Encoded]],
    expected: dict[str, list[Publication]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the stage: the others are judged as alone, value for value; the error is counted and reported once."""
    fail_from(monkeypatch, owner, name)
    monitors = fleet()
    said = []
    messages = row_by_row([runs["a"], runs[BROKEN], runs["c"]])
    for first in range(0, len(messages), 450):
        said += monitors.on_messages(messages[first : first + 450], first * SECOND_NS)
    assert of("a", said) == of("a", expected["a"])
    assert of("c", said) == of("c", expected["c"])
    health = health_message(monitors.on_stop(0), BROKEN)
    assert health.failures[stage] >= 1
    assert health.rows == 401
    notes = monitors.monitor(BROKEN).notes
    assert len([line for line in notes if "ZeroDivisionError" in line and "a number that was" in line]) == 1
    assert all("\n" not in line for line in notes)
    assert [plant for plant in monitors.plants if monitors.monitor(plant).failures.tracebacks] == [BROKEN]
    assert all("Traceback" in text for text in monitors.monitor(BROKEN).failures.tracebacks)


def test_alarms_stay_when_the_plant_is_learned_again_and_are_cleared_when_they_are_over(
    runs: dict[str, list[Encoded]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One error after an alarm: no alarm is raised twice, what is active stays active, and the count survives."""
    run, failed = runs[BROKEN], list[bool]()
    monitor = Monitor(MonitorConfig(plant=BROKEN, training_min=20.0, isolation=False), 0, points=False)
    said = [item for message in run[: 3 * 330] for item in monitor.on_message(message, 0)]
    active = {alarm.alarm for alarm in monitor.alarms.all_alarms() if alarm.raised_ns and not alarm.cleared_ns}
    assert active
    update = ChartWatch.update

    def failing(self: ChartWatch, *arguments: Any, **others: Any) -> None:
        if not failed:
            failed.append(True)
            raise IndexError("once")
        update(self, *arguments, **others)

    monkeypatch.setattr(ChartWatch, "update", failing)
    said += [item for message in run[3 * 330 :] for item in monitor.on_message(message, 0)]
    raised = [name for name, event, _ in alarms(said) if event == "raised"]
    assert len(raised) == len(set(raised))
    assert {alarm.alarm for alarm in monitor.alarms.all_alarms() if not alarm.cleared_ns and alarm.raised_ns} == active
    assert monitor.phase == "training"
    other = Monitor(monitor.config, 0, points=False)
    other.from_bytes(monitor.to_bytes())
    assert other.failures.by_stage == {"row": 1}
    assert other.to_bytes() == monitor.to_bytes()


def test_an_error_in_the_search_for_causes_costs_no_alarm_and_no_restart(
    runs: dict[str, list[Encoded]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is counted at each look and reported once; alarms are those of a monitor that does not look for causes."""

    def failing(_: Isolation, *__: Any) -> list[Any]:
        raise ValueError("min() arg is an empty sequence")

    monkeypatch.setattr(Isolation, "suspects", failing)
    monitor = Monitor(MonitorConfig(plant=BROKEN, training_min=20.0), 0, points=False)
    said = [item for message in runs[BROKEN] for item in monitor.on_message(message, 0)]
    without = alone(BROKEN, runs[BROKEN], QUICK)
    assert alarms(said) == alarms(without)
    assert monitor.phase == "watching"
    assert monitor.failures.by_stage["isolation"] > 1
    assert len([note for note in monitor.notes if "isolation" in note]) == 1
    assert health_message(monitor.on_stop(0), BROKEN).failures["isolation"] == monitor.failures.by_stage["isolation"]


def test_a_silence_that_cannot_be_checked_ends_no_monitor(
    runs: dict[str, list[Encoded]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor = Monitor(MonitorConfig(plant=BROKEN, training_min=20.0, isolation=False), 0, points=False)
    for message in runs[BROKEN][:900]:
        monitor.on_message(message, 0)
    fail_from(monkeypatch, SilenceCheck, "check", 0)
    said = monitor.on_tick(10**18)
    assert health_message(said, BROKEN).failures == {"silence": 1}


def test_errors_from_different_places_are_each_reported_once() -> None:
    failures = Failures()

    def fail(values: list[int]) -> None:
        min(values)

    for _ in range(4):
        try:
            fail([])
        except ValueError as error:
            failures.add("row", error, "it starts again")
    try:
        dict[str, int]()["x\ny"]
    except KeyError as error:
        failures.add("row", error, "it starts again")
    assert failures.by_stage == {"row": 5}
    assert len(failures.notes) == len(failures.tracebacks) == 2
    assert "fail, line" in failures.notes[0]
    assert "please report it" in failures.notes[0]
    assert "\n" not in "".join(failures.notes)


def test_settings_that_cannot_be_kept_end_the_monitor_of_one_plant_and_no_fleet() -> None:
    error = InputError("false_alarms_per_30_days must be larger")
    with pytest.raises(InputError, match="must be larger"):
        Failures().add("row", error, "the plant is learned again")
    many = fleet()
    many.register("b", 0, verified=True)
    one_of_many = many.monitor("b").failures
    one_of_many.add("row", error, "the plant is learned again")
    assert one_of_many.by_stage == {"row": 1}
