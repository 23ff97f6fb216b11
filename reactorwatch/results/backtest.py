"""Result of a back-test."""

from typing import Any, ClassVar

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.results.alarms import RaisedAlarm
from reactorwatch.results.base import Result
from reactorwatch.results.promise import Power, Promise


class LeftOut(Result, frozen=True):
    """A signal that is not watched.

    Attributes:
        signal: name of the signal.
        why: the reason.
    """

    signal: str
    why: str


class WatchedSignals(Result, frozen=True):
    """Signals of a back-test.

    Attributes:
        inputs: inputs that explain outputs.
        outputs: outputs that are watched.
        left_out: signals that are not watched.
    """

    inputs: list[str]
    outputs: list[str]
    left_out: list[LeftOut]


class NoiseLevels(Result, frozen=True):
    """Noise of the filter of the equations.

    Attributes:
        sensors: standard deviation of each sensor, in its unit.
        states: standard deviation of each state, in its unit per square root of a minute.
    """

    sensors: dict[str, float]
    states: dict[str, float]


class ChangedModel(Result, frozen=True):
    """Change of the equations after the diagnosis of the training.

    Attributes:
        what: kind of the change.
        from_min: minute from which on it holds.
        why: the reason in a sentence.
        extended_model: the model, as in its file.
    """

    what: str
    from_min: float
    why: str
    extended_model: dict[str, Any]


class Backtest(Result, frozen=True, kw_only=True):
    """Result of a back-test; its fields are those of `reactorwatch backtest --json`.

    Attributes:
        file: name of the record, which the JSON has where there are several.
        watched: False if no row could be judged.
        why: reason why none could; None: one was judged.
        samples: number of rows.
        zero: clock time that the minutes count from, ISO 8601; None: unknown.
        span_min: time from the first row to the last, summed over the runs.
        runs: number of runs of the plant: one more than restarts of the plant or its clock.
        trained_until_min: end of the training; None: the record is shorter.
        expected_false_alarms: number of alarms expected by chance after the training.
        promise: promise of false alarms, and how training and rows bear it out; None: no row was judged.
        power: for each deviation the sizes that are seen within 10 min, an hour and a day.
        signals: inputs, outputs, and signals that are not watched with the reason.
        reference: model that the rows are judged by, `equations`, `black-box` or `arx`; None: no row was judged.
        noise_levels: standard deviations of the equations' noise; None: they did not judge.
        baseline: change of the equations after the diagnosis of the training; None: they stayed as given.
        alarms: the alarms in the order in which they were raised.
        training_rows: number of rows of the training; 0 if no row was judged.
        can_keep_per_30_days: see `Promise`, with all digits; None: no row was judged.
        trained_elsewhere: True if the training was on another record.
        notes: notes on the training.
        refused: number of rejected messages by reason.
        zero_ns: time from which the minutes are counted.
        clock_zero_ns: clock time of that time; None: unknown.
        first_ns: time of the first row; 0 without rows.
        last_ns: time of the last row; 0 without rows.
        watching_since_ns: time of the first judged row; None if the record is shorter than the training.
        alarm_messages: every change of an alarm, in order.
        incident_messages: every change of an incident, in order.
    """

    file: str
    watched: bool
    why: str | None
    samples: int
    zero: str | None
    span_min: float
    runs: int
    trained_until_min: float | None
    expected_false_alarms: float
    promise: Promise | None
    power: list[Power]
    signals: WatchedSignals
    reference: str | None
    noise_levels: NoiseLevels | None
    baseline: ChangedModel | None
    alarms: list[RaisedAlarm]
    training_rows: int
    can_keep_per_30_days: float | None
    trained_elsewhere: bool
    notes: list[str]
    refused: dict[str, int]
    zero_ns: int
    clock_zero_ns: int | None
    first_ns: int
    last_ns: int
    watching_since_ns: int | None
    alarm_messages: list[messages.Alarm]
    incident_messages: list[messages.Incident]

    python_only: ClassVar = (
        *("file", "training_rows", "can_keep_per_30_days", "trained_elsewhere", "notes", "refused", "zero_ns"),
        *("clock_zero_ns", "first_ns", "last_ns", "watching_since_ns", "alarm_messages", "incident_messages"),
    )

    @property
    def exclusions(self) -> dict[str, str]:
        """Signals that are not watched, with the reason."""
        return {item.signal: item.why for item in self.signals.left_out}

    @property
    def raised_alarms(self) -> list[tuple[messages.Alarm, int | None]]:
        """Each alarm as raised, with its newest suspects, and the time when it was cleared (None: it is active)."""
        return [(item.message, item.cleared_ns) for item in self.alarms]
