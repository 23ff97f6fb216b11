"""A plant or a sensor that has gone silent is noticed, at the same sample time in a live run and in a replay."""

from math import nan

import numpy as np
import pytest
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.spc.silence import NO_CHANGE, Change, DataTimeout
from reactorwatch.stored_state import copy_of, place_records

PERIOD = 6_000_000_000  # ns of the plant's time
LEAST_S = 1.0


def trained_timeout(rows: int, period_ns: int = PERIOD, speed: float = 1.0) -> DataTimeout:
    """A timeout after samples of a regular plant, received at `speed` times the plant's time from 0 on."""
    silence = DataTimeout(1, limit=5.0, least_s=LEAST_S)
    for row in range(rows):
        silence.on_receipt(int(row * period_ns / speed))
        of_plant(silence, row * period_ns)
    return silence


def of_plant(silence: DataTimeout, time_ns: int) -> Change:
    """Change of the plant's timeout by a row."""
    return dict(silence.update(time_ns, [1.0])).get(0, NO_CHANGE)


def of_sensor(silence: DataTimeout, time_ns: int, *, present: bool) -> Change:
    """Change of the timeout of the plant's one signal by a row."""
    return dict(silence.update(time_ns, [1.0 if present else nan])).get(1, NO_CHANGE)


def resume(stopped: DataTimeout) -> DataTimeout:
    """Another one with a copy of the memory, as after a restart."""
    silence = DataTimeout(1, least_s=LEAST_S)
    stored = copy_of(stopped.memory)
    stored.numbers = place_records(stored.numbers, silence.memory.numbers)
    silence.memory = stored
    return silence


# --- in the time of the samples ------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", [0, 1, 4])
def test_up_to_four_missing_rows_are_no_silence(missing: int) -> None:
    assert of_plant(trained_timeout(100), (100 + missing) * PERIOD) == NO_CHANGE


@pytest.mark.parametrize("missing", [5, 6, 1000])
def test_a_longer_gap_is_a_silence_from_five_periods_after_the_last_row_until_the_next(missing: int) -> None:
    silence = trained_timeout(100)
    change = of_plant(silence, (100 + missing) * PERIOD)
    assert change == Change(raised_ns=104 * PERIOD, cleared_ns=(100 + missing) * PERIOD)
    assert not silence.is_active


def test_a_sensor_without_values_is_silent_while_rows_arrive() -> None:
    silence = trained_timeout(100)
    changes = [of_sensor(silence, row * PERIOD, present=False) for row in range(100, 120)]
    assert [(row, change) for row, change in enumerate(changes, 100) if change != NO_CHANGE] == [
        (105, Change(raised_ns=104 * PERIOD, cleared_ns=None))
    ]
    assert of_sensor(silence, 120 * PERIOD, present=True) == Change(raised_ns=None, cleared_ns=120 * PERIOD)


def test_a_slow_sensor_is_measured_by_its_own_period() -> None:
    """An analyser with a value in every tenth row."""
    silence = DataTimeout(1, limit=5.0)
    changes = [of_sensor(silence, row * PERIOD, present=row % 10 == 0) for row in range(500)]
    changes += [of_sensor(silence, row * PERIOD, present=False) for row in range(500, 600)]
    assert [change for change in changes if change != NO_CHANGE] == [Change((490 + 50) * PERIOD, None)]


def test_a_sensor_that_never_had_a_value_is_silent_after_a_hundred_rows() -> None:
    silence = DataTimeout(1)
    changes = [of_sensor(silence, row * PERIOD, present=False) for row in range(200)]
    assert [change for change in changes if change != NO_CHANGE] == [Change(100 * PERIOD, None)]


def test_a_gap_in_all_rows_is_no_fault_of_a_sensor() -> None:
    sensor = trained_timeout(100)
    assert dict(sensor.update(200 * PERIOD, [nan])) == {0: Change(104 * PERIOD, 200 * PERIOD)}
    assert [of_sensor(sensor, row * PERIOD, present=False) for row in range(201, 206)] == [NO_CHANGE] * 5
    assert of_sensor(sensor, 206 * PERIOD, present=False) == Change(205 * PERIOD, None)


def test_a_sensor_that_is_silent_already_stays_so_through_a_gap_in_all_rows() -> None:
    sensor = trained_timeout(100)
    changes = [of_sensor(sensor, row * PERIOD, present=False) for row in range(100, 110)]
    assert changes[5] == Change(104 * PERIOD, None)
    assert dict(sensor.update(200 * PERIOD, [nan])) == {0: Change(114 * PERIOD, 200 * PERIOD)}
    assert of_sensor(sensor, 201 * PERIOD, present=True) == Change(None, 201 * PERIOD)


def test_a_clock_that_is_set_back_is_no_silence_and_is_followed_from_there() -> None:
    silence = trained_timeout(100)
    assert of_plant(silence, -50 * PERIOD) == NO_CHANGE
    assert of_plant(silence, -49 * PERIOD) == NO_CHANGE
    assert of_plant(silence, -40 * PERIOD) == Change(-44 * PERIOD, -40 * PERIOD)


def test_a_silent_sensor_stays_so_when_the_clock_is_set_back_and_it_still_has_no_value() -> None:
    sensor = trained_timeout(100)
    changes = [of_sensor(sensor, row * PERIOD, present=False) for row in range(100, 110)]
    assert changes[5] == Change(104 * PERIOD, None)
    assert of_sensor(sensor, 20 * PERIOD, present=False) == NO_CHANGE
    assert of_sensor(sensor, 26 * PERIOD, present=True) == Change(None, 26 * PERIOD), "it was active"


def test_after_a_long_silence_the_next_is_noticed_nearly_as_soon() -> None:
    silence = trained_timeout(100)
    silence.on_receipt(1100 * PERIOD)
    of_plant(silence, 1100 * PERIOD)
    due_ns = silence.due_ns()
    assert due_ns is not None
    assert 1105 * PERIOD < due_ns < 1110 * PERIOD
    assert of_plant(silence, 1111 * PERIOD).raised_ns is not None


@pytest.mark.parametrize(
    "times",
    [
        np.cumsum(np.random.default_rng(1).exponential(PERIOD, 20_000)).astype(int),
        PERIOD * np.flatnonzero(np.random.default_rng(2).random(20_000) > 0.05),
    ],
    ids=["irregular", "lost singly"],
)
def test_irregular_rows_and_rows_that_get_lost_singly_are_no_silence(times: NDArray[np.int64]) -> None:
    """Exponential spacings: allowed are 5 (1 + 2 * 2/e) = 12.4 means, which 4 in a million are longer than."""
    silence = DataTimeout(1, limit=5.0)
    assert all(of_plant(silence, time_ns) == NO_CHANGE for time_ns in times.tolist())


def test_a_plant_that_resumes_ten_times_slower_is_accepted_after_a_few_rows() -> None:
    silence = trained_timeout(100)
    changes = [of_plant(silence, (99 + 10 * row) * PERIOD) for row in range(1, 100)]
    silent = [row for row, change in enumerate(changes) if change != NO_CHANGE]
    assert silent == list(range(len(silent)))
    assert 1 <= len(silent) <= 4


def test_nothing_is_silent_before_the_usual_spacing_is_known() -> None:
    assert of_plant(trained_timeout(20), 10_000 * PERIOD) == NO_CHANGE
    assert trained_timeout(20).due_ns() is None
    assert DataTimeout().due_ns() is None


# --- in the time of receipt ----------------------------------------------------------------------------------


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_a_plant_from_which_nothing_comes_is_silent_after_five_periods_of_receipt_time(speed: float) -> None:
    silence = trained_timeout(100, speed=speed)
    due_ns = silence.due_ns()
    assert due_ns == 104 * PERIOD / speed
    assert silence.check(due_ns - 1) == NO_CHANGE
    assert silence.check(due_ns) == Change(raised_ns=104 * PERIOD, cleared_ns=None)


def test_a_plant_that_runs_fast_is_given_the_least_time() -> None:
    silence = trained_timeout(100, speed=600.0)  # a row every 10 ms
    assert silence.due_ns() == 99 * PERIOD / 600 + LEAST_S * 1e9


def test_a_silence_is_asked_for_once_and_then_waited_out() -> None:
    """`on_tick` is called when something is due: after the alarm nothing may be, or the loop would spin."""
    silence = trained_timeout(100)
    due_ns = silence.due_ns()
    assert due_ns is not None
    silence.check(due_ns)
    assert silence.due_ns() is None
    assert silence.check(10**16) == NO_CHANGE


def test_a_live_run_and_a_replay_report_a_silence_with_the_same_times() -> None:
    live, replay = trained_timeout(100), trained_timeout(100, speed=1e6)
    said = [live.check(150 * PERIOD)]
    live.on_receipt(200 * PERIOD)
    said.append(of_plant(live, 200 * PERIOD))
    at_once = of_plant(replay, 200 * PERIOD)
    assert [change.raised_ns for change in said if change.raised_ns is not None] == [at_once.raised_ns]
    assert [change.cleared_ns for change in said if change.cleared_ns is not None] == [at_once.cleared_ns]


def test_rows_that_the_transport_held_up_end_the_silence_and_leave_none_in_a_replay() -> None:
    live, replay = trained_timeout(100), trained_timeout(100, speed=1e6)
    raised_ns = live.check(150 * PERIOD).raised_ns
    assert of_plant(live, 100 * PERIOD) == Change(None, raised_ns)
    assert [of_plant(live, row * PERIOD) for row in range(101, 150)] == [NO_CHANGE] * 49
    assert [of_plant(replay, row * PERIOD) for row in range(100, 150)] == [NO_CHANGE] * 50


def test_samples_that_arrive_in_bursts_are_waited_for_between_them() -> None:
    """Ten rows every ten periods: the plant is not silent in between."""
    silence = DataTimeout(1, limit=5.0, least_s=LEAST_S)
    for burst in range(100):
        now_ns = 10 * burst * PERIOD
        due_ns = silence.due_ns()
        assert burst < 5 or (due_ns is not None and now_ns < due_ns)
        for row in range(10 * burst, 10 * burst + 10):
            silence.on_receipt(now_ns)
            of_plant(silence, row * PERIOD)


def test_a_receipt_clock_that_is_set_back_is_followed_from_there() -> None:
    silence = trained_timeout(100)
    silence.on_receipt(-(10**15))
    assert silence.due_ns() == -(10**15) + 5 * PERIOD


# --- state ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [0, 1, 7, 30, 52, 75])
def test_it_resumes_from_its_stored_state_as_if_it_had_never_stopped(cut: int) -> None:
    rows = [*range(50), *range(70, 100)]

    def step(silence: DataTimeout, row: int) -> Change:
        silence.on_receipt(row * PERIOD)
        return of_sensor(silence, row * PERIOD, present=row % 7 != 0)

    through, stopped = DataTimeout(1, least_s=LEAST_S), DataTimeout(1, least_s=LEAST_S)
    expected = [step(through, row) for row in rows]
    said = [step(stopped, row) for row in rows[:cut]]
    resumed = resume(stopped)
    assert said + [step(resumed, row) for row in rows[cut:]] == expected


def test_a_monitor_that_was_down_does_not_call_the_plant_silent_for_it() -> None:
    resumed = resume(trained_timeout(100))
    assert resumed.due_ns() is None
    resumed.on_receipt(10**15)
    assert resumed.due_ns() == 10**15 + 5 * PERIOD


@pytest.mark.parametrize(
    ("limit", "least_s", "text"),
    [
        (1.0, 1.0, "limit must be a number of periods above 1, got 1"),
        (nan, 1.0, "limit must be a number of periods above 1, got nan"),
        (5.0, 0.0, "least_s must be a positive number, got 0"),
    ],
)
def test_settings_that_make_no_rule_are_refused(limit: float, least_s: float, text: str) -> None:
    with pytest.raises(InputError, match=text):
        DataTimeout(1, limit, least_s)


def test_what_comes_in_a_burst_after_a_cut_shortens_no_patience() -> None:
    """A minute of rows that were held up comes within a tenth of a second."""
    silence, plain = trained_timeout(100), trained_timeout(100)
    end_ns = 100 * PERIOD
    for row in range(200):
        silence.on_receipt(end_ns + row * 500_000)
    due_ns, usual_ns = silence.due_ns(), plain.due_ns()
    assert due_ns is not None
    assert usual_ns is not None
    assert due_ns - (end_ns + 199 * 500_000) >= 0.99 * (usual_ns - 99 * PERIOD)


def test_a_plant_that_resumes_faster_gets_a_shorter_timeout_after_a_while() -> None:
    silence = trained_timeout(100)
    for row in range(3000):
        silence.on_receipt(100 * PERIOD + row * PERIOD // 100)
    due_ns = silence.due_ns()
    assert due_ns is not None
    assert due_ns - (100 * PERIOD + 2999 * PERIOD // 100) <= 1.01 * LEAST_S * 1e9


@pytest.mark.parametrize("late_s", [2, 3600])
def test_a_monitor_that_was_frozen_or_had_its_clock_set_does_not_blame_the_plant(late_s: int) -> None:
    """The check runs late; if nothing arrives after it, the alarm is raised in due time."""
    silence = trained_timeout(100)
    due_ns = silence.due_ns()
    assert due_ns is not None
    late_ns = due_ns + late_s * 10**9
    assert silence.check(late_ns) == NO_CHANGE
    again_ns = silence.due_ns()
    assert again_ns == late_ns + (due_ns - 99 * PERIOD)
    assert silence.check(again_ns) == Change(104 * PERIOD, None)
