"""The plant as a process of its own on a real router: it waits, runs, obeys, and leaves cleanly."""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from google.protobuf.message import Message

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import Encoded, decode, encode_message
from reactorwatch.contract.messages_pb2 import CommandReply, Fault, Health, InjectFault, Sample, SetInput
from reactorwatch.runtime.bus_zenoh import ZenohBus, connect, router
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.http_pages import free_endpoint

WITHIN_S = 60.0


@pytest.fixture
def bus_config() -> BusConfig:
    return BusConfig(endpoint=free_endpoint())


class Operator:
    """Hears everything on the bus, and waits for what it wants to hear."""

    def __init__(self, bus: ZenohBus) -> None:
        self.bus = bus
        self.heard: list[tuple[str, Message]] = []
        self.alive: set[str] = set()
        self._changed = threading.Condition()
        bus.subscribe_liveliness("reactor/**", self._on_alive)
        bus.subscribe("reactor/**", self._on_message)

    def messages(self, key: str) -> list[Message]:
        with self._changed:
            return [message for at, message in self.heard if at == key]

    def wait_for(self, key: str) -> None:
        self._wait_until(lambda: any(at == key for at, _ in self.heard), key)

    def wait_alive(self, key: str) -> None:
        self._wait_until(lambda: key in self.alive, key)

    def last_words(self) -> Health:
        """The plant's health at its end, once that is here and its token is gone."""

        def is_over() -> bool:
            return any(isinstance(item, Health) and item.phase == "stopped" for _, item in self.heard)

        self._wait_until(is_over, "last words")
        self._wait_until(lambda: "reactor/cstr/alive/plant" not in self.alive, "token")
        last = self.messages("reactor/cstr/health/plant")[-1]
        assert isinstance(last, Health)
        self._wait_until(lambda: len(self.heard) >= last.published, "all that it published")
        return last

    def _wait_until(self, condition: Callable[[], bool], what: str) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, WITHIN_S), what

    def ask(self, name: str, message: Message) -> CommandReply:
        question = Encoded(f"reactor/cstr/command/{name}", *encode_message(message))
        (answer,) = self.bus.query(question, WITHIN_S)
        reply = decode(answer.payload, answer.encoding)
        assert isinstance(reply, CommandReply)
        return reply

    def _on_message(self, message: Encoded) -> None:
        with self._changed:
            self.heard.append((message.key, decode(message.payload, message.encoding)))
            self._changed.notify_all()

    def _on_alive(self, key: str, is_alive: bool) -> None:
        with self._changed:
            (self.alive.add if is_alive else self.alive.discard)(key)
            self._changed.notify_all()


@pytest.fixture
def operator(bus_config: BusConfig) -> Iterator[Operator]:
    server = router(bus_config)
    client = connect(bus_config, "operator", StopSignal())
    assert client is not None
    yield Operator(client)
    client.close()
    server.close()


def start(folder: Path, bus_config: BusConfig, plant: str) -> subprocess.Popen[str]:
    settings = folder / "settings.toml"
    settings.write_text(f'[bus]\nendpoint = "{bus_config.endpoint}"\n\n[plant]\n{plant}\n', encoding="utf-8")
    command = [sys.executable, "-m", "plant_node", str(settings)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def end(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and what it said; a process that does not end is killed."""
    try:
        _, said = process.communicate(timeout=WITHIN_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return process.returncode, said


def test_a_run_of_given_duration_arrives_bit_for_bit(tmp_path: Path, bus_config: BusConfig, operator: Operator) -> None:
    process = start(
        tmp_path, bus_config, "speed = inf\nduration_min = 50.0\nseed = 4\nfaults = ['coolant_flow:step:-0.05@20min']"
    )
    code, said = end(process)
    assert code == 0, said
    assert "seed=4" in said
    last = operator.last_words()
    expected = simulate_record(PlantConfig(duration_min=50.0, seed=4))  # before the fault the same
    for name in ("qc", "C", "T"):
        samples = [item for item in operator.messages(f"reactor/cstr/sample/{name}") if isinstance(item, Sample)]
        assert [item.sequence for item in samples] == list(range(500))
        assert [item.value for item in samples[:201]] == expected.columns[name][:201].tolist()
    (fault,) = operator.messages("reactor/cstr/fault/coolant_flow")
    assert isinstance(fault, Fault)
    assert fault.time_ns == fault.onset_ns == samples[200].time_ns
    assert (last.rows, last.published) == (500, len(operator.heard))


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_an_endless_run_obeys_and_stops_when_asked(
    tmp_path: Path, bus_config: BusConfig, operator: Operator, how: signal.Signals
) -> None:
    process = start(tmp_path, bus_config, "speed = 60.0\nscenario = 'constant'\nnoise_sd = { C = 0.0, T = 0.0 }")
    try:
        operator.wait_for("reactor/cstr/sample/T")
        operator.wait_alive("reactor/cstr/alive/plant")
        assert operator.ask("set_input", SetInput(signal="qc", value=95.0)).accepted
        refused = operator.ask("inject_fault", InjectFault(specification="coolant_flow:step:9"))
        assert (refused.accepted, refused.text) == (
            False,
            "fault 'coolant_flow:step:9': size must be in [-0.99, 4], got 9",
        )
        assert operator.ask("inject_fault", InjectFault(specification="coolant_flow:step:-0.1")).accepted
        operator.wait_for("reactor/cstr/fault/coolant_flow")
    finally:
        process.send_signal(how)
        code, said = end(process)
    assert code == 0, said
    assert "Traceback" not in said
    last = operator.last_words()
    values = [item.value for item in operator.messages("reactor/cstr/sample/qc") if isinstance(item, Sample)]
    assert (values[0], values[-1]) == (100.0, 95.0)
    assert (last.received, last.refused) == (3, 1)


def test_without_a_router_it_reports_what_it_waits_for_and_can_be_stopped(
    tmp_path: Path, bus_config: BusConfig
) -> None:
    process = start(tmp_path, bus_config, "speed = inf\nduration_min = 1.0")
    assert process.stderr is not None
    said = ""
    for line in process.stderr:
        said += line
        if "waiting for a router" in line:
            break
    process.send_signal(signal.SIGTERM)
    code, rest = end(process)
    assert code == 0, said + rest
    assert bus_config.endpoint in said


def test_settings_that_cannot_be_used_end_it_with_one_line(tmp_path: Path, bus_config: BusConfig) -> None:
    code, said = end(start(tmp_path, bus_config, "sped = 2.0"))
    assert code == 2
    assert said.startswith("plant: settings [plant]: unknown key 'sped'; did you mean 'speed'? (valid: name, ")
    assert len(said.splitlines()) == 1
