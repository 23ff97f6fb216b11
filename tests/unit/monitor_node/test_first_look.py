"""The first look for causes of a process costs what later ones cost, and no more where rows are far apart."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from monitor_node import __main__ as monitor_main
from monitor_node.causes import stage
from monitor_node.causes.isolation import LOOK_STEPS, LOOK_STEPS_A_ROW, Isolation
from monitor_node.causes.window import MOST_PIECES, Row
from monitor_node.charts import shift_and_drift as drift
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import FleetConfig
from monitor_node.node import MonitorNode
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.codegen.compiled_function import ArrayFunction, CompiledFunction
from reactorwatch.kalman import error_dynamics
from reactorwatch.kalman.batch import StepCost
from reactorwatch.kalman.ekf_step import compiled_row, predict_function, row_function
from reactorwatch.kalman.filter_states import correction_function
from reactorwatch.process.library.cstr import cstr
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import EventLoop
from tests.memory_bus import Exchange, MemoryBus

from .faulty import SENSORS
from .samples import leaking_run, samples

CONFIG = MonitorConfig(training_min=15.0)
ROWS = 600


class Work:
    """Counts what is compiled, and the rows that filters go through."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.compiled = self.calls = self.machine_rows = 0
        self._made = self._functions()
        compile_, fill, call = CompiledFunction._compile, CompiledFunction.fill, ArrayFunction.__call__

        def compiled(code: CompiledFunction, lanes: int) -> Any:
            self.compiled += 1
            return compile_(code, lanes)

        def filled(code: CompiledFunction, rows: int, *arrays: Any) -> int:
            done = fill(code, rows, *arrays)
            self.machine_rows += done if code._loop.chained else 0
            return done

        def called(function: ArrayFunction) -> None:
            self.calls += 1
            call(function)

        monkeypatch.setattr(CompiledFunction, "_compile", compiled)
        monkeypatch.setattr(CompiledFunction, "fill", filled)
        monkeypatch.setattr(ArrayFunction, "__call__", called)

    @staticmethod
    def _functions() -> int:
        kept = (row_function, compiled_row, predict_function, correction_function)
        return sum(item.cache_info().misses for item in kept) + len(error_dynamics._normalize.signatures)  # type: ignore[attr-defined]

    @property
    def made(self) -> int:
        """Number of functions made and pieces of machine code compiled so far."""
        return self.compiled + self._functions() - self._made

    def forget(self) -> None:
        """Count from now on."""
        self.compiled = self.calls = self.machine_rows = 0
        self._made = self._functions()


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    return Work(monkeypatch)


def faulty_rows(fault: str, period_min: float, after: int) -> list[Row]:
    """The newest rows of a record with a fault, up to some rows after its onset."""
    onset_min = ROWS * period_min
    config = PlantConfig(seed=4, period_min=period_min, faults=(f"{fault}@{onset_min}min",))
    record = simulate_record(config, ROWS + after)
    columns = (record.time_min, record.columns["qc"], record.columns["C"], record.columns["T"])
    rows = zip(*(item.tolist() for item in columns), strict=True)
    faulty: list[Row] = [(time_min, (flow,), (C, T)) for time_min, flow, C, T in rows]
    return faulty[-ROWS:]


def test_looks_of_a_monitor_that_is_prepared_compile_nothing(work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model of its own, of which this process has compiled nothing yet."""
    steps: list[int] = []
    suspects = Isolation.suspects

    def noted(self: Isolation, *arguments: Any) -> list[Any]:
        before = work.made
        found = suspects(self, *arguments)
        steps.append(work.made - before)
        return found

    monkeypatch.setattr(Isolation, "suspects", noted)
    monitor = Monitor(CONFIG, 0, points=False, model=replace(cstr()))
    work.forget()
    assert sum(1 for _ in stage.preparation(CONFIG, monitor.pipeline.model)) > 10
    assert work.made > 40
    for message in samples(*leaking_run(-0.2, 18.0, 23.0, seed=3)):
        monitor.on_message(message, 0)
    assert len(steps) > 1
    assert set(steps) == {0}


@pytest.mark.parametrize("config", [MonitorConfig(isolation=False), MonitorConfig(reference="arx")])
def test_a_monitor_that_looks_for_no_causes_prepares_nothing(config: MonitorConfig) -> None:
    assert list(stage.preparation(config, Monitor(config, 0).pipeline.model)) == []


def test_an_error_in_what_is_prepared_is_left_to_the_first_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """There it is contained, counted and logged; a monitor starts all the same."""

    def fail(_: object) -> None:
        raise RuntimeError("made on purpose")

    monkeypatch.setattr("monitor_node.causes.isolation.Fitter._prepare", fail)
    assert len(list(stage.preparation(CONFIG, cstr()))) == 2
    monkeypatch.setattr("monitor_node.causes.isolation.GlrScan", fail)
    assert list(stage.preparation(CONFIG, cstr())) == []
    monitor = Monitor(CONFIG, 0, points=False)
    for message in samples(*leaking_run(-0.2, 18.0, 20.0, seed=3)):
        monitor.on_message(message, 0)
    assert monitor.failures.by_stage["isolation"] >= 1


def test_a_monitor_prepares_part_by_part_once_it_is_subscribed_and_then_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prepared: list[int] = []

    def preparation(*_: object) -> Iterator[None]:
        for part in range(3):
            prepared.append(part)
            yield

    def run(loop: EventLoop) -> None:
        node = loop._node
        assert isinstance(node, MonitorNode)
        assert prepared == []
        for parts in (1, 2, 3, 3, 3):
            now_ns = max(node.next_tick_ns(), node._poll_ns)
            node.on_tick(now_ns)
            node.on_tick(now_ns)  # within the tenth of a second
            assert len(prepared) == parts
        assert node.next_tick_ns() > now_ns + 10**9  # health: nothing else is due

    monkeypatch.setattr(drift, "preparation", lambda *_, **__: iter(()))
    monkeypatch.setattr(stage, "preparation", preparation)
    monkeypatch.setattr(EventLoop, "run", run)
    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.connect", lambda *_: MemoryBus(Exchange()))
    monitor_main.run(MonitorConfig(), BusConfig())
    assert prepared == [0, 1, 2]


def test_a_fleet_prepares_before_it_joins_the_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def preparation(*_: object) -> Iterator[None]:
        done.append("prepared")
        yield

    monkeypatch.setattr(stage, "preparation", preparation)
    monkeypatch.setattr("reactorwatch.runtime.bus_zenoh.connect", lambda *_, **__: done.append("connected"))
    monitor_main.run(CONFIG, BusConfig(), fleet=FleetConfig(plants="reactor/*"))
    assert done == ["prepared", "connected"]


@pytest.mark.parametrize("period_min", [0.1, 0.2, 1.0, 15.0])
def test_a_look_takes_no_more_steps_where_rows_are_far_apart(period_min: float, work: Work) -> None:
    """What is counted as a step is at least a row of machine code, or a third of a call on the way to a single row."""
    isolation, rows = Isolation(cstr(), SENSORS), faulty_rows("coolant_flow:step:-0.3", period_min, 100)
    work.forget()
    isolation.suspects(rows, since_rows=100)
    spent, limit = isolation.budget.spent, LOOK_STEPS + LOOK_STEPS_A_ROW * ROWS
    assert spent <= limit + StepCost.SEARCH + MOST_PIECES + ROWS
    assert work.machine_rows + 3 * work.calls <= spent


@pytest.mark.parametrize(
    ("fault", "period_min", "after"),
    [
        ("coolant_flow:step:-0.05", 0.2, 100),
        ("temperature_bias:step:30", 0.5, 30),
        ("temperature_bias:step:30", 1.0, 10),
    ],
)
def test_a_fault_is_found_within_the_budget_where_rows_are_far_apart(fault: str, period_min: float, after: int) -> None:
    isolation = Isolation(cstr(), SENSORS)
    likeliest = isolation.suspects(faulty_rows(fault, period_min, after), since_rows=after)[0]
    assert not isolation.stopped
    assert (likeliest.cause, likeliest.probability > 0.5) == (fault.split(":")[0], True)
