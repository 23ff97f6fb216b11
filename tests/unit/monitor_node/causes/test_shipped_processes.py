"""The monitor names the cause on every process that is shipped, also where an effect has constants of its own."""

import numpy as np
import pytest

import reactorwatch as rw
from monitor_node.causes.isolation import causes_of
from monitor_node.causes.scan import GlrScan
from monitor_node.causes.window import window_of
from reactorwatch.cli.examples import make_example
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.library.cascaded_tanks import tanks


@pytest.mark.parametrize("name", ["leak", "cascaded_tanks", "three_tanks"])
def test_the_example_s_cause_is_the_first_suspect_and_no_stage_fails(name: str) -> None:
    record, truth, _ = make_example(name, 3)
    result = rw.backtest(record, process="cstr" if name == "leak" else name)
    assert "error of this software" not in result.text
    suspected = [alarm.suspect[0].cause for alarm in result.alarms if alarm.suspect]
    assert suspected
    assert suspected[-1] == truth["causes"][0]["cause"]


def test_an_effect_with_constants_leaves_the_scan_of_the_others_as_it_is() -> None:
    record, _, _ = make_example("cascaded_tanks", 3)
    model, noise = tanks(), NoiseLevels((0.05,), (0.0, 0.0))
    columns = [record.columns[name][1400:1800] for name in ("u", "x2")]
    rows = [
        (t, [u], [x])
        for t, u, x in zip(record.time_min[1400:1800].tolist(), *(c.tolist() for c in columns), strict=True)
    ]
    window = window_of(rows, Filter(model, noise))
    assert window is not None
    causes = causes_of(model)
    constant = [not effect.constants for effect in causes]
    assert not all(constant)
    others = [effect for effect in causes if not effect.constants]
    (_, every), (_, without) = (GlrScan(model, noise, effects).scan(window) for effects in (causes, others))
    # sums over more columns are taken in another order
    np.testing.assert_allclose(every.ratio[:, :, constant], without.ratio, rtol=1e-9, atol=1e-9)
    assert np.isfinite(every.ratio).all()
