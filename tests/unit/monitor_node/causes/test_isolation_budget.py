"""A search for causes stops at a budget of filter steps, whatever the sensors show, and reports it."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor_node.alarms.annunciator import STOPPED
from monitor_node.causes.isolation import LOOK_STEPS, LOOK_STEPS_A_ROW, UNKNOWN, Isolation
from monitor_node.causes.stage import START_STEPS, START_STEPS_A_ROW, Reconstruction, ReconstructionMemory
from monitor_node.causes.window import Row
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.watched_process import signal_ranges
from reactorwatch.contract.codec import Encoded
from reactorwatch.contract.messages_pb2 import Alarm, Incident, Sample
from reactorwatch.kalman.batch import BudgetExceededError, StepBudget, StepCost
from reactorwatch.kalman.ekf import Filter
from reactorwatch.process.library.cstr import cstr

from ..faulty import SENSORS, rows_of
from ..samples import leaking_run, samples

SIGNALS = ("qc", "C", "T")
CONFIG = MonitorConfig(training_min=20.0)
TRAINED, ROWS = 240, 330
RANGES = signal_ranges(cstr(), SIGNALS)


@pytest.fixture(scope="module")
def run() -> list[Encoded]:
    return list(samples(*leaking_run(0.0, 1.0, ROWS / 10, seed=9)))


@pytest.fixture(scope="module")
def trained(run: list[Encoded]) -> bytes:
    monitor = Monitor(CONFIG, 0, points=False)
    for message in run[: 3 * TRAINED]:
        monitor.on_message(message, 0)
    return monitor.to_bytes()


@pytest.fixture(scope="module")
def looks() -> Iterator[list[int]]:
    """The steps of each look."""
    found: list[int] = []
    suspects = Isolation.suspects

    def noted(self: Isolation, *arguments: Any) -> list[object]:
        try:
            return list(suspects(self, *arguments))
        finally:
            found.append(self.budget.spent)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Isolation, "suspects", noted)
        yield found


def with_value(message: Encoded, value: float) -> Encoded:
    sample = Sample.FromString(message.payload)
    sample.value = value
    return message._replace(payload=sample.SerializeToString())


def watched_on(state: bytes, messages: list[Encoded]) -> tuple[Monitor, list[Alarm]]:
    """A monitor that is started from a state, and the changes of its alarms."""
    monitor = Monitor(CONFIG, 0, points=False)
    monitor.from_bytes(state)
    said = [item.message for message in messages for item in monitor.on_message(message, 0)]
    return monitor, [item for item in said if isinstance(item, Alarm)]


@st.composite
def bad_runs(draw: st.DrawFn) -> list[tuple[int, int, int, float]]:
    """Signal, first row, rows and value of some runs of bad values, within the range of the signal and far out."""
    found = []
    for _ in range(draw(st.integers(1, 2))):
        signal = draw(st.integers(0, 2))
        within = st.floats(RANGES[signal].lower, RANGES[signal].upper)
        anything = st.floats(-1e15, 1e15, exclude_min=True, exclude_max=True) | st.sampled_from([3e10, -999.0, 65535.0])
        value = draw(within | st.sampled_from([RANGES[signal].lower, RANGES[signal].upper]) | anything)
        found.append((signal, draw(st.integers(0, 20)), draw(st.integers(1, 50)), value))
    return found


@settings(max_examples=10, deadline=None)
@given(bad=bad_runs())
def test_no_run_of_bad_values_fails_or_exceeds_the_budget_and_a_restart_over_it_does_neither(
    bad: list[tuple[int, int, int, float]], run: list[Encoded], trained: bytes, looks: list[int]
) -> None:
    """Runs of 1 to 50 values with isolation on; a monitor that is started again reads the same samples again."""
    values = {
        3 * (TRAINED + row) + signal: value for signal, first, rows, value in bad for row in range(first, first + rows)
    }
    messages = [with_value(m, values[at]) if at in values else m for at, m in enumerate(run)]
    looks.clear()
    monitor, alarms = watched_on(trained, messages[3 * TRAINED :])
    assert monitor.failures.by_stage == {}
    assert monitor.rows == ROWS + 1
    # Started again from what was stored before the bad values, with all samples since published again.
    again, repeated = watched_on(trained, messages[3 * (TRAINED - 20) :])
    assert again.failures.by_stage == {}
    assert [item.SerializeToString() for item in repeated] == [item.SerializeToString() for item in alarms]
    limit = LOOK_STEPS + LOOK_STEPS_A_ROW * CONFIG.isolation_rows
    assert max(looks, default=0) <= limit + StepCost.SEARCH + max(StepCost.RUN, CONFIG.isolation_rows)


def test_a_search_that_stopped_names_no_cause_and_the_incident_states_it(
    run: list[Encoded], trained: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty rows of 700 K, with 20,000 steps: few values exceed the full budget."""
    monkeypatch.setattr("monitor_node.causes.isolation.LOOK_STEPS_A_ROW", -300)
    bad = range(3 * TRAINED + 2, 3 * (TRAINED + 20), 3)
    messages = [with_value(m, 700.0) if at in bad else m for at, m in enumerate(run)]
    monitor = Monitor(CONFIG, 0, points=False)
    monitor.from_bytes(trained)
    published = [item.message for message in messages[3 * TRAINED :] for item in monitor.on_message(message, 0)]
    incidents = [item for item in published if isinstance(item, Incident)]
    stopped = [item for item in incidents if item.text == STOPPED]
    assert stopped
    assert all([suspect.cause for suspect in item.suspects] == [UNKNOWN] for item in stopped)
    assert not any(item.text for item in incidents if not item.suspects)


@pytest.mark.parametrize(("fault", "after_min"), [("coolant_flow:step:-0.3", 30.0), ("heat_transfer:step:-0.8", 30.0)])
def test_a_large_fault_of_the_catalogue_is_found_within_the_budget(fault: str, after_min: float) -> None:
    """These take many steps: up to nine tenths of the budget."""
    isolation = Isolation(cstr(), SENSORS)
    likeliest = isolation.suspects(rows_of(fault, seed=4, after_min=after_min))[0]
    assert not isolation.stopped
    assert likeliest.cause == fault.split(":")[0]
    assert isolation.budget.spent < 0.9 * (LOOK_STEPS + LOOK_STEPS_A_ROW * 600)


def test_the_start_of_a_reconstruction_has_a_budget() -> None:
    """Without its thermometer and with a wild analyser the filter begins again row after row, by a search each."""
    rows: list[Row] = [
        (time_min, flow, (2.0 * (place % 2), T)) for place, (time_min, flow, (_, T)) in enumerate(_sound())
    ]
    steps = []
    spend = StepBudget.spend

    def noted(self: StepBudget, count: int) -> None:
        steps.append(count)
        spend(self, count)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StepBudget, "spend", noted)
        found = Reconstruction(cstr(), SENSORS, ReconstructionMemory("T", "", [math.nan]))
        found.start(rows, rows[30][0])
    assert (
        0 < sum(steps) - START_STEPS - START_STEPS_A_ROW * len(rows) <= StepCost.SEARCH + StepCost.RUN
    )  # it stopped there
    time_min, flow, measured = rows[-1]
    found.update(time_min + 0.1, flow, measured)
    value, sd = found.update(time_min + 0.2, flow, measured)
    assert 250.0 <= value <= 700.0
    assert sd >= 0.0


def test_a_filter_without_a_budget_counts_nothing_and_one_with_stops_at_it() -> None:
    kalman = Filter(cstr(), SENSORS)
    rows = _sound()
    for time_min, flow, measured in rows[:20]:
        kalman.update(time_min, flow, measured)
    kalman.budget = StepBudget(100)
    for time_min, flow, measured in rows[20:24]:
        kalman.update(time_min, flow, measured)
    time_min, flow, measured = rows[24]
    with pytest.raises(BudgetExceededError, match="100 filter steps"):
        kalman.update(time_min, flow, measured)


def _sound() -> list[Row]:
    return rows_of(seed=6, after_min=1.0)
