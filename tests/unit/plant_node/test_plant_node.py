"""The plant as a node: pace, commands, faults and health on the bus, with a clock that the test holds."""

import threading
from math import inf

import pytest
from google.protobuf.message import Message

from plant_node.__main__ import serve_plant
from plant_node.config import PlantConfig
from plant_node.node import BATCH, PlantNode
from plant_node.record import plant_from, simulate_record
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import (
    ClearFault,
    CommandReply,
    Fault,
    Health,
    InjectFault,
    Quality,
    Sample,
    SetInput,
)
from reactorwatch.process.library.cstr_operation import TemperatureControl
from reactorwatch.runtime.event_loop import StopSignal
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S, running

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


class Bench:
    """A node and what it said to people."""

    def __init__(self, **settings: object) -> None:
        self.config = PlantConfig(**settings)  # type: ignore[arg-type]
        self.logged: list[str] = []
        self.node = PlantNode(plant_from(self.config), self.config, self.logged.append)

    def ask(self, name: str, message: Message, now_ns: int = START_NS) -> CommandReply:
        question = Encoded(f"reactor/{self.config.name}/command/{name}", *encode_message(message))
        reply, publications = self.node.on_command(question, now_ns)
        assert publications == []
        return reply

    def run(self, tick_ns: int, now_ns: int = START_NS) -> list[Publication]:
        """All publications until it is finished, ticked at a fixed interval."""
        publications: list[Publication] = []
        while not self.node.finished:
            publications += self.node.on_tick(now_ns)
            now_ns += tick_ns
        return publications


def of_kind(publications: list[Publication], kind: str) -> list[Publication]:
    return [item for item in publications if item.key.split("/")[2] == kind]


def health_in(publications: list[Publication]) -> list[Health]:
    return [item.message for item in publications if isinstance(item.message, Health)]


def faults_in(publications: list[Publication]) -> list[Fault]:
    return [item.message for item in publications if isinstance(item.message, Fault)]


def test_a_row_is_three_samples() -> None:
    bench = Bench(name="pilot", seed=2)
    samples = of_kind(bench.node.on_tick(START_NS), "sample")
    record = simulate_record(bench.config, 1)
    assert [item.key for item in samples] == [f"reactor/pilot/sample/{signal}" for signal in ("qc", "C", "T")]
    for item, unit in zip(samples, ("l/min", "mol/l", "K"), strict=True):
        value = record.columns[item.key.rpartition("/")[2]][0]
        assert item.message == Sample(
            time_ns=START_NS, sequence=0, value=value, unit=unit, quality=Quality.QUALITY_GOOD
        )


def test_time_stamps_are_plant_time_after_the_zero() -> None:
    bench = Bench(duration_min=0.3, speed=inf, zero_ns=5_000)
    samples = [item.message for item in of_kind(bench.run(1), "sample")]
    assert [item.time_ns for item in samples[::3]] == [5_000, 6 * SECOND_NS + 5_000, 12 * SECOND_NS + 5_000]
    assert [item.sequence for item in samples[::3] if isinstance(item, Sample)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("speed", "tick_ns"), [(inf, 1), (1.0, SECOND_NS), (1.0, 7 * SECOND_NS), (600.0, 3_333_333), (1e4, SECOND_NS)]
)
def test_rows_are_the_same_bits_at_any_pace(speed: float, tick_ns: int) -> None:
    settings = {"seed": 5, "zero_ns": START_NS, "duration_min": 50.0, "faults": ("coolant_flow:step:-0.05@20min",)}
    expected = simulate_record(PlantConfig(**settings), 500)  # type: ignore[arg-type]
    publications = Bench(speed=speed, **settings).run(tick_ns)
    for signal in ("qc", "C", "T"):
        values = [
            item.message.value
            for item in publications
            if isinstance(item.message, Sample) and item.key.endswith(f"/{signal}")
        ]
        assert values == expected.columns[signal].tolist()
    assert [(item.cause, item.onset_ns - START_NS) for item in faults_in(publications)] == [
        ("coolant_flow", 20 * 60 * SECOND_NS)
    ]


def test_rows_come_when_they_are_due() -> None:
    """60 times as fast as the clock, a row every tenth of a minute is a row every tenth of a second."""
    node = Bench(speed=60.0).node
    assert node.next_tick_ns() <= START_NS
    assert len(of_kind(node.on_tick(START_NS), "sample")) == 3
    assert node.next_tick_ns() == START_NS + SECOND_NS // 10
    assert node.on_tick(START_NS + SECOND_NS // 10 - 1) == []
    assert len(of_kind(node.on_tick(START_NS + SECOND_NS // 10), "sample")) == 3


def test_a_plant_that_is_behind_leaves_no_row_out_and_reports_its_lag() -> None:
    """After 10 s without a tick the last of the rows now due is on time; a batch short of that it is not."""
    bench = Bench(speed=60.0)
    bench.node.on_tick(START_NS)
    caught_up = bench.node.on_tick(START_NS + 10 * SECOND_NS)
    assert len(of_kind(caught_up, "sample")) == 3 * 100
    assert health_in(caught_up)[0].lag_ms == 0
    far_behind = bench.node.on_tick(START_NS + 70 * SECOND_NS)
    assert len(of_kind(far_behind, "sample")) == 3 * BATCH
    assert health_in(far_behind)[0].lag_ms == 40_000
    assert bench.logged == ["behind its pace by 40.0 s; no row is left out"]
    assert bench.node.next_tick_ns() <= START_NS + 70 * SECOND_NS


def test_it_is_finished_after_its_duration() -> None:
    bench = Bench(duration_min=2.0, speed=inf)
    before = bench.node.finished
    assert len(of_kind(bench.run(1), "sample")) == 3 * 20
    assert (before, bench.node.finished) == (False, True)
    assert of_kind(bench.node.on_tick(START_NS + SECOND_NS), "sample") == []


def test_health_is_published_every_period_and_at_the_end() -> None:
    bench = Bench(speed=60.0, health_period_s=2.0)
    publications: list[Publication] = []
    for tenth in range(45):
        publications += bench.node.on_tick(START_NS + tenth * SECOND_NS // 10)
    bench.ask("set_input", SetInput(signal="T", value=1.0))
    found = health_in(publications)
    assert [(item.uptime_s, item.rows, item.phase) for item in found] == [
        (0.0, 1, "running"),
        (2.0, 21, "running"),
        (4.0, 41, "running"),
    ]
    assert [item.published for item in found] == [4, 65, 126]
    (last,) = health_in(bench.node.on_stop(START_NS + 5 * SECOND_NS))
    assert (last.phase, last.uptime_s, last.rows, last.published) == ("stopped", 5.0, 45, 3 * 45 + 4)
    assert (last.node, last.received, last.refused) == ("plant", 1, 1)


def test_under_control_the_reply_states_whether_it_is_manual_or_automatic() -> None:
    bench = Bench(temperature_control=TemperatureControl(), duration_min=1.0)
    texts = [
        bench.ask("set_input", SetInput(signal=name, value=value)).text for name, value in (("qc", 95), ("T", 440))
    ]
    assert texts == ["qc = 95 l/min from 0 min on, on manual", "T = 440 K from 0 min on, on automatic"]


def test_set_input_acts_from_the_next_row_on() -> None:
    bench = Bench(scenario="constant", noise_sd={"C": 0, "T": 0}, speed=60.0)
    bench.node.on_tick(START_NS)
    reply = bench.ask("set_input", SetInput(signal="qc", value=95.0))
    assert (reply.accepted, reply.text) == (True, "qc = 95 l/min from 0.1 min on")
    (sample, *_) = of_kind(bench.node.on_tick(START_NS + SECOND_NS // 10), "sample")
    assert isinstance(sample.message, Sample)
    assert sample.message.value == 95.0
    assert bench.logged == [reply.text]


def test_a_fault_is_published_in_the_rows_in_which_it_starts_and_ends() -> None:
    bench = Bench(speed=60.0, zero_ns=0)
    now_ns = START_NS
    bench.node.on_tick(now_ns)
    reply = bench.ask("inject_fault", InjectFault(specification="coolant_flow:step:-0.05@15s"))
    assert (reply.accepted, reply.text) == (True, "fault coolant_flow:step:-0.05@0.25min is in the plant")
    told: list[list[Publication]] = []
    for tenth in range(1, 7):
        if tenth == 5:
            reply = bench.ask("clear_fault", ClearFault(cause="coolant_flow"))
            assert (reply.accepted, reply.text) == (
                True,
                "fault coolant_flow:step:-0.05@0.25min is taken away from 0.5 min on",
            )
        told.append(of_kind(bench.node.on_tick(now_ns + tenth * SECOND_NS // 10), "fault"))
    assert [len(item) for item in told] == [0, 0, 1, 0, 1, 0]
    (there,), (gone,) = told[2], told[4]
    assert there.key == gone.key == "reactor/cstr/fault/coolant_flow"
    specification = "coolant_flow:step:-0.05@0.25min"
    assert there.message == Fault(
        time_ns=18 * SECOND_NS, cause="coolant_flow", specification=specification, active=True, onset_ns=15 * SECOND_NS
    )
    assert gone.message == Fault(
        time_ns=30 * SECOND_NS, cause="coolant_flow", specification=specification, active=False, onset_ns=15 * SECOND_NS
    )


@pytest.mark.parametrize(
    ("name", "message", "why"),
    [
        ("set_input", SetInput(signal="T", value=1.0), "unknown input 'T' (valid: qc)"),
        ("set_input", SetInput(signal="qc", value=-1.0), "qc must be in [0, 500] l/min, got -1"),
        ("inject_fault", InjectFault(specification="leak"), "fault 'leak': must be cause:profile:size"),
        (
            "inject_fault",
            InjectFault(specification="coolant_flow:ramp:0.1"),
            "fault 'coolant_flow:ramp:0.1': end (when it reaches its size) must be given",
        ),
        ("clear_fault", ClearFault(cause="heat_transfer"), "no fault 'heat_transfer' is in the plant (there is: none)"),
        ("stop", SetInput(), "unknown command 'stop' (valid: set_input, inject_fault, clear_fault)"),
        (
            "set_input",
            ClearFault(cause="x"),
            "command set_input must carry 'application/protobuf;reactorwatch.v1.SetInput', "
            "got 'application/protobuf;reactorwatch.v1.ClearFault'",
        ),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_reason(name: str, message: Message, why: str) -> None:
    bench = Bench()
    reply = bench.ask(name, message)
    assert not reply.accepted
    assert reply.text.startswith(why)
    assert len(reply.text.splitlines()) == 1
    assert bench.logged == []
    (last,) = health_in(bench.node.on_stop(START_NS))
    assert (last.received, last.refused, sum(last.refused_by_reason.values())) == (1, 1, 1)


def test_it_waits_for_the_nodes_in_its_settings_and_serves_commands_while_it_runs() -> None:
    """No sample before the monitor is alive; then an endless run in a thread obeys, until it is asked to stop."""
    config = PlantConfig(speed=600.0, wait_for=("monitor",))
    exchange = Exchange()
    operator, bus, monitor = MemoryBus(exchange), MemoryBus(exchange), MemoryBus(exchange)
    stop, plant_alive, first_sample, leak_told = StopSignal(), *(threading.Event() for _ in range(3))
    operator.subscribe_liveliness("reactor/cstr/alive/plant", lambda key, is_alive: plant_alive.set())
    operator.subscribe("reactor/cstr/sample/*", lambda message: first_sample.set())
    operator.subscribe("reactor/cstr/fault/coolant_flow", lambda message: leak_told.set())
    node = PlantNode(plant_from(config), config, lambda text: None)
    with running(lambda: serve_plant(node, config, bus, stop), stop):
        assert plant_alive.wait(WITHIN_S)
        assert not first_sample.is_set()
        monitor.declare_token("reactor/cstr/alive/monitor")
        assert first_sample.wait(WITHIN_S)
        question = InjectFault(specification="coolant_flow:step:-0.05")
        operator.query(Encoded("reactor/cstr/command/inject_fault", *encode_message(question)), 1.0)
        assert leak_told.wait(WITHIN_S)


def test_asked_to_stop_while_it_waits_it_stops() -> None:
    config = PlantConfig(wait_for=("monitor",))
    exchange = Exchange()
    operator, bus = MemoryBus(exchange), MemoryBus(exchange)
    stop, alive = StopSignal(), threading.Event()
    heard: list[Encoded] = []
    operator.subscribe("reactor/**", heard.append)
    operator.subscribe_liveliness("reactor/cstr/alive/plant", lambda key, is_alive: alive.set())
    node = PlantNode(plant_from(config), config, lambda text: None)
    with running(lambda: serve_plant(node, config, bus, stop), stop):
        assert alive.wait(WITHIN_S)
    assert [item.key for item in heard] == ["reactor/cstr/health/plant"]
