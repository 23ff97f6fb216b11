"""Samples that are late, missing, doubled or irregular, and a clock that jumps.

The policy: what happened to samples on their way is counted, and nothing of it is taken for a fault of the process.
Each test feeds a run as the bus would, and looks at what is counted, what is alarmed, and whether a fault is still
found. The silence alarm of a gap is no false alarm.
"""

import random
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Estimate, Health
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import to_time_ns

from .samples import leaking_run, sample

CONFIG = MonitorConfig(training_min=60.0, isolation=False)
SIGNALS = ("qc", "C", "T")
ROWS = 1101
EVENT = 800  # the row at which something happens to the time
ONSET_MIN = 90.0  # of the leak, in runs that have one


class RunOutput(NamedTuple):
    """The output of a monitor for a run.

    Attributes:
        published: everything but health, as bytes.
        raised: (alarm, time in ns) of each alarm that came up, other than of a silence.
        estimated: the estimates, by (signal, time in ns).
        health: at the end.
        phase: at the end.
    """

    published: list[Encoded]
    raised: list[tuple[str, int]]
    estimated: dict[tuple[str, int], Estimate]
    health: Health
    phase: str


class Run(NamedTuple):
    """A run, sample by sample: rows of (number, time in minutes, values of the signals)."""

    rows: list[tuple[int, float, tuple[float, ...]]]

    def messages(self, without: Callable[[int, str], bool] = lambda _row, _signal: False) -> list[Encoded]:
        """The run as the plant publishes it, but for the samples left out."""
        return [
            sample(signal, number, time_min, value)
            for number, time_min, values in self.rows
            for signal, value in zip(SIGNALS, values, strict=True)
            if not without(number, signal)
        ]

    def moved(self, row: int, by_min: float, *, numbered_from_0: bool = False) -> "Run":
        """The same with the plant's clock set by so much before a row; also as by a publisher that begins again."""
        later = [
            (number - row if numbered_from_0 else number, time_min + by_min, values)
            for number, time_min, values in self.rows[row:]
        ]
        return Run(self.rows[:row] + later)

    def lacking(self, first: int, last: int) -> "Run":
        """The same without the rows from first to last."""
        return Run(self.rows[:first] + self.rows[last + 1 :])


def run(size: float, seed: int) -> Run:
    time_min, columns = leaking_run(size, ONSET_MIN, (ROWS - 1) / 10, seed)
    values = zip(*(columns[signal].tolist() for signal in SIGNALS), strict=True)
    return Run(
        [(row, minute, value) for row, (minute, value) in enumerate(zip(time_min.tolist(), values, strict=True))]
    )


def watched(messages: Iterable[Encoded], now_ns: Callable[[int], int] = lambda _index: 0) -> RunOutput:
    monitor = Monitor(CONFIG, now_ns(0))
    output = [item for index, message in enumerate(messages) for item in monitor.on_message(message, now_ns(index))]
    output += monitor.finish()
    alarms = [item.message for item in output if isinstance(item.message, Alarm)]
    health = next(item.message for item in monitor.on_stop(1) if isinstance(item.message, Health))
    return RunOutput(
        published=[encode(item) for item in output],
        raised=[
            (alarm.alarm, alarm.raised_ns)
            for alarm in alarms
            if alarm.state == AlarmState.ALARM_STATE_UNACKNOWLEDGED and not alarm.alarm.startswith("silence/")
        ],
        estimated={
            (item.key.rsplit("/", 1)[1], item.message.time_ns): item.message
            for item in output
            if isinstance(item.message, Estimate) and not item.key.endswith("/arx")  # of the reference that judges
        },
        health=health,
        phase=monitor.phase,
    )


@pytest.fixture(scope="module")
def sound() -> Run:
    """Without a fault."""
    return run(0.0, seed=21)


@pytest.fixture(scope="module")
def leaking() -> Run:
    """The coolant leaks a tenth from minute 90 on."""
    return run(-0.1, seed=21)


@pytest.fixture(scope="module")
def undisturbed(leaking: Run) -> RunOutput:
    return watched(leaking.messages())


def test_without_any_disturbance_only_the_leak_is_alarmed(undisturbed: RunOutput) -> None:
    assert undisturbed.phase == "watching"
    assert undisturbed.raised
    assert min(time_ns for _, time_ns in undisturbed.raised) >= to_time_ns(ONSET_MIN)
    counted = undisturbed.health
    assert counted.late == counted.lost == counted.duplicated == counted.out_of_order == counted.incomplete_rows == 0


# --- missing -------------------------------------------------------------------------------------------------


def test_a_missing_sample_leaves_its_row_incomplete_and_the_other_signal_judged(sound: Run) -> None:
    row = EVENT
    output = watched(sound.messages(lambda number, signal: (number, signal) == (row, "T")))
    assert output.health.incomplete_rows == output.health.lost == 1
    assert output.health.rows == ROWS
    time_ns = to_time_ns(sound.rows[row][1])
    assert ("C", time_ns) in output.estimated
    assert ("T", time_ns) not in output.estimated
    assert output.raised == []


@pytest.mark.parametrize("signal", ["C", "T"])
def test_after_a_missing_sample_the_plant_is_expected_where_it_was_expected_with_it(
    leaking: Run, undisturbed: RunOutput, signal: str
) -> None:
    """One measurement more or less moves a prediction by a fraction of its standard deviation. Nothing begins anew."""
    missing = range(620, 890, 30)
    output = watched(leaking.messages(lambda row, name: name == signal and row in missing))
    moved = [
        (output.estimated[key].prediction - estimate.prediction) / estimate.residual_sd
        for row in missing
        for key, estimate in undisturbed.estimated.items()
        if 0 < key[1] - to_time_ns(leaking.rows[row][1]) < to_time_ns(0.35) and key in output.estimated
    ]
    assert len(moved) >= 3 * len(missing)  # of the other signal at least
    assert np.sqrt(np.mean(np.square(moved))) < 0.5


@pytest.mark.parametrize("signal", ["qc", "T"])
def test_a_signal_that_is_missing_for_three_rows_raises_no_alarm(sound: Run, signal: str) -> None:
    output = watched(sound.messages(lambda row, name: name == signal and EVENT <= row < EVENT + 3))
    assert output.health.incomplete_rows == 3
    assert output.raised == []


def test_a_tenth_of_the_samples_may_get_lost_and_is_counted_and_raises_no_alarm(sound: Run) -> None:
    lost = random.Random(6)
    kept = [message for index, message in enumerate(sound.messages()) if index < 3 or lost.random() > 0.1]
    output = watched(kept)
    assert output.raised == []
    assert output.phase == "watching"
    last_rows = 3  # a loss at the very end is not noticed: no number follows that jumps
    assert 0 <= 3 * ROWS - len(kept) - output.health.lost <= last_rows


def test_a_leak_is_found_though_a_tenth_of_the_samples_is_lost(leaking: Run) -> None:
    lost = random.Random(7)
    output = watched(message for message in leaking.messages() if lost.random() > 0.1)
    assert output.raised
    first_ns = min(time_ns for _, time_ns in output.raised)
    assert to_time_ns(ONSET_MIN) <= first_ns <= to_time_ns(ONSET_MIN + 10)


# --- irregular -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spread", [0.01, 0.5])
def test_irregular_intervals_raise_no_alarm_in_a_sound_plant(spread: float) -> None:
    """Intervals are uniform within the spread about a tenth of a minute, and the plant is simulated at just these."""
    generator = np.random.default_rng(8)
    time_min = np.cumsum(generator.uniform(0.1 * (1 - spread), 0.1 * (1 + spread), ROWS))
    time_min = np.round(time_min * 6e4) / 6e4  # to the millisecond
    qc = np.repeat(generator.uniform(90, 111, ROWS // 10 + 1), 10)[:ROWS]
    outputs = Simulator(cstr()).run(time_min, qc, np.array([0.1, 438.54])).outputs
    outputs = outputs + generator.normal(size=outputs.shape) * (0.002, 0.3)
    values = zip(qc.tolist(), *outputs.T.tolist(), strict=True)
    rows = zip(range(ROWS), time_min.tolist(), values, strict=True)
    output = watched(Run(list(rows)).messages())
    assert output.raised == []
    assert output.health.rows == ROWS
    assert output.health.incomplete_rows == 0


# --- the plant's clock ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("by_min", "anew"),
    [
        *((by_min, False) for by_min in (0.05, 60.0, -0.5, -3.0, -10.0, -79.0)),
        *((by_min, True) for by_min in (-79.0, -3.0, 500.0)),
    ],
)
def test_a_clock_that_is_set_and_a_publisher_that_begins_again_raise_no_alarm_and_the_plant_is_watched_on(
    sound: Run, by_min: float, *, anew: bool
) -> None:
    """The numbers go on, or begin again, so the samples are new, however old their times."""
    output = watched(sound.moved(EVENT, by_min, numbered_from_0=anew).messages())
    assert output.raised == []
    assert output.phase == "watching"
    assert output.health.rows == ROWS
    assert output.health.late == output.health.lost == output.health.duplicated == 0
    assert {("C", to_time_ns(109.0 + by_min)), ("T", to_time_ns(109.0 + by_min))} <= output.estimated.keys()


@pytest.mark.parametrize("rows", [5, 100])
def test_a_gap_in_the_samples_is_counted_and_raises_no_alarm(sound: Run, rows: int) -> None:
    output = watched(sound.lacking(EVENT, EVENT + rows - 1).messages())
    assert output.raised == []
    assert output.health.lost == 3 * rows
    assert output.health.incomplete_rows == 0
    assert {("C", to_time_ns(109.0)), ("T", to_time_ns(109.0))} <= output.estimated.keys()


@pytest.mark.parametrize(
    ("change", "by_min"),
    [
        (lambda leaking: leaking.moved(EVENT, 60.0), 60.0),
        (lambda leaking: leaking.moved(EVENT, -30.0, numbered_from_0=True), -30.0),
        (lambda leaking: leaking.lacking(EVENT, EVENT + 49), 0.0),
    ],
    ids=["clock set forward", "begun again earlier", "a gap of five minutes"],
)
def test_a_leak_that_sets_in_after_it_is_still_found(leaking: Run, change: Callable[[Run], Run], by_min: float) -> None:
    output = watched(change(leaking).messages())
    assert output.raised
    first_ns = min(time_ns for _, time_ns in output.raised)
    assert to_time_ns(ONSET_MIN + by_min) <= first_ns <= to_time_ns(ONSET_MIN + by_min + 10)


# --- the monitor's clock -------------------------------------------------------------------------------------


def test_the_monitors_own_clock_may_jump_as_it_likes(leaking: Run, undisturbed: RunOutput) -> None:
    jumps = random.Random(9)
    times = [jumps.randrange(10**18) for _ in range(3 * ROWS)]
    output = watched(leaking.messages(), lambda index: times[index])
    assert output.published == undisturbed.published
