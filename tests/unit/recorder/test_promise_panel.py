"""The promise is drawn beside the alarms that came, and stated in words where it changes."""

import numpy as np

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Power, Promise
from recorder.columns import read_run
from recorder.panels.base import ALARM, EventLog, TimePlot
from recorder.panels.status import PROMISE

MINUTE_NS = 60_000_000_000


def promise(minute: int, found: int, *, kept: bool = True) -> Encoded:
    power = Power(deviation="T.bias", unit="K", within_1_h=0.21, within_1_day=0.1)
    message = Promise(
        time_ns=minute * MINUTE_NS,
        found=found,
        expected_so_far=0.01 * minute,
        kept=kept,
        text=f"{found} alarms",
        power=[power],
    )
    return encode(Publication(keys.key("cstr", keys.PROMISE, "monitor"), message))


def test_alarms_found_and_promised_are_two_lines() -> None:
    plot, _ = PROMISE.draw(read_run([promise(100, 0), promise(105, 0), promise(107, 2)]))
    assert isinstance(plot, TimePlot)
    promised, found = plot.series
    assert np.allclose(promised.value, [1.0, 1.05, 1.07])
    assert np.allclose(found.value, [0, 0, 2])
    assert (found.time_ns == np.array([100, 105, 107]) * MINUTE_NS).all()


def test_the_log_has_a_line_for_each_change_and_the_power_once() -> None:
    _, log = PROMISE.draw(read_run([promise(100, 0), promise(105, 0), promise(107, 2), promise(110, 2, kept=False)]))
    assert isinstance(log, EventLog)
    assert [event.kind for event in log.events] == ["promise", "power", "promise", "promise"]
    assert "T.bias (K): none within 10 min, 0.21 within an hour, 0.1 within a day" in log.events[1].text
    assert log.events[-1].colour == ALARM


def test_a_run_without_a_promise_has_no_such_panel() -> None:
    assert PROMISE.draw(read_run([])) == ()
