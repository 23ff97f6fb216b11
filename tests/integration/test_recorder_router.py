"""The recorder on a real Zenoh router: nothing is lost, and the file is whole however it ends."""

import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

import pytest

from benchmarks.harness.site import Heard
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, decode, encode
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus_zenoh import ZenohBus
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from recorder import RecordedMessage
from recorder.__main__ import record
from recorder.config import RecorderConfig, ReplayConfig
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.replay import replay
from tests.running import WITHIN_S, running
from tests.unit.recorder import golden

from .client import client

pytestmark = pytest.mark.usefixtures("plain_log")

ALIVE = "reactor/cstr/alive/recorder"
HEALTH_S = 0.2  # a machine busy with other tests may fall silent for long, so the recorder is asked what it has heard


def wait_alive(bus: ZenohBus) -> None:
    there = threading.Event()
    bus.subscribe_liveliness(ALIVE, lambda _, alive: there.set() if alive else None)
    assert there.wait(WITHIN_S), "the recorder does not show that it is alive"


def samples(count: int) -> Iterator[Encoded]:
    for number in range(count):
        for signal_name in ("qc", "C", "T"):
            sample = messages.Sample(
                time_ns=number, sequence=number, value=number / 7, unit="x", quality=messages.QUALITY_GOOD
            )
            yield encode(Publication(keys.key("cstr", keys.SAMPLE, signal_name), sample))


def of_others(path: Path) -> list[RecordedMessage]:
    return [entry for entry in Recording(path).messages() if not entry.key.endswith("health/recorder")]


def test_a_burst_is_recorded_without_a_loss_and_in_order(tmp_path: Path, bus_config: BusConfig) -> None:
    path, stop = tmp_path / "run.mcap", StopSignal()
    sent = list(samples(10_000))
    config = RecorderConfig(out=str(path), health_period_s=HEALTH_S)
    with running(lambda: record(config, bus_config, stop), stop), client(bus_config) as plant:
        wait_alive(plant)
        heard = Heard(plant)
        for message in sent:
            plant.publish(message)
        assert heard.wait(len(sent))
    assert [(entry.key, entry.payload, entry.encoding) for entry in of_others(path)] == [item[:3] for item in sent]
    last = list(Recording(path).messages())[-1]
    health = decode(last.payload, last.encoding)
    assert isinstance(health, messages.Health)
    assert (health.phase, health.lost, health.duplicated, health.refused) == ("stopped", 0, 0, 0)
    assert health.received >= len(sent)


def test_foreign_messages_on_the_bus_do_it_no_harm(tmp_path: Path, bus_config: BusConfig) -> None:
    path, stop = tmp_path / "run.mcap", StopSignal()
    strange = [
        Encoded("reactor/cstr/sample/T", b"\xff\xfe", "application/json"),
        Encoded("reactor/cstr/sample/T", b"\xff\xfe", "application/protobuf;reactorwatch.v1.Sample"),
        Encoded("reactor/a/b/c/d", b"", "zenoh/bytes"),
        Encoded("reactor", b"x", "text/plain"),
    ]
    config = RecorderConfig(out=str(path), health_period_s=HEALTH_S)
    with running(lambda: record(config, bus_config, stop), stop), client(bus_config) as other:
        wait_alive(other)
        heard = Heard(other)
        for message in (*strange, *samples(1)):
            other.publish(message)
        assert heard.wait(len(strange) + 3)
    entries = of_others(path)
    assert [(entry.key, entry.payload, entry.encoding) for entry in entries[:4]] == [item[:3] for item in strange]
    assert len(entries) == 7


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_process_with_the_file_closed(
    tmp_path: Path, bus_config: BusConfig, number: signal.Signals
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(
        f'[bus]\nendpoint = "{bus_config.endpoint}"\n[recorder]\nout = "{tmp_path}"\nhealth_period_s = {HEALTH_S}\n'
    )
    process = subprocess.Popen([sys.executable, "-m", "recorder", settings], stderr=subprocess.PIPE, text=True)
    try:
        with client(bus_config) as plant:
            wait_alive(plant)
            heard = Heard(plant)
            for message in samples(100):
                plant.publish(message)
            assert heard.wait(300)
        process.send_signal(number)
        _, said = process.communicate(timeout=WITHIN_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, said
    (path,) = tmp_path.glob("*.mcap")
    assert not list(tmp_path.glob("*.part"))
    assert Counter(entry.key for entry in of_others(path)) == dict.fromkeys(
        (keys.key("cstr", keys.SAMPLE, name) for name in ("qc", "C", "T")), 100
    )
    assert str(path) in said


def test_a_recorder_that_never_finds_a_router_leaves_no_file(tmp_path: Path) -> None:
    stop = StopSignal()
    config = RecorderConfig(out=str(tmp_path))
    with running(lambda: record(config, BusConfig(endpoint="tcp/127.0.0.1:1"), stop), stop):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("files", [1, 3], ids=["a file", "a folder of three"])
def test_a_replay_that_waits_for_the_recorder_is_recorded_bit_for_bit(
    tmp_path: Path, bus_config: BusConfig, files: int
) -> None:
    first, second, stop = tmp_path / "first", tmp_path / "second.mcap", StopSignal()
    first.mkdir()
    entries = list(golden.entries())
    for number in range(files):
        with RecordingWriter(first / f"{number}.mcap", {}) as writer:
            for entry in entries[number * len(entries) // files : (number + 1) * len(entries) // files]:
                writer.write(entry)
    if files == 1:
        first /= "0.mcap"
    played = ReplayConfig(file=str(first), rate=float("inf"), wait_for=("recorder",))
    player = threading.Thread(target=replay, args=(played, bus_config, StopSignal()))
    player.start()
    recorded = RecorderConfig(out=str(second), health_period_s=HEALTH_S)
    played_back = [
        (entry.key, entry.payload, entry.publish_time_ns) for entry in golden.entries() if "/sample/" in entry.key
    ]
    with client(bus_config) as listener, running(lambda: record(recorded, bus_config, stop), stop):
        heard = Heard(listener)
        player.join(WITHIN_S)
        assert not player.is_alive()
        assert heard.wait(len(played_back))
    kept = [(entry.key, entry.payload, entry.publish_time_ns) for entry in of_others(second)]
    assert kept == played_back


def test_a_part_of_a_recording_is_replayed_under_another_name(tmp_path: Path, bus_config: BusConfig) -> None:
    path, heard = tmp_path / "run.mcap", SimpleQueue[Encoded]()
    with RecordingWriter(path, {}) as writer:
        for entry in golden.entries():
            writer.write(entry)
    played = ReplayConfig(file=str(path), from_min=10.0, to_min=10.3, plant="twin", rate=float("inf"))
    with client(bus_config) as operator:
        operator.subscribe("reactor/twin/sample/*", heard.put)
        assert replay(played, bus_config, StopSignal()) == 12
        bodies = [messages.Sample.FromString(heard.get(timeout=WITHIN_S).payload) for _ in range(12)]
    minutes = [(body.time_ns - golden.ZERO_NS) / 60e9 for body in bodies]
    assert minutes == [10.0] * 3 + [10.1] * 3 + [10.2] * 3 + [10.3] * 3
    assert heard.empty()


def test_a_replay_that_waits_in_vain_can_be_stopped(tmp_path: Path, bus_config: BusConfig) -> None:
    csv, stop = tmp_path / "run.csv", StopSignal()
    csv.write_text("time_min,qc,C,T\n0,1,2,3\n")
    played = ReplayConfig(file=str(csv), wait_for=("nobody",))
    counts: list[int] = []
    with client(bus_config) as watcher:
        heard: list[str] = []
        watcher.subscribe("reactor/cstr/sample/*", lambda message: heard.append(message.key))
        with running(lambda: counts.append(replay(played, bus_config, stop)), stop):
            pass
    assert counts == [0]
    assert heard == []


def test_a_file_that_cannot_be_replayed_is_reported_before_the_wait_for_a_router(tmp_path: Path) -> None:
    empty, two, path = tmp_path / "empty.mcap", tmp_path / "two.mcap", tmp_path / "one.csv"
    path.write_text("time_min,qc,C,T\n0,1,2,3\n")
    with RecordingWriter(empty, {}), RecordingWriter(two, {}) as writer:
        for message in samples(1):
            writer.write(RecordedMessage(*message[:3], 0, 0))
            writer.write(RecordedMessage(message.key.replace("cstr", "b"), *message[1:3], 0, 0))
    for config, said in (
        (ReplayConfig(file=str(empty)), "holds no samples"),
        (ReplayConfig(file=str(two), plant="c"), "holds samples of b, cstr; they cannot all be played as 'c'"),
        (ReplayConfig(file=str(path), from_min=60.0), "holds nothing to play from 60 min to the end"),
        (ReplayConfig(file=str(tmp_path / "none.csv")), "there is no such file"),
    ):
        with pytest.raises(InputError, match=said):
            replay(config, BusConfig(endpoint="tcp/127.0.0.1:1"), StopSignal())
