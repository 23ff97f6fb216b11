"""What every panel has to keep, and what each of them shows of the golden run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import recorder.panels
from reactorwatch.contract import messages_pb2 as messages
from recorder.panels import PANELS, alarms, phase_plane, residuals, signals
from recorder.panels.base import EventLog, Panel, PlanePlot, TimePlot
from recorder.run import Run, read_run
from tests.unit.recorder import golden


@pytest.fixture(scope="module")
def run() -> Run:
    return read_run(golden.entries())


def only(run: Run, *signals_left: str) -> Run:
    """The run of a plant that had but these signals, and no monitor."""
    measured = {name: run.measured[name] for name in signals_left}
    return replace(run, measured=measured, estimated={}, charts={}, alarms=(), faults=())


def test_every_file_of_the_folder_is_in_the_catalogue() -> None:
    folder = Path(recorder.panels.__file__).parent
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "base"}
    listed = {panel.draw.__module__.rsplit(".", 1)[1] for panel in PANELS}
    assert listed == files
    assert len(PANELS) == len(files)


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel.title)
def test_every_panel_describes_any_run(panel: Panel, run: Run) -> None:
    """Names are told apart, times ascend, columns are of one length; also where next to nothing was recorded."""
    unusable = replace(run.measured["C"], value=run.measured["C"].value * np.nan)
    blind = replace(run, measured={**run.measured, "C": unusable})
    for some_run in (run, blind, only(run, "T"), only(run, "C", "T"), only(run)):
        views = panel.draw(some_run)
        assert len({view.title for view in views}) == len(views)
        for view in views:
            if isinstance(view, TimePlot):
                assert len({series.name for series in view.series}) == len(view.series)
                for series in view.series:
                    assert series.time_ns.shape == series.value.shape
                    assert (np.diff(series.time_ns) > 0).all()
            elif isinstance(view, EventLog):
                times = [event.time_ns for event in view.events]
                assert times == sorted(times)
            else:
                assert len({path.name for path in view.paths}) == len(view.paths)
                assert all(path.x.shape == path.y.shape for path in view.paths)


def test_signals_show_measured_predicted_and_limits_in_colours_of_their_own(run: Run) -> None:
    plots = {plot.title: plot for plot in signals.draw(run)}
    assert list(plots) == ["Concentration C", "Temperature T", "Coolant flow qc"]
    temperature = plots["Temperature T"]
    assert temperature.unit == "K"
    lines = {series.name: series for series in temperature.series}
    assert list(lines) == ["upper limit", "lower limit", "measured", "predicted"]
    assert lines["measured"].value is run.measured["T"].value
    assert lines["predicted"].value is run.estimated["T"].prediction
    assert lines["upper limit"].value is run.estimated["T"].upper_limit
    assert len({lines[name].colour for name in ("upper limit", "measured", "predicted")}) == 3
    (flow,) = plots["Coolant flow qc"].series
    assert flow.held


def test_residuals_open_on_what_was_judged(run: Run) -> None:
    """A first prediction that is wild does not set the scale."""
    wild = run.estimated["T"].residual.copy()
    wild[0] = 1e6
    changed = replace(run, estimated={"T": replace(run.estimated["T"], residual=wild)})
    (plot,) = residuals.draw(changed)
    watched = np.isfinite(run.estimated["T"].upper_limit)
    assert plot.shown is not None
    lower, upper = plot.shown
    assert lower < wild[watched].min() < wild[watched].max() < upper < 1.0
    learning = replace(run.estimated["T"], lower_limit=wild * np.nan, upper_limit=wild * np.nan)
    (plot,) = residuals.draw(replace(run, estimated={"T": learning}))
    assert plot.shown is None


def test_the_log_tells_alarms_and_faults_in_order(run: Run) -> None:
    (log,) = alarms.draw(run)
    assert [(event.kind, event.text) for event in log.events] == [
        ("fault", "20.0 min  injected: coolant_flow:step:-0.05@20min"),
        ("raised", "22.0 min  shewhart/T: T is lower than the model expects"),
        ("cleared", "27.0 min  shewhart/T: T is back between its limits"),
    ]


def test_the_log_tells_the_suspects_of_one_look_once(run: Run) -> None:
    suspect = messages.Suspect(cause="coolant_flow", probability=0.9, profile="step", size=-0.05, unit="1")
    suspect.onset_ns = run.span_ns[0] + 20 * 60_000_000_000
    look = run.alarms[0]._replace(event="suspected", suspects=[suspect])
    (log,) = alarms.draw(replace(run, alarms=(run.alarms[0], look, look._replace(alarm="ewma/T"))))
    assert [(event.kind, event.text) for event in log.events][1:] == [
        ("raised", "22.0 min  shewhart/T: T is lower than the model expects"),
        ("suspect", "22.0 min  coolant_flow (90 %; step of -0.05 at 20.0 min)"),
    ]


def test_every_state_of_an_alarm_has_a_word(run: Run) -> None:
    changes = [run.alarms[0]._replace(state=state) for state in messages.AlarmState.values()]
    (log,) = alarms.draw(replace(run, alarms=tuple(changes)))
    words = {event.kind for event in log.events if event.kind != "fault"}
    assert len(words) == len(messages.AlarmState.values())


def test_the_path_changes_colour_while_the_alarm_stands_without_a_break(run: Run) -> None:
    (plane,) = phase_plane.draw(run)
    quiet, alarmed = plane.paths
    assert (quiet.name, alarmed.name) == ("no alarm", "alarm stands")
    raised, cleared = (round(minutes / golden.STEP_MIN) for minutes in (golden.RAISED_MIN, golden.CLEARED_MIN))
    rows = np.arange(golden.ROWS)
    assert np.array_equal(np.isfinite(alarmed.x), (rows >= raised - 1) & (rows < cleared))
    assert np.array_equal(np.isfinite(quiet.x), (rows < raised) | (rows >= cleared - 1))
    steps = [np.isfinite(path.x[:-1]) & np.isfinite(path.x[1:]) for path in plane.paths]
    assert (steps[0] ^ steps[1]).all()  # every step is drawn, once


def test_the_plane_marks_the_fault_and_the_first_alarm(run: Run) -> None:
    (plane,) = phase_plane.draw(run)
    assert isinstance(plane, PlanePlot)
    assert (plane.x_label, plane.y_label) == ("C, mol/l", "T, K")
    places = {mark.name: (mark.x, mark.y) for mark in plane.marks}
    for name, minutes in (("fault", golden.ONSET_MIN), ("alarm", golden.RAISED_MIN)):
        row = round(minutes / golden.STEP_MIN)
        assert places[name] == (golden.value("C", row), golden.value("T", row))
