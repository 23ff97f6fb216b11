"""Rules of every panel, and the content of each for the golden run. The phase plane has its own file."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

import recorder.panels
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Power, Promise
from reactorwatch.description.process import Process, Signal
from reactorwatch.description.read import find_process
from recorder.columns import (
    ADAPTIVE,
    EQUATIONS,
    FROZEN,
    REFERENCE,
    ChartColumns,
    ReconstructionColumns,
    RunColumns,
    RunReader,
    SampleColumns,
    read_run,
    read_segments,
)
from recorder.panels import PANELS, phase_plane, signals, status
from recorder.panels.base import ALARM, EventLog, Panel, PlanePlot, StateLines, TimePlot, View, ViewReference
from tests.unit.recorder import golden
from tests.unit.recorder.recording import MINUTE

V = TypeVar("V", bound=View)


@pytest.fixture(scope="module")
def run() -> RunColumns:
    return read_run(golden.entries())


def of_kind(views: Sequence[View], kind: type[V]) -> Iterator[V]:
    return (view for view in views if isinstance(view, kind))


def log_of(run: RunColumns) -> EventLog:
    return next(of_kind(status.draw_alarms(run), EventLog))


def only(run: RunColumns, *signals_left: str) -> RunColumns:
    """The run of a plant that had but these signals, and no monitor."""
    measured = {name: run.samples[name] for name in signals_left}
    seen = {name: run.statistics[name] for name in signals_left}
    return replace(run, samples=measured, statistics=seen, estimates={}, charts={}, alarms=(), faults=(), health={})


def test_every_file_of_the_folder_is_in_the_catalogue() -> None:
    folder = Path(recorder.panels.__file__).parent
    files = {path.stem for path in folder.glob("*.py")} - {"__init__", "base"}
    listed = {panel.draw.__module__.rsplit(".", 1)[1] for panel in PANELS}
    assert listed == files


def some_runs(run: RunColumns) -> Iterator[RunColumns]:
    yield run
    yield replace(run, samples={**run.samples, "C": run.samples["C"]._replace(value=run.samples["C"].value * np.nan)})
    for left in (("T",), ("C", "T"), ("qc", "C", "T"), ()):
        yield only(run, *left)
    yield from read_segments(golden.entries(), 150)


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel.title)
def test_every_panel_describes_any_run(panel: Panel, run: RunColumns) -> None:
    """Names are told apart, times ascend, columns are of one length; also where next to nothing was recorded."""
    for some_run in some_runs(run):
        views = panel.draw(some_run)
        assert len({(type(view), view.title) for view in views}) == len(views)
        for view in views:
            if isinstance(view, TimePlot):
                assert len({series.name for series in view.series}) == len(view.series)
                for series in view.series:
                    assert series.time_ns.shape == series.value.shape
                    assert (np.diff(series.time_ns) > 0).all()
            elif isinstance(view, EventLog):
                times = [event.time_ns for event in view.events]
                assert times == sorted(times)
            elif isinstance(view, StateLines):
                for line in view.lines:
                    assert list(line.time_ns) == sorted(set(line.time_ns))
                    assert len(line.time_ns) == len(line.states)
                    assert set(line.states) <= view.colours.keys()
            elif isinstance(view, PlanePlot):
                assert len({path.name for path in (*view.paths, *view.curves)}) == len(view.paths) + len(view.curves)
                assert all(path.x.shape == path.y.shape for path in view.paths)


def test_what_is_shown_again_is_there(run: RunColumns) -> None:
    titles = {
        (panel.title, view.title) for panel in PANELS for view in panel.draw(run) if not isinstance(view, ViewReference)
    }
    for panel in PANELS:
        for view in of_kind(panel.draw(run), ViewReference):
            assert (view.panel, view.title) in titles


def test_signals_show_measured_predicted_and_limits_in_colours_of_their_own(run: RunColumns) -> None:
    plots = {plot.title: plot for plot in of_kind(signals.draw_overview(run), TimePlot)}
    assert list(plots) == ["C: concentration of A in the reactor", "T: temperature of the reactor", "qc: coolant flow"]
    temperature = plots["T: temperature of the reactor"]
    assert temperature.unit == "K"
    lines = {series.name: series for series in temperature.series}
    assert list(lines) == ["upper limit", "lower limit", "measured", "predicted"]
    assert lines["measured"].value is run.samples["T"].value
    assert lines["predicted"].value is run.estimates["T"].prediction
    assert lines["upper limit"].value is run.estimates["T"].upper_limit
    assert len({lines[name].colour for name in ("upper limit", "measured", "predicted")}) == 3
    (flow,) = plots["qc: coolant flow"].series
    assert flow.held


def test_what_a_suspected_sensor_should_read_is_drawn_beside_what_it_reads(run: RunColumns) -> None:
    rebuilt = ReconstructionColumns(run.samples["T"].time_ns[5:9], np.arange(4.0), np.ones(4))
    plots = {
        plot.title[0]: plot
        for plot in of_kind(signals.draw_overview(replace(run, reconstructions={"T": rebuilt})), TimePlot)
    }
    assert next(series for series in plots["T"].series if series.name == "reconstructed").value is rebuilt.value
    assert "reconstructed" not in {series.name for series in plots["C"].series}


def test_signals_of_no_known_process_are_drawn_by_their_names(run: RunColumns) -> None:
    """A run says names and units; nothing has to be the reactor."""
    strange = replace(
        only(run, "T"), samples={"pH": run.samples["T"]}, units={"pH": ""}, statistics={"pH": run.statistics["T"]}
    )
    (plot,) = of_kind(signals.draw_overview(strange), TimePlot)
    assert (plot.title, plot.unit) == ("pH", "")


def test_residuals_open_on_what_was_judged(run: RunColumns) -> None:
    """A first prediction that is wild does not set the scale."""
    wild = run.estimates["T"].residual.copy()
    wild[0] = 1e6
    changed = replace(run, estimates={"T": run.estimates["T"]._replace(residual=wild)}, charts={})
    (plot,) = signals.draw_charts(changed)
    watched = np.isfinite(run.estimates["T"].upper_limit)
    assert plot.shown is not None
    lower, upper = plot.shown
    assert lower < wild[watched].min() < wild[watched].max() < upper < 1.0
    learning = run.estimates["T"]._replace(lower_limit=wild * np.nan, upper_limit=wild * np.nan)
    (plot,) = signals.draw_charts(replace(run, estimates={"T": learning}, charts={}))
    assert plot.shown is None


def chart(*statistic: float) -> ChartColumns:
    """A chart with limits at +-3 around 1."""
    ones, value = np.ones(len(statistic)), np.array(statistic)
    out = np.abs(value - 1.0) > 3.0
    return ChartColumns(np.arange(len(statistic)) * 10**9, value, ones, ones - 3.0, ones + 3.0, out.astype(float))


def test_every_chart_is_drawn_with_its_limits_those_of_all_signals_last(run: RunColumns) -> None:
    names = ("shewhart/T", "mewma/all", "ewma/C")
    plots = signals.draw_charts(replace(run, estimates={}, charts=dict.fromkeys(names, chart(0.0, 1.0))))
    assert [plot.title for plot in plots] == ["Chart ewma/C", "Chart shewhart/T", "Chart mewma/all"]
    lines = {series.name: series.value.tolist() for series in plots[0].series}
    assert (lines["upper limit"], lines["centre"], lines["lower limit"]) == ([4.0, 4.0], [1.0, 1.0], [-2.0, -2.0])
    assert lines["statistic"] == [0.0, 1.0]


def test_what_is_out_of_limits_is_drawn_as_an_alarm(run: RunColumns) -> None:
    (plot,) = signals.draw_charts(replace(run, estimates={}, charts={"ewma/T": chart(1.0, 2.0, 9.0, 8.0, 2.0)}))
    out = next(series for series in plot.series if series.name == "statistic out")
    assert out.colour == ALARM
    # the line comes from where it was, and ends with the last that is out
    assert np.array_equal(out.value, [np.nan, 2.0, 9.0, 8.0, np.nan], equal_nan=True)
    assert plot.shown is None


def test_a_statistic_that_goes_through_the_roof_leaves_the_limits_visible(run: RunColumns) -> None:
    (plot,) = signals.draw_charts(replace(run, estimates={}, charts={"mewma/all": chart(1.0, 1e6, -1e6)}))
    assert plot.shown is not None
    lower, upper = plot.shown
    assert 4.0 < upper < 100.0
    assert -100.0 < lower < -2.0
    edge = next(series for series in plot.series if series.name == "statistic out of the plot").value
    assert np.isnan(edge[0])
    assert lower < edge[2] < edge[1] < upper
    assert max(series.value.max() for series in plot.series if series.name == "statistic") == 1e6, "nothing is cut off"


def test_the_log_lists_alarms_and_faults_in_order(run: RunColumns) -> None:
    assert [(event.kind, event.text) for event in log_of(run).events] == [
        ("fault", "20.0 min  injected: coolant_flow:step:-0.05@20min"),
        ("raised", "22.0 min  shewhart/T: T is lower than the model expects"),
        ("cleared", "27.0 min  shewhart/T: T is back between its limits"),
    ]


def test_the_log_of_a_stretch_counts_from_the_beginning_of_the_run() -> None:
    texts = [event.text for part in read_segments(golden.entries(), 500) for event in log_of(part).events]
    assert [text.split("  ")[0] for text in texts] == ["20.0 min", "22.0 min", "27.0 min"]


def changed_alarm(before: messages.Alarm, **values: Any) -> messages.Alarm:
    """Copy of an alarm with other values."""
    names = ("time_ns", "alarm", "state", "priority", "text", "event", "suspects")
    return messages.Alarm(**{**{name: getattr(before, name) for name in names}, **values})


def test_the_log_lists_the_suspects_of_one_look_once(run: RunColumns) -> None:
    suspect = messages.Suspect(cause="coolant_flow", probability=0.9, profile="step", size=-0.05, unit="1")
    suspect.onset_ns = run.span_ns[0] + 20 * 60_000_000_000
    raised = changed_alarm(run.alarms[0], event="raised")
    look = messages.Incident(time_ns=raised.time_ns, number=1, suspects=[suspect])
    with_look = replace(run, alarms=(raised,), incidents=(look,))
    event = ("suspect", "22.0 min  coolant_flow (90 %; step of -0.05 at 20.0 min)")
    assert [(event.kind, event.text) for event in log_of(with_look).events][1:] == [
        ("raised", "22.0 min  shewhart/T: T is lower than the model expects"),
        event,
    ]


@pytest.mark.parametrize("before", [False, True], ids=["incidents", "alarms, as earlier versions published them"])
def test_suspects_that_are_published_again_are_read_once(*, before: bool) -> None:
    suspect = messages.Suspect(cause="coolant_flow", probability=0.9)
    reader = RunReader()
    for minute, name in ((22, "shewhart/T"), (22, "ewma/T"), (23, "ewma/T")):
        time_ns = golden.ZERO_NS + minute * 60_000_000_000
        if before:
            alarm = messages.Alarm(time_ns=time_ns, alarm=name, incident=1, event="suspected", suspects=[suspect])
            reader.add(encode(Publication(f"reactor/cstr/alarm/{name}", alarm)))
        else:
            incident = messages.Incident(time_ns=time_ns, number=1, suspects=[suspect])
            reader.add(encode(Publication("reactor/cstr/incident/1", incident)))
    parts = reader.next_segment(), reader.next_segment()
    assert [[item.time_ns for item in part.incidents] for part in parts] == [[golden.ZERO_NS + 22 * 60_000_000_000], []]


def test_every_state_of_an_alarm_has_a_word_and_a_colour(run: RunColumns) -> None:
    changes = [
        changed_alarm(run.alarms[0], state=state, time_ns=state + 1) for state in messages.AlarmState.values() if state
    ]
    (lanes,) = of_kind(status.draw_alarms(replace(run, alarms=tuple(changes))), StateLines)
    (line,) = lanes.lines
    assert len(set(line.states)) == len(changes)
    assert set(line.states) <= lanes.colours.keys()


def test_the_life_of_an_alarm_is_a_line_that_begins_with_the_run(run: RunColumns) -> None:
    first = changed_alarm(run.alarms[0], event="raised")
    (lanes,) = of_kind(status.draw_alarms(replace(run, alarms=(first, *run.alarms[1:]))), StateLines)
    (line,) = lanes.lines
    assert line.name == "shewhart/T"
    assert line.states == ("normal", "raised", "cleared")
    minutes = (0.0, golden.RAISED_MIN, golden.CLEARED_MIN)
    assert line.time_ns == tuple(golden.time_ns(round(at / golden.STEP_MIN)) for at in minutes)


def test_a_known_alarm_from_before_is_not_logged_again(run: RunColumns) -> None:
    earlier = replace(run.context, first_ns=run.span_ns[0], alarm_states={"shewhart/T": messages.ALARM_STATE_NORMAL})
    again = replace(run, alarms=(changed_alarm(run.alarms[0], event="raised"),), context=earlier)
    (lanes,) = of_kind(status.draw_alarms(again), StateLines)
    assert lanes.lines[0].states == ("raised",)


def snapshot(at: int, parameters: dict[str, tuple[float, float]], excitation: float) -> messages.ModelSnapshot:
    """Model at a time; parameters map a name to value and standard deviation."""
    listed = [messages.Parameter(name=name, value=value, sd=sd) for name, (value, sd) in parameters.items()]
    return messages.ModelSnapshot(time_ns=at, parameters=listed, excitation=excitation)


@pytest.mark.parametrize(
    ("purpose", "name"), [(REFERENCE, "reference model"), (FROZEN, "model frozen since the training")]
)
def test_parameters_of_both_models_are_drawn_with_their_intervals(run: RunColumns, purpose: str, name: str) -> None:
    """A model that is not the reference is not labelled as it."""
    adapting = tuple(snapshot(at, {"a1": (0.9 + at, 0.1), "b1": (2.0, 0.5)}, 0.02 * at) for at in (1, 2))
    judged = (snapshot(2, {"a1": (0.8, 0.1), "b1": (1.9, 0.5)}, 0.03),)
    plots = signals.draw_models(replace(run, models={("T", ADAPTIVE): adapting, ("T", purpose): judged}))
    assert [plot.title.split(" of ")[0] for plot in plots] == [
        "Parameters a",
        "Parameters b",
        "Excitation",
    ]
    lines = {series.name: series.value for series in plots[0].series}
    assert lines["a1"] == pytest.approx([1.9, 2.9])
    assert lines["a1 upper end"] - lines["a1"] == pytest.approx(0.196)
    assert lines[f"a1 {name}"] == pytest.approx([0.8])
    excitation = {series.name: series.value.tolist() for series in plots[-1].series}
    assert excitation == {name: [0.03], "adaptive model": [0.02, 0.04]}


def test_parameters_of_several_inputs_are_drawn_for_each_input_by_its_name(run: RunColumns) -> None:
    names = ("a1", "b1_1", "b1_2", "b2_1", "b2_2", "c")
    adapting = snapshot(1, dict.fromkeys(names, (1.0, 0.1)), 0.5)
    described = replace(run, models={("h1", ADAPTIVE): (adapting,)}, process=find_process("three_tanks"))
    plots = {plot.title: plot for plot in signals.draw_models(described)}
    assert list(plots)[:4] == [
        "Parameters a of the model of h1: of the output",
        "Parameters b of the model of h1: of the input Q1",
        "Parameters b of the model of h1: of the input Q2",
        "Parameters c of the model of h1: offset",
    ]
    drawn = [line.name for line in plots["Parameters b of the model of h1: of the input Q2"].series]
    assert [name for name in drawn if name in names] == ["b1_2", "b2_2"]
    assert "Parameters b of the model of h1: of the input 2" in [
        plot.title for plot in signals.draw_models(replace(described, process=None))
    ]


def test_the_noise_levels_of_the_equations_that_judge_are_drawn(run: RunColumns) -> None:
    judged = tuple(snapshot(at, {"sensor_sd": (0.3, 0.0), "C_sd": (1e-4, 0.0)}, 0.0) for at in (1, 2))
    (plot,) = signals.draw_models(replace(run, models={("T", EQUATIONS): judged}))
    assert plot.title == "Noise levels of the equations for T"
    assert {series.name: series.value.tolist() for series in plot.series} == {
        "sensor_sd": [0.3, 0.3],
        "C_sd": [1e-4, 1e-4],
    }


def test_health_shows_phases_lag_and_troubles_of_each_node(run: RunColumns) -> None:
    reports = {
        "monitor": (
            messages.Health(time_ns=5, phase="training", lag_ms=1.5),
            messages.Health(time_ns=9, phase="watching", lag_ms=2.5, lost=3, late=4),
        ),
        "plant": (messages.Health(time_ns=5, phase="running"),),
    }
    phases, lag, troubles = status.draw_health(replace(run, health=reports))
    assert isinstance(phases, StateLines)
    assert [(line.name, line.states) for line in phases.lines] == [
        ("monitor", ("training", "watching")),
        ("plant", ("running",)),
    ]
    assert isinstance(lag, TimePlot)
    assert isinstance(troubles, TimePlot)
    assert [series.value.tolist() for series in lag.series] == [[1.5, 2.5], [0.0]]
    assert [series.value.tolist() for series in troubles.series] == [[0.0, 7.0], [0.0]]


def described(*signals: tuple[str, str, str]) -> RunColumns:
    """A run of a process of these signals: name, role and unit."""
    process = Process("rig", tuple(Signal(name, unit, role) for name, role, unit in signals))
    time_ns = np.arange(3, dtype=np.int64)
    samples = {name: SampleColumns(time_ns, np.arange(3.0)) for name, _, _ in reversed(signals)}
    return RunColumns("rig", process.units, samples, {}, {}, (), (), process=process)


def overview_of(run: RunColumns) -> dict[str, tuple[list[str], bool]]:
    """Lines of each plot of the overview, and whether the signal of the plot is held between its samples."""
    plots = of_kind(signals.draw_overview(run), TimePlot)
    return {plot.title: ([line.legend or line.name for line in plot.series], plot.series[-1].held) for plot in plots}


def test_plots_are_ordered_by_role_and_set_points_are_drawn_with_their_outputs() -> None:
    run = described(
        ("mode", "mode", ""), ("Q1", "input", "%"), ("T1", "output", "degC"), ("T2", "output", "degC"),
        ("SP2", "setpoint", "degC"), ("T1.sp", "setpoint", "degC"), ("SP3", "setpoint", "degC"),
        ("p", "output", "bar"), ("p_sp", "setpoint", "mbar"), ("q", "output", "l/min"), ("target", "setpoint", "l/min"),
    )  # fmt: skip
    assert list(overview_of(run).items()) == [
        ("T1", (["T1.sp", "measured"], False)),
        ("T2", (["SP2", "measured"], False)),
        ("p", (["measured"], False)),
        ("q", (["target", "measured"], False)),
        ("SP3", (["measured"], True)),
        ("p_sp", (["measured"], True)),
        ("Q1", (["measured"], True)),
        ("mode", (["measured"], True)),
    ]


def test_a_signal_has_the_role_and_meaning_that_its_process_gives_it_and_not_those_of_its_name() -> None:
    run = described(("u", "output", "V"), ("T", "output", "K"), ("qc", "output", "l/min"), ("C", "input", "mol/l"))
    assert list(overview_of(run).items()) == [
        *((name, (["measured"], False)) for name in ("u", "T", "qc")),
        ("C", (["measured"], True)),
    ]
    assert list(overview_of(replace(run, process=None)))[-1].startswith("qc: ")


def test_the_phase_plane_is_that_of_the_equations_that_the_process_has(run: RunColumns) -> None:
    """A process of the same signals without equations, and one with equations of other constants."""
    reactor = find_process("cstr")
    hotter = Process("rig", reactor.signals, reactor.equations, parameters={"Tf": (360.0, 0.0, "K")})
    (nominal, _), (own, _) = phase_plane.draw(run), phase_plane.draw(replace(run, process=reactor.without_equations()))
    assert own.box == nominal.box
    assert phase_plane.draw(replace(run, process=replace(reactor.without_equations(), name="rig"))) == ()
    assert phase_plane.draw(replace(run, process=hotter))[0].box != nominal.box


def promise(minute: int, found: int, *, kept: bool = True) -> Encoded:
    power = Power(deviation="T.bias", unit="K", within_1_h=0.21, within_1_day=0.1)
    message = Promise(
        time_ns=minute * MINUTE,
        found=found,
        expected_so_far=0.01 * minute,
        kept=kept,
        text=f"{found} alarms",
        power=[power],
    )
    return encode(Publication(keys.key("cstr", keys.PROMISE, "monitor"), message))


def test_alarms_found_and_promised_are_two_lines() -> None:
    plot, _ = status.PROMISE.draw(read_run([promise(100, 0), promise(105, 0), promise(107, 2)]))
    assert isinstance(plot, TimePlot)
    promised, found = plot.series
    assert np.allclose(promised.value, [1.0, 1.05, 1.07])
    assert np.allclose(found.value, [0, 0, 2])
    assert (found.time_ns == np.array([100, 105, 107]) * MINUTE).all()


def test_the_log_has_a_line_for_each_change_and_the_power_once() -> None:
    _, log = status.PROMISE.draw(
        read_run([promise(100, 0), promise(105, 0), promise(107, 2), promise(110, 2, kept=False)])
    )
    assert isinstance(log, EventLog)
    assert [event.kind for event in log.events] == ["promise", "power", "promise", "promise"]
    assert "T.bias (K): none within 10 min, 0.21 within an hour, 0.1 within a day" in log.events[1].text
    assert log.events[-1].colour == ALARM


def test_a_run_without_a_promise_has_no_such_panel() -> None:
    assert status.PROMISE.draw(read_run([])) == ()
