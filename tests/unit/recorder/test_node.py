"""The recorder as a node on a bus within the process, and its settings."""

import math
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, decode, encode
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import section
from reactorwatch.runtime.event_loop import EventLoop, StopSignal
from reactorwatch.runtime.node_main import main
from recorder import RecordedMessage
from recorder.__main__ import run
from recorder.config import RecorderConfig, ReplayConfig
from recorder.files.recording import Recording
from recorder.node import RecorderNode
from recorder.recording_files import RecordingFiles
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S, running
from tests.unit.recorder import golden

SECOND = 10**9


def node_on(path: Path, start_ns: int = 0) -> tuple[RecorderNode, RecordingFiles]:
    config = RecorderConfig(out=str(path), flush_period_s=1.0)
    files = RecordingFiles(config)
    return RecorderNode(config, files, start_ns), files


def of_health(entry: RecordedMessage) -> messages.Health:
    health = decode(entry.payload, entry.encoding)
    assert isinstance(health, messages.Health)
    return health


def test_all_that_is_published_is_in_the_file_in_order_and_health_is_in_it_once(tmp_path: Path) -> None:
    exchange, stop, ready = Exchange(), StopSignal(), threading.Event()
    node, writer = node_on(tmp_path / "run.mcap", time.time_ns())
    reports: list[Encoded] = []
    MemoryBus(exchange).subscribe("reactor/cstr/health/recorder", reports.append)

    def run() -> None:
        with writer:
            loop = EventLoop(node, MemoryBus(exchange), stop)
            loop.subscribe(keys.EVERYTHING)
            ready.set()
            loop.run()

    plant = MemoryBus(exchange)
    published = [encode(publication) for publication in golden.publications()]
    with running(run, stop):
        assert ready.wait(WITHIN_S)
        for message in published:
            plant.publish(message)
        plant.publish(Encoded("elsewhere/x", b"", ""))
    entries = list(Recording(tmp_path / "run.mcap").messages())
    own = [entry for entry in entries if entry.key == "reactor/cstr/health/recorder"]
    others = [entry for entry in entries if entry not in own]
    assert [entry[:3] for entry in others] == [message[:3] for message in published]
    assert [entry.payload for entry in own] == [report.payload for report in reports]
    assert of_health(own[-1]).phase == "stopped"
    assert of_health(own[-1]).received == len(entries) - 1  # all but this report itself
    assert entries[-1] == own[-1]


def test_it_reports_at_once_and_then_every_period_and_flushes_between(tmp_path: Path) -> None:
    node, writer = node_on(tmp_path / "run.mcap", start_ns=100 * SECOND)
    part = tmp_path / "run.mcap.part"
    with writer:
        reported, grown = [], []
        for second in range(100, 112, 2):
            node.on_message(encode(next(golden.publications())), second * SECOND)
            while (now := node.next_tick_ns()) < (second + 2) * SECOND:
                size = part.stat().st_size
                if node.on_tick(now):
                    reported.append(now // SECOND)
                if part.stat().st_size > size:
                    grown.append(now // SECOND)
    assert reported == [100, 105, 110]
    assert grown == [101, 103, 105, 107, 109, 111]


def test_the_file_is_closed_when_the_loop_ends_by_an_exception(tmp_path: Path) -> None:
    class Broken(MemoryBus):
        def subscribe(self, key_expression: str, handler: Callable[[Encoded], None], **_: object) -> None:
            handler(message)
            stop.set()

        def publish(self, message: Encoded) -> None:
            raise ConnectionError("the link is gone")

    stop = StopSignal()
    message = encode(next(golden.publications()))
    node, writer = node_on(tmp_path / "run.mcap", time.time_ns())
    loop = EventLoop(node, Broken(Exchange()), stop)
    loop.subscribe(keys.EVERYTHING)
    with pytest.raises(ConnectionError), writer:
        loop.run()
    assert next(Recording(tmp_path / "run.mcap").messages()).payload == message.payload


def test_the_defaults_record_everything() -> None:
    config = section(RecorderConfig, "recorder", {}, {})
    assert (config.plant, config.key_expression, config.health_period_s) == ("cstr", "reactor/**", 5.0)


@pytest.mark.parametrize(
    ("values", "stated"),
    [
        ({"plant": "a/b"}, "plant name must be"),
        ({"health_period_s": 0.0}, "health_period_s must be positive and finite, got 0.0"),
        ({"flush_period_s": math.inf}, "flush_period_s must be positive and finite, got inf"),
        ({"flush_period_s": 1.5}, "flush_period_s must be at most 1, got 1.5"),
        ({"fsync": "often"}, "fsync: unknown word 'often' .valid: never, chunk, second"),
        ({"rotate_min": 0.0}, "rotate_min must be positive, or inf, got 0.0"),
        ({"keep_mb": math.nan}, "keep_mb must be positive, or inf, got nan"),
        ({"keep_files": 0.0}, "keep_files must be at least 1, or inf, got 0.0"),
        ({"black_box_min": -1.0}, "black_box_min must be finite and not negative, got -1.0"),
        ({"most_keys": 10}, r"most_keys must be in \[100, 60000\], got 10"),
        ({"most_keys": 60_001}, r"most_keys must be in \[100, 60000\], got 60001"),
        ({"period": 1}, "unknown key 'period'"),
    ],
)
def test_an_impossible_setting_is_reported_in_one_line(values: dict[str, object], stated: str) -> None:
    with pytest.raises(InputError, match=stated):
        section(RecorderConfig, "recorder", {"recorder": values}, {})


def test_a_replay_may_be_as_fast_as_it_goes_but_not_stand_still() -> None:
    assert section(ReplayConfig, "replay", {}, {"file": "x.csv", "rate": math.inf}).rate == math.inf
    with pytest.raises(InputError, match=r"rate must be positive, got 0\.0"):
        section(ReplayConfig, "replay", {}, {"file": "x.csv", "rate": 0.0})
    with pytest.raises(InputError, match="from_min must be before to_min, got 5 and 5"):
        section(ReplayConfig, "replay", {}, {"file": "x.csv", "from_min": 5.0, "to_min": 5.0})
    with pytest.raises(InputError, match="file"):
        section(ReplayConfig, "replay", {}, {})


def test_the_process_ends_with_2_and_one_line_before_it_looks_for_a_router(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(f'[recorder]\nout = "{tmp_path}/none/run.mcap"\n')
    monkeypatch.setattr(sys, "argv", ["recorder", str(settings)])
    assert main("recorder", "recorder", RecorderConfig, run) == 2
    assert (
        capsys.readouterr().err
        == f"recorder: recording {tmp_path}/none/run.mcap: the folder {tmp_path}/none does not exist\n"
    )
    monkeypatch.setattr(sys, "argv", ["recorder", "a", "b"])
    assert main("recorder", "recorder", RecorderConfig, run) == 2
    assert "usage: python -m recorder [settings.toml]" in capsys.readouterr().err
