"""The report's scheme as a back-test: its alarms are the rows that its chart puts out, on any record."""

import json
from pathlib import Path

import numpy as np
import pytest

from monitor_node.replay.report_watch import OUTSIDE, watch
from monitor_node.replay.row_log import RowLog
from reactorwatch.errors import InputError
from reactorwatch.identification.report_scheme import chart_output
from reactorwatch.records.record import Record
from tests.running import Command

TRAINING = 800


def faulty_record(rows: int = 2000) -> Record:
    """Two outputs of a linear plant; from row 1,500 on the first is 1.5 higher for 200 rows."""
    rng = np.random.default_rng(2)
    u = rng.normal(100.0, 5.0, rows)
    x = np.zeros(rows)
    for k in range(1, rows):
        x[k] = 0.7 * x[k - 1] - 0.3 * (u[k - 1] - 100.0)
    fault = np.where((np.arange(rows) >= 1500) & (np.arange(rows) < 1700), 1.5, 0.0)
    columns = {"u": u, "y": 50.0 + x + fault + rng.normal(0, 0.2, rows), "z": 7.0 - x + rng.normal(0, 0.2, rows)}
    return Record(np.linspace(0.0, 0.1 * (rows - 1), rows), columns, "made")


def test_alarms_are_the_runs_of_rows_that_are_out() -> None:
    record, log = faulty_record(), RowLog()
    result = watch(record, ("u",), ("y", "z"), TRAINING, log=log)
    out = {
        name: chart_output(record.columns["u"], record.columns[name], record.time_min, TRAINING).out
        & (np.arange(2000) >= TRAINING)
        for name in ("y", "z")
    }
    for name, flags in out.items():
        rises = np.flatnonzero(flags & ~np.concatenate([[False], flags[:-1]]))
        raised = [alarm.raised_ns / 6e10 for alarm, _ in result.raised_alarms if alarm.alarm == f"report/{name}"]
        np.testing.assert_allclose(raised, record.time_min[rises], atol=1e-9)
    either = out["y"] | out["z"]
    assert [row.in_alarm for row in log.rows] == either.tolist()
    assert out["y"][1500:1700].mean() > 0.9
    assert result.expected_false_alarms == pytest.approx(2 * 1200 * OUTSIDE * (1 - OUTSIDE))


@pytest.mark.parametrize(
    ("inputs", "rows", "message"),
    [((), 2000, "needs an input"), (("u",), TRAINING, "learns from 800 rows and watches the others, got 800")],
)
def test_a_record_that_the_scheme_cannot_watch_is_refused_in_one_line(
    inputs: tuple[str, ...], rows: int, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        watch(faulty_record(rows), inputs, ("y",), TRAINING)


def test_the_command_runs_it_on_any_record_and_says_where_rows_do_not_determine_the_model(
    tmp_path: Path, called: Command
) -> None:
    """An input that moves every 6 rows leaves the report's rows singular: it warns, and runs."""
    record = faulty_record()
    u = np.repeat(record.columns["u"], 6)[:2000]
    rows = zip(record.time_min, u, record.columns["y"], strict=True)
    file = tmp_path / "rig.csv"
    file.write_text("time_min,flow,level\n" + "".join(f"{t:.1f},{a:.6f},{b:.6f}\n" for t, a, b in rows))
    options = ("--input", "flow", "--output", "level", "--scheme", "report", "--training-rows", "800")
    found = json.loads(called("backtest", str(file), *options, "--json").stdout)
    assert {alarm["alarm"] for alarm in found["alarms"]} == {"report/level"}
    assert found["trained_until_min"] == 80.0
    assert "do not determine the parameters" in called("backtest", str(file), *options).stdout
