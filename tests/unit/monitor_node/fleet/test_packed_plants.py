"""Plants held as arrays: what is said of them and remembered is what monitors of their own have, bit for bit."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from monitor_node.alarms.annunciator import AnnunciatorState
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.monitor import FleetMonitor
from monitor_node.fleet.sharding import WHOLE, ShardGroup
from monitor_node.state.monitor_state import MonitorState
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, BaselineCommand, Health, Quality, Sample
from reactorwatch.process.library.three_tanks.model import three_tanks

from ..fleets import PLANTS, QUICK, alone, fleet, of, row_by_row, run_of, stage_by_stage
from ..test_many_inputs import tanks

ALL = MonitorConfig(training_min=20.0, isolation=False, charts=("shewhart", "ewma", "cusum", "mewma"))
LOOKING = MonitorConfig(training_min=20.0)
ROW_NS = 6_000_000_000
SPAN_MIN = 60.0


def changed(message: Encoded, **fields: Any) -> Encoded:
    """The same sample with other fields."""
    sample = Sample.FromString(message.payload)
    for name, value in fields.items():
        setattr(sample, name, value)
    return message._replace(payload=sample.SerializeToString())


def signal(run: list[Encoded], place: int) -> list[int]:
    """Where a run has the samples of a signal: 0 is qc, 1 is C, 2 is T."""
    return list(range(place, len(run), 3))


def spikes(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    for place in generator.choice(signal(run, 2)[250:], 5, replace=False).tolist():
        run[place] = changed(run[place], value=Sample.FromString(run[place].payload).value + 20.0)
    return run


def stuck(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    first = int(generator.integers(400, 470))
    value = Sample.FromString(run[3 * first + 2].payload).value
    for place in signal(run, 2)[first : first + 30]:
        run[place] = changed(run[place], value=value)
    return run


def coarse(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    for place in signal(run, 2):
        run[place] = changed(run[place], value=round(Sample.FromString(run[place].payload).value * 2) / 2)
    return run


def losses(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    gone = set(generator.choice(len(run) - 900, 6, replace=False) + 900)
    return [message for place, message in enumerate(run) if place not in gone]


def gaps(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    first = 3 * int(generator.integers(250, 330))
    return run[:first] + run[first + 30 : first + 600] + run[first + 606 :]


def repeats(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    for place in sorted(generator.choice(len(run), 8, replace=False).tolist(), reverse=True):
        run.insert(place, run[place])
    return run


def disorder(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    for place in generator.choice(len(run) - 10, 20, replace=False).tolist():
        run[place], run[place + 7] = run[place + 7], run[place]
    return run


def bad(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    strange: tuple[dict[str, Any], ...] = (
        {"quality": Quality.QUALITY_BAD},
        {"value": float("nan")},
        {"quality": 0},
        {"unit": "degC"},
        {"value": 1e31},
        {"value": -1e15},
        {"quality": 7},
        {"unit": "K" * 1000},
    )
    for fields, place in zip(strange, generator.choice(range(900, len(run)), 8, replace=False).tolist(), strict=True):
        run[place] = changed(run[place], **fields)
    return run


def set_back(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    first = 3 * int(generator.integers(320, 400))
    return run[:first] + [
        changed(message, sequence=place // 3, time_ns=Sample.FromString(message.payload).time_ns - 300 * ROW_NS)
        for place, message in enumerate(run[first:])
    ]


def irregular(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    late_ns = generator.integers(-(10**9), 10**9, len(run) // 3 + 1).tolist()
    return [
        changed(message, time_ns=Sample.FromString(message.payload).time_ns + late_ns[place // 3])
        for place, message in enumerate(run)
    ]


def two_of_a_name(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    """Another plant publishes as this one for a while."""
    other, first = run_of("x", 99, span_min=SPAN_MIN), int(generator.integers(900, 1200))
    for place in range(first + 60, first, -1):
        sample = Sample.FromString(other[place].payload)
        strange = changed(other[place], time_ns=sample.time_ns + 12345 * 10**9, sequence=sample.sequence + 50_000)
        run.insert(place, strange)
    return run


def damaged(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    strange: tuple[dict[str, Any], ...] = (
        {"time_ns": 0},
        {"time_ns": 2**62},
        {"time_ns": -(2**63)},
        {"sequence": 0},
        {"sequence": 2**62},
        {"sequence": 2**64 - 1},
        {"time_ns": 2**40, "sequence": 2**40},
    )
    for fields, place in zip(strange, sorted(generator.choice(range(900, len(run)), 7).tolist()), strict=True):
        run.insert(place, changed(run[place], **fields))
    return run


def paused(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    """The plant stands still for twenty minutes, and counts on."""
    return moved(run, 3 * int(generator.integers(320, 400)), 200 * ROW_NS)


def clock_set(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    return moved(run, 3 * int(generator.integers(320, 400)), -7 * ROW_NS)


def hurried(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    """One row of ten comes so early that it does not follow."""
    early = set(generator.choice(len(run) // 3, len(run) // 30, replace=False).tolist())
    return [
        changed(message, time_ns=Sample.FromString(message.payload).time_ns - ROW_NS // 3)
        if place // 3 in early
        else message
        for place, message in enumerate(run)
    ]


def moved(run: list[Encoded], first: int, by_ns: int) -> list[Encoded]:
    """The run with other times from a message on."""
    return run[:first] + [
        changed(message, time_ns=Sample.FromString(message.payload).time_ns + by_ns) for message in run[first:]
    ]


def out_of_range(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    """Values that the process cannot have, of each signal, alone and in runs."""
    for place, value in enumerate((-999.0, 9999.0, 65535.0, 1e14)):
        first, rows = int(generator.integers(300 + 60 * place, 340 + 60 * place)), 1 + 7 * place
        for at in signal(run, place % 3)[first : first + rows]:
            run[at] = changed(run[at], value=value)
    return run


def before_zero(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    """Time 0 is a row after the training."""
    return moved(run, 0, -400 * ROW_NS)


def sound(run: list[Encoded], generator: np.random.Generator) -> list[Encoded]:
    return run


UPSETS = (
    *(sound, spikes, stuck, coarse, losses, gaps, repeats, disorder, bad, set_back, irregular),
    *(two_of_a_name, damaged, paused, clock_set, hurried, out_of_range, before_zero),
)


def leaking_run(upset: object) -> list[Encoded]:
    """A run with a leak eight minutes before its end; after values out of range it takes longer to be quiet."""
    span_min = 100.0 if upset is out_of_range else SPAN_MIN
    return run_of("x", 11, leak_min=span_min - 8.0, span_min=span_min)


@pytest.mark.parametrize("upset", UPSETS)
def test_whatever_happens_the_same_is_said_as_by_a_monitor_of_its_own(upset: object) -> None:
    """Messages come one by one, or up to 500 together."""
    assert callable(upset)
    generator = np.random.default_rng(7)
    run = upset(leaking_run(upset), generator)
    monitor, own = fleet(ALL), stage_by_stage(ALL)
    quiet, said, expected = list[bool](), list[Publication](), list[Publication]()
    begin = 0
    while begin < len(run):
        together = (1, 1, 2, 7, 60, 500)[generator.integers(6)]
        now_ns = 10**9 * begin
        said += monitor.on_messages(run[begin : begin + together], now_ns)
        expected += [item for message in run[begin : begin + together] for item in own.on_message(message, now_ns)]
        quiet.append(bool(monitor.quiet))
        begin += together
    assert True in quiet
    assert of("x", said) == expected
    assert any(isinstance(item.message, Alarm) for item in said)
    assert comparable(monitor.monitor("x").state).to_bytes() == comparable(own.state).to_bytes()


@pytest.mark.parametrize("upset", UPSETS)
def test_a_row_in_one_compiled_step_gives_what_it_gives_stage_by_stage(upset: object) -> None:
    """Publications and state of a monitor of one plant are the same, value for value."""
    assert callable(upset)
    run = upset(leaking_run(upset), np.random.default_rng(7))
    config = msgspec.structs.replace(ALL, isolation=True)
    stepped = Monitor(msgspec.structs.replace(config, plant="x"), 0, points=True)
    staged, steps = stage_by_stage(config, points=True), 0
    for message in run:
        steps += stepped.pipeline.is_normal
        assert stepped.on_message(message, 0) == staged.on_message(message, 0)
    assert steps > 0.1 * len(run)
    assert stepped.to_bytes() == staged.to_bytes()


STRANGE: dict[str, dict[str, Any]] = {
    "out_of_place": {"time_ns": 2**61},
    "out_of_range": {"sequence": 2**62},
    "bad_quality": {"quality": Quality.QUALITY_BAD},
    "not_finite": {"value": float("inf")},
    "payload": {"quality": 0},
    "too_large": {"unit": "K" * 1000},
}


@pytest.mark.parametrize(
    ("reason", "fields"), [*STRANGE.items(), ("out_of_range", {"value": 1e15}), ("bad_quality", {"quality": 9})]
)
def test_a_plant_with_a_sample_that_is_refused_is_quiet_no_longer_and_counts_it(
    reason: str, fields: dict[str, Any]
) -> None:
    run = run_of("x", 16, span_min=100.0)
    monitor = fleet(ALL)
    for begin in range(0, 900, 30):
        monitor.on_messages(run[begin : begin + 30], 10**9 * begin)
    assert monitor.quiet == ["x"]
    monitor.on_messages([changed(run[900], **fields)], 900 * 10**9)
    assert monitor.quiet == []
    for begin in range(900, len(run), 30):
        monitor.on_messages(run[begin : begin + 30], 10**9 * begin)
    assert monitor.quiet == ["x"]
    assert monitor.monitor("x").rejects.by_reason == {reason: 1}


@pytest.mark.parametrize("config", [ALL, LOOKING])
def test_what_is_remembered_of_a_quiet_plant_is_what_its_own_monitor_remembers(config: MonitorConfig) -> None:
    run = run_of("x", 12, span_min=100.0)[:-2]  # the last row is not complete
    monitor, own = fleet(config), stage_by_stage(config)
    for begin in range(0, len(run), 100):
        now_ns = 10**9 * begin
        monitor.on_messages(run[begin : begin + 100], now_ns)
        for message in run[begin : begin + 100]:
            own.on_message(message, now_ns)
    assert monitor.quiet == ["x"]
    stored = Monitor(own.config, 0, points=False)
    stored.from_bytes(monitor.state_of("x"))
    assert comparable(stored.state).to_bytes() == comparable(own.state).to_bytes()
    again = monitor.monitor("x")
    assert monitor.quiet == []
    assert comparable(again.state).to_bytes() == comparable(own.state).to_bytes()
    assert replace(again.stats, start_ns=0, health_due_ns=0) == replace(own.stats, start_ns=0, health_due_ns=0)
    assert again.silence.of_plant.receipts_ns == own.silence.of_plant.receipts_ns


@pytest.mark.parametrize("rows", [950, 1050, 1690, 1760])
def test_an_input_is_remembered_to_the_bit_however_many_values_it_has(rows: int) -> None:
    """It is held for some rows each, then another each row, then held again for longer than rows are kept."""
    run = run_of("x", 12, span_min=180.0)[: 3 * rows]
    for place in range(950, min(rows, 1100)):
        run[3 * place] = changed(run[3 * place], value=Sample.FromString(run[3 * place].payload).value + 1e-9 * place)
    monitor, own = fleet(LOOKING), stage_by_stage(LOOKING)
    for begin in range(0, len(run), 30):
        now_ns = 10**9 * begin
        monitor.on_messages(run[begin : begin + 30], now_ns)
        for message in run[begin : begin + 30]:
            own.on_message(message, now_ns)
    assert monitor.quiet == ["x"]
    assert comparable(monitor.monitor("x").state).to_bytes() == comparable(own.state).to_bytes()


@pytest.mark.parametrize("rows", [150, 230, 231])
def test_a_plant_with_two_inputs_that_move_in_each_row_is_packed_without_loss(rows: int) -> None:
    plant, model = tanks(rows=rows, model=three_tanks()), three_tanks()
    config = plant.config(diagnose_training=False, isolation=True, isolation_rows=60)
    monitor = FleetMonitor(config, 0, ShardGroup(PLANTS, WHOLE, "a"), model=model)
    own, packed_rows = Monitor(config, 0, points=False, model=model), 0
    run = plant.messages()
    for first in range(0, len(run), 5):
        monitor.on_messages(run[first : first + 5], 10**9 * first)
        for message in run[first : first + 5]:
            own.on_message(message, 10**9 * first)
        packed_rows += bool(monitor.quiet)
    assert packed_rows > 20
    stored = Monitor(own.config, 0, points=False, model=model)
    stored.from_bytes(monitor.state_of("cstr"))
    assert comparable(stored.state).to_bytes() == comparable(own.state).to_bytes()
    assert comparable(monitor.monitor("cstr").state).to_bytes() == comparable(own.state).to_bytes()


def test_a_plant_whose_samples_are_converted_keeps_a_monitor_of_its_own() -> None:
    run = run_of("x", 12, span_min=40.0)
    for index in signal(run, 2):
        run[index] = changed(run[index], value=Sample.FromString(run[index].payload).value - 273.15, unit="degC")
    monitor = fleet(QUICK)
    for begin in range(0, len(run), 30):
        monitor.on_messages(run[begin : begin + 30], 10**9 * begin)
    assert monitor.quiet == []
    assert monitor.monitor("x").memory.watching_since_ns is not None


def comparable(state: MonitorState) -> MonitorState:
    """Without what nobody looks at again: the training, models that adapt, when the figures were told last."""
    watch, watched = state.watch, state.watch.watched
    assert watched is not None
    watch = msgspec.structs.replace(
        watch,
        predictors=[],
        training=msgspec.structs.replace(watch.training, known=[]),
        sampling=replace(watch.sampling, spacings_ns=[]),
        watched=msgspec.structs.replace(watched, until_drift=0),
    )
    board = msgspec.structs.replace(msgspec.msgpack.decode(state.board, type=AnnunciatorState), told=None)
    return msgspec.structs.replace(state, watch=watch, board=msgspec.msgpack.encode(board), snapshot_due_ns=None)


def test_the_cause_of_a_fault_in_a_quiet_plant_is_the_one_that_its_own_monitor_finds() -> None:
    run = run_of("x", 13, leak_min=90.0, span_min=95.0)
    monitor, said = fleet(LOOKING), list[Publication]()
    for begin in range(0, len(run), 90):
        said += monitor.on_messages(run[begin : begin + 90], 10**9 * begin)
    expected = alone("x", run, LOOKING)
    assert any(isinstance(item.message, Alarm) and item.message.suspects for item in expected)
    assert of("x", said) == expected


@pytest.mark.slow
def test_plants_that_come_and_go_do_not_disturb_each_other() -> None:
    runs = {name: run_of(name, seed, span_min=60.0) for seed, name in enumerate("abcdefghijklmnopqrst", start=20)}
    spiky = set("adgt")
    generator = np.random.default_rng(3)
    runs = {name: spikes(run, generator) if name in spiky else run for name, run in runs.items()}
    monitor, said, messages = fleet(ALL), list[Publication](), row_by_row(runs.values())
    for begin in range(0, len(messages), 777):
        said += monitor.on_messages(messages[begin : begin + 777], 10**9 * begin)
    assert set(monitor.quiet) >= set(runs) - spiky
    for name, run in runs.items():
        assert of(name, said) == alone(name, run, ALL)


def test_a_quiet_plant_that_falls_silent_is_told_of_when_its_own_monitor_would() -> None:
    run = run_of("x", 14, span_min=60.0)
    monitor, own = fleet(ALL), stage_by_stage(ALL)
    for number, message in enumerate(run):
        monitor.on_message(message, 10**9 * number)
        own.on_message(message, 10**9 * number)
    assert monitor.quiet == ["x"]
    last_ns = 10**9 * (len(run) - 1)
    for later_ns in range(10**8, 30 * 10**9, 10**8):
        said, expected = of("x", monitor.on_tick(last_ns + later_ns)), of("x", own.on_tick(last_ns + later_ns))
        assert said == expected
        if said:
            return
    pytest.fail("the silence was not told")


def test_the_health_of_a_quiet_plant_counts_what_its_own_monitor_counts() -> None:
    run = run_of("x", 15, span_min=60.0)
    monitor, own = fleet(ALL), stage_by_stage(ALL)
    monitor.on_messages(run[:1], 0)
    own.on_message(run[0], 0)
    for begin in range(1, len(run), 100):
        for message in run[begin : begin + 100]:
            own.on_message(message, 10**9 * begin)
        monitor.on_messages(run[begin : begin + 100], 10**9 * begin)
    assert monitor.quiet == ["x"]
    now_ns = 10**9 * len(run)
    (said,) = (item.message for item in monitor.on_tick(now_ns) if isinstance(item.message, Health))
    (expected,) = (item.message for item in own.on_tick(now_ns) if isinstance(item.message, Health))
    assert said == expected


def test_a_plant_is_not_packed_while_a_command_on_its_baseline_waits_for_the_next_row() -> None:
    run = run_of("x", 16, span_min=31.0)
    command = Encoded(
        keys.key("x", keys.COMMAND, "baseline"),
        *encode_message(BaselineCommand(what="relearn", by="Anna", why="new pump")),
    )
    monitor, own = fleet(ALL), stage_by_stage(ALL)
    said = [item for begin in range(0, 900, 30) for item in monitor.on_messages(run[begin : begin + 30], 10**9 * begin)]
    expected = [item for message in run[:900] for item in own.on_message(message, 0)]
    assert monitor.quiet == ["x"]
    for each in (monitor, own):
        reply, _ = each.on_command(command, 900 * 10**9)
        assert reply is not None
        assert reply.accepted
    for message in run[900:]:
        said += monitor.on_messages([message], 900 * 10**9)
        expected += own.on_message(message, 900 * 10**9)
    assert [item.message.what for item in said if isinstance(item.message, Baseline)] == ["relearn"]
    assert of("x", said) == of("x", expected)
