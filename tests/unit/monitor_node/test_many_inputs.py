"""Plants with no, one or several inputs: monitored, resumed, replayed and back-tested alike, whatever is missing."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay import backtest
from monitor_node.replay.verification import verify
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Estimate, Incident, Quality, Sample
from reactorwatch.process import EFFECTS_OF
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import Output, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator

from .samples import Rows

ROW_NS = 6 * 10**9
TRAINING_ROWS = 80
ROWS = 190
FAULT_ROW = 140
START_NS = 1_750_000_000 * 10**9


@dataclass(frozen=True)
class Plant:
    """Measured rows of a plant: inputs, then outputs; NaN where missing; shape (rows, signals)."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    values: Rows

    def config(self, **settings: object) -> MonitorConfig:
        defaults = {"training_min": TRAINING_ROWS * 0.1, "isolation": False, "priorities": {}, "smallest_sd": {}}
        return MonitorConfig(inputs=self.inputs, outputs=self.outputs, **(defaults | settings))  # type: ignore[arg-type]

    def messages(self) -> list[Encoded]:
        """The samples as the plant publishes them."""
        numbers = dict.fromkeys((*self.inputs, *self.outputs), 0)
        published = []
        for row, values in enumerate(self.values.tolist()):
            for name, value in zip(numbers, values, strict=True):
                if value == value:
                    sample = Sample(
                        time_ns=START_NS + row * ROW_NS,
                        sequence=numbers[name],
                        value=value,
                        quality=Quality.QUALITY_GOOD,
                    )
                    published.append(encode(Publication(keys.key("cstr", keys.SAMPLE, name), sample)))
                numbers[name] += 1
        return published


def linear_plant(inputs: int, outputs: int, seed: int, missing: float = 0.0) -> Plant:
    """Each output is a lag of all inputs with noise, and a fault moves the last one; some values are missing."""
    generator = np.random.default_rng(seed)
    u = np.repeat(generator.uniform(-1.7, 1.7, size=(ROWS // 5, inputs)), 5, axis=0)
    gains, state = generator.normal(size=(inputs, outputs)), np.zeros(outputs)
    y = np.empty((ROWS, outputs))
    for row in range(ROWS):
        y[row] = state + 0.3 * generator.normal(size=outputs)
        state = 0.7 * state + 0.3 * (u[row] @ gains)
    y[FAULT_ROW:, -1] += 12.0
    values = np.column_stack([u, y])
    values[generator.random(values.shape) < missing] = np.nan
    return Plant(tuple(f"u{i}" for i in range(inputs)), tuple(f"y{i}" for i in range(outputs)), values)


def live(monitor: Monitor, messages: list[Encoded]) -> list[Publication]:
    return [item for message in messages for item in monitor.on_message(message, START_NS)]


def alarms(publications: list[Publication]) -> list[bytes]:
    return [item.message.SerializeToString() for item in publications if isinstance(item.message, Alarm)]


def recording(config: MonitorConfig, messages: list[Encoded]) -> list[Encoded]:
    """Samples, and what a monitor publishes because of them."""
    monitor, log = Monitor(config, START_NS), []
    log += [encode(item) for item in monitor.on_tick(START_NS)]
    for message in messages:
        log.append(message._replace(received_ns=START_NS))
        log += [encode(item)._replace(received_ns=START_NS) for item in monitor.on_message(message, START_NS)]
    log += [encode(item) for item in monitor.on_stop(START_NS)]
    return log


@settings(max_examples=6)
@given(
    inputs=st.integers(0, 4),
    outputs=st.integers(1, 5),
    missing=st.sampled_from([0.0, 0.0, 0.01, 0.1]),
    stopped=st.floats(0.0, 1.0),
    seed=st.integers(0, 99),
)
def test_live_resumed_replayed_and_back_tested_alarms_are_the_same(
    inputs: int, outputs: int, missing: float, stopped: float, seed: int
) -> None:
    """And each output is watched, or named with the reason."""
    plant = linear_plant(inputs, outputs, seed, missing)
    check_equality(plant, plant.config(reference="arx"), stopped)


@pytest.mark.parametrize("inputs", [0, 2])
def test_with_a_black_box_they_are_the_same_too(inputs: int) -> None:
    plant = linear_plant(inputs, 2, seed=7)
    check_equality(plant, plant.config(), stopped=0.6)


def check_equality(plant: Plant, config: MonitorConfig, stopped: float) -> None:
    """Alarms live, resumed at a share of the samples, replayed and back-tested."""
    messages = plant.messages()
    monitor = Monitor(config, START_NS)
    published = live(monitor, messages) + monitor.finish()
    before, resumed, last = Monitor(config, START_NS), Monitor(config, START_NS), int(stopped * len(messages))
    first = live(before, messages[:last])
    resumed.from_bytes(before.to_bytes())
    resumed.on_history_end()
    assert alarms(first + live(resumed, messages[last:]) + resumed.finish()) == alarms(published)
    result = backtest.run(messages, config)
    assert [item.SerializeToString() for item in result.alarm_messages] == alarms(published)
    log = recording(config, messages)
    assert verify(lambda: log, config).exact
    assert monitor.failures.by_stage == {}
    estimated = {item.key.rpartition("/")[2] for item in published if isinstance(item.message, Estimate)}
    assert monitor.phase == "training" or estimated | set(result.exclusions) >= set(plant.outputs)


@pytest.mark.parametrize("inputs", range(5))
@pytest.mark.parametrize("outputs", [1, 5])
def test_a_fault_of_one_output_is_seen_with_any_number_of_inputs(inputs: int, outputs: int) -> None:
    plant = linear_plant(inputs, outputs, seed=3)
    result = backtest.run(plant.messages(), plant.config(reference="arx"))
    assert result.exclusions == {}
    raised = {alarm.alarm: alarm.raised_ns for alarm, _ in result.raised_alarms}
    assert raised[f"shewhart/y{outputs - 1}"] < START_NS + (FAULT_ROW + 6) * ROW_NS


def test_models_with_too_few_rows_for_their_parameters_lose_lags_then_inputs_and_the_training_reports_it() -> None:
    """80 rows suffice for seven parameters: three lags of the output, one of three inputs, and the constant."""
    few, many = (linear_plant(inputs, 2, seed=1) for inputs in (3, 8))
    notes = [
        [
            note
            for note in backtest.run(plant.messages(), plant.config(reference="arx")).notes
            if note.startswith("training") and "predicted with" in note
        ]
        for plant in (few, many)
    ]
    least = "as there are fewer than 10 rows a parameter"
    assert notes == [
        [f"training: y0, y1: predicted with 1 instead of 3 lags of the inputs, {least}"],
        [f"training: y0, y1: predicted with no input, {least}"],
    ]


@pytest.mark.parametrize("kind", ["constant", "collinear", "few values", "never there", "rare", "gone"])
def test_an_uninformative_input_hinders_no_monitor(kind: str) -> None:
    """The outputs are watched, and a fault of one is seen."""
    plant = linear_plant(2, 3, seed=5)
    u = plant.values[:, 1]
    u[:] = {
        "constant": np.full(ROWS, 7.0),
        "collinear": 2.0 * plant.values[:, 0] + 1.0,
        "few values": np.where(np.arange(ROWS) % 50 < 25, 0.0, 1.0),
        "never there": np.full(ROWS, np.nan),
        "rare": np.where(np.arange(ROWS) % 20, np.nan, u),
        "gone": np.where(np.arange(ROWS) > 20, np.nan, u),
    }[kind]
    monitor = Monitor(plant.config(reference="arx"), START_NS)
    published = live(monitor, plant.messages()) + monitor.finish()
    assert monitor.failures.by_stage == {}
    assert not set(plant.outputs) & set(monitor.excluded_signals)
    raised = [item.message.alarm for item in published if isinstance(item.message, Alarm)]
    assert {"shewhart/y2", "shift/y2"} & set(raised)
    assert ("u1" in monitor.excluded_signals) == (kind in ("never there", "rare", "gone"))


def tanks(seed: int = 2, rows: int = ROWS, model: ProcessModel | None = None) -> Plant:
    """The three tanks in closed loop, a row every six seconds: each pump holds the level of its tank."""
    generator, simulator = np.random.default_rng(seed), Simulator(model or three_tanks())
    state, u = np.array([41.0, 32.0, 36.6]), np.array([21.37, 53.80])
    values = np.empty((rows, 5))
    for row in range(rows):
        measured = state + generator.normal(size=3) * 0.1
        u = np.clip(u + 2.0 * (np.array([41.0, 32.0]) + (row // 30) % 2 - measured[:2]) * 0.1, 0.0, 150.0)
        values[row] = *u, *measured
        state = simulator.run(np.array([row, row + 1]) * 0.1, np.array([u, u]), state).states[-1]
    if model is None:
        values[FAULT_ROW:, 4] += 2.0
    return Plant(("Q1", "Q2"), ("h1", "h2", "h3"), values)


@pytest.mark.parametrize("missing", [0.0, 0.02])
def test_equations_with_two_inputs_judge_a_plant_in_closed_loop(missing: float) -> None:
    """Row by row as stage by stage, resumed at each tenth row, and with the inputs named in another order."""
    plant = tanks()
    plant.values[np.random.default_rng(1).random(plant.values.shape) < missing] = np.nan
    config, messages, model = plant.config(diagnose_training=False), plant.messages(), three_tanks()
    monitor, staged = (Monitor(config, START_NS, model=model) for _ in range(2))
    staged.pipeline.evaluation.find_ordinary = lambda *_: False  # type: ignore[method-assign]
    published = [live(monitor, [message]) for message in messages]
    assert monitor.pipeline.reference == "equations"
    assert [live(staged, [message]) for message in messages] == published
    raised = [item.message.alarm for told in published for item in told if isinstance(item.message, Alarm)]
    assert raised[0] == "shewhart/h3" or "mewma/all" in raised[:2]
    again = Monitor(config, START_NS, model=model)
    resumed = []
    for first in range(0, len(messages), 50):
        later = Monitor(config, START_NS, model=model)
        later.from_bytes(again.to_bytes())
        later.on_history_end()
        again = later
        resumed += [live(again, [message]) for message in messages[first : first + 50]]
    assert resumed == published
    swapped = MonitorConfig(
        **{name: getattr(config, name) for name in config.__struct_fields__} | {"inputs": ("Q2", "Q1")}
    )
    assert [live(other, [m]) for other in [Monitor(swapped, START_NS, model=model)] for m in messages] == published


OF_CODE = replace(three_tanks(), name="code", effects=EFFECTS_OF["three_tanks"])
"""A model that no catalogue has, with effects of its own."""


@pytest.mark.parametrize(
    ("cause", "size", "kind", "equations"),
    [
        ("clog13", 0.3, "process", three_tanks()),
        ("h3.bias", 2.0, "sensor", three_tanks()),
        ("clog13", 0.3, "process", OF_CODE),
    ],
)
def test_the_cause_of_an_alarm_is_sought_among_the_effects_of_a_process_with_two_inputs(
    cause: str, size: float, kind: str, equations: ProcessModel
) -> None:
    """And a monitor that was stopped in the search names the same suspects."""
    effect = next(item for item in EFFECTS_OF["three_tanks"] if item.name == cause)
    model = effect.extend(three_tanks(), STEP)
    faulty = model.with_values({f"{cause}.size": size, f"{cause}.onset": FAULT_ROW * 0.1})
    plant = tanks(seed=5, model=faulty)
    if kind == "sensor":
        plant.values[FAULT_ROW:, 4] += size
    config, messages = plant.config(diagnose_training=False, isolation=True), plant.messages()
    monitor = Monitor(config, START_NS, model=equations)
    last = 5 * (FAULT_ROW + 8)
    live(monitor, messages[:last])
    resumed = Monitor(config, START_NS, model=equations)
    resumed.from_bytes(monitor.to_bytes())
    resumed.on_history_end()
    told = live(monitor, messages[last:])
    assert live(resumed, messages[last:]) == told
    incidents = [item.message for item in told if isinstance(item.message, Incident)]
    suspects = [incident.suspects[0] for incident in incidents if incident.suspects]
    assert suspects[-1].cause == cause
    assert suspects[-1].kind == kind
    assert suspects[-1].size == pytest.approx(size, rel=0.3)


def decay() -> ProcessModel:
    """A tank that drains by itself and is filled by a constant flow: a process without inputs."""
    h = variable("h", "m", (0.0, 10.0), 1.0, "level")
    k = parameter("k", 0.5, "1/min", (0.0, 10.0), "of the valve")
    return ProcessModel(
        name="decay",
        states=(h,),
        inputs=(),
        parameters=(k,),
        rhs=(1.0 - k.symbol * h.symbol,),
        outputs=(Output("h", "m", h.symbol),),
        clock=new_clock(),
    )


def test_equations_without_an_input_judge_a_plant() -> None:
    generator = np.random.default_rng(4)
    values = 2.0 + 0.01 * generator.normal(size=(ROWS, 1))
    values[FAULT_ROW:] += 0.2
    values[100:103] = np.nan
    plant = Plant((), ("h",), values)
    config, messages = plant.config(reference="process"), plant.messages()
    monitor, resumed = (Monitor(config, START_NS, model=decay()) for _ in range(2))
    first = live(monitor, messages[:120])
    resumed.from_bytes(monitor.to_bytes())
    resumed.on_history_end()
    assert monitor.pipeline.reference == "equations"
    told = live(monitor, messages[120:])
    assert live(resumed, messages[120:]) == told
    assert not alarms(first)
    assert next(item.message.alarm for item in told if isinstance(item.message, Alarm)) in ("shewhart/h", "ewma/h")


def test_a_sensor_that_reads_too_much_is_suspected_in_a_process_without_inputs() -> None:
    values = 2.0 + 0.01 * np.random.default_rng(4).normal(size=(ROWS, 1))
    values[FAULT_ROW:] += 0.2
    plant = Plant((), ("h",), values)
    found = backtest.run(plant.messages(), plant.config(reference="equations", isolation=True), model=decay())
    assert {item.cause for item in found.alarms[0].suspect[:2]} == {"h.bias", "h.gain"}
    assert not [note for note in found.notes if "not diagnosed" in note]
