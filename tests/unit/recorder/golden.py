"""A run made up in memory, in which every number is known by formula: what all parts of the recorder are tried on.

Half an hour of plant time in rows 6 s apart: a swinging input, outputs that follow it, a monitor that learns for
10 minutes and then watches, a fault at 20 minutes that the prediction knows nothing of, an alarm that it raises
(22 min) and that clears (27 min).
"""

import math
from collections.abc import Iterator

import numpy as np

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Publication, encode
from reactorwatch.records.record import to_time_ns
from recorder import RecordedMessage
from tests.tables import UNITS

PLANT = "cstr"
ZERO_NS = 1_700_000_000_000_000_000
RECEIVED_NS = ZERO_NS + 5_000_000_000_000
ROWS = 300
STEP_MIN = 0.1
LEARNED_MIN, ONSET_MIN, RAISED_MIN, CLEARED_MIN = 10.0, 20.0, 22.0, 27.0
NOISE = {"C": 0.0005, "T": 0.05}
OUTPUTS = ("C", "T")


def time_ns(row: int) -> int:
    """The sample time of a row."""
    return to_time_ns(row * STEP_MIN, ZERO_NS)


def expected(signal: str, row: int) -> float:
    """What the model expects of a signal, and what the input is."""
    minutes = row * STEP_MIN
    if signal == "qc":
        return 104.0 if int(minutes / 4.0) % 2 == 0 else 96.0
    if signal == "C":
        return 0.1 + 0.006 * math.sin(2.0 * math.pi * minutes / 8.0)
    return 438.5 - 1.5 * math.sin(2.0 * math.pi * (minutes - 0.4) / 8.0)


def value(signal: str, row: int) -> float:
    """What is measured: the expected, the fault, and a noise that any machine makes alike."""
    if signal == "qc":
        return expected(signal, row)
    minutes = row * STEP_MIN
    fault = 12.0 * (1.0 - math.exp(-(minutes - ONSET_MIN) / 3.0)) if ONSET_MIN <= minutes < CLEARED_MIN else 0.0
    noise = np.random.default_rng([row, len(signal), ord(signal[0])]).normal()
    sign = {"C": 1.0, "T": -1.0}[signal]
    return expected(signal, row) + NOISE[signal] * (float(noise) + sign * fault)


def publications() -> Iterator[Publication]:
    """Everything that the plant and the monitor would have said, in order."""
    for row in range(ROWS):
        now = time_ns(row)
        if row == round(ONSET_MIN / STEP_MIN):
            yield _named(keys.FAULT, "coolant_flow", _fault(now))
        for number, signal in enumerate(("qc", *OUTPUTS)):
            sample = messages.Sample(
                time_ns=now,
                sequence=row,
                value=value(signal, row),
                unit=UNITS[signal],
                quality=messages.QUALITY_GOOD,
            )
            yield _named(keys.SAMPLE, signal, sample)
            if number:
                yield from _watched(signal, row)
        if row in (round(RAISED_MIN / STEP_MIN), round(CLEARED_MIN / STEP_MIN)):
            yield _named(keys.ALARM, "shewhart/T", _alarm(now))
        if row % 50 == 0:
            yield _named(keys.HEALTH, "monitor", _health(row))


def _watched(signal: str, row: int) -> Iterator[Publication]:
    now, learned = time_ns(row), row * STEP_MIN >= LEARNED_MIN
    limit = 3.0 * NOISE[signal] if learned else math.nan
    prediction = expected(signal, row)
    estimate = messages.Estimate(
        time_ns=now,
        prediction=prediction,
        residual=value(signal, row) - prediction,
        residual_sd=NOISE[signal] if learned else 0.0,
        lower_limit=prediction - limit,
        upper_limit=prediction + limit,
        unit=UNITS[signal],
    )
    yield _named(keys.ESTIMATE, signal, estimate)
    if learned:
        statistic = (value(signal, row) - prediction) / NOISE[signal]
        point = messages.ChartPoint(
            time_ns=now, statistic=statistic, lower_limit=-3.0, upper_limit=3.0, out=abs(statistic) > 3.0
        )
        yield _named(keys.CHART, keys.chart_name("shewhart", signal), point)


def _health(row: int) -> messages.Health:
    phase = "watching" if row * STEP_MIN >= LEARNED_MIN else "training"
    return messages.Health(time_ns=RECEIVED_NS + row, node="monitor", phase=phase)


def _fault(now: int) -> messages.Fault:
    return messages.Fault(
        time_ns=now,
        cause="coolant_flow",
        specification="coolant_flow:step:-0.05@20min",
        active=True,
        onset_ns=to_time_ns(ONSET_MIN, ZERO_NS),
    )


def _alarm(now: int) -> messages.Alarm:
    raised = to_time_ns(RAISED_MIN, ZERO_NS)
    cleared = now > raised
    unacknowledged = messages.ALARM_STATE_UNACKNOWLEDGED
    return messages.Alarm(
        time_ns=now,
        alarm="shewhart/T",
        state=messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED if cleared else unacknowledged,
        priority=messages.PRIORITY_HIGH,
        raised_ns=raised,
        cleared_ns=now if cleared else 0,
        value=-4.2,
        limit=-3.0,
        text="T is back between its limits" if cleared else "T is lower than the model expects",
    )


def _named(kind: str, name: str, message: Body) -> Publication:
    return Publication(keys.key(PLANT, kind, name), message)


def entries() -> Iterator[RecordedMessage]:
    """The same as a recorder would have received it, 1 ms after the other."""
    for number, publication in enumerate(publications()):
        encoded = encode(publication)
        received = RECEIVED_NS + number * 1_000_000
        yield RecordedMessage(encoded.key, encoded.payload, encoded.encoding, received, publication.message.time_ns)
