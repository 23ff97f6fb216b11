"""The fault bank: its records follow the equations, detectors are what they claim, and results are counted right."""

import io
from math import inf, log

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from benchmarks.faults.__main__ import print_fault_free, print_summary, print_table, quantiles
from benchmarks.faults.detectors import (
    METHODS,
    TRAINING_ROWS,
    Interval,
    Outcome,
    ReportMethod,
    Suspicion,
    Watched,
    alarms_of,
    calibrated_width,
    count_alarms,
    intervals_of,
    outcome_of,
    suspicion,
)
from benchmarks.faults.study import (
    CAUSES,
    MONITOR,
    ORACLE,
    CaseResult,
    FaultFreeResult,
    Widths,
    detectors,
    log_likelihood_ratio,
    oracle_delay_min,
    oracle_suspect,
    rows_to_false_alarm,
    run_case,
    run_fault_free,
)
from benchmarks.harness.bank import (
    AFTER_MIN,
    BANK,
    NOISE_SD,
    TWINS,
    Case,
    Fault,
    cases,
    fault_free,
    record_of,
    truth_of,
)
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Alarm, Incident, Suspect
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record, to_time_ns
from reactorwatch.spc.charts.cusum import cusum_run_length

RAMP = Fault("temperature_bias", "ramp", (0.2, 1.0, 8.0))
ARL0 = rows_to_false_alarm(1.0)
ARX, OE = METHODS
A, B = (1.5, -0.7, 0.1), (0.5, 0.3, 0.1)
BUDGET = 30.0
WIDTHS: Widths = {"ARX": {BUDGET: 5.0}, "OE": {BUDGET: 7.6}}
ONSET_MIN = 300.04
GROSS = Case(next(item for item in BANK if item.name == "temperature_bias"), "large", 5.0, ONSET_MIN, 21)


def test_every_cause_of_the_monitor_is_in_the_bank_as_a_step() -> None:
    assert {fault.cause for fault in BANK if fault.profile == "step"} == {effect.name for effect in CAUSES}


def test_no_two_cases_share_a_seed() -> None:
    found = cases(20)
    assert len({case.seed for case in found}) == len(found)


@pytest.fixture(scope="module")
def ramp() -> tuple[Case, Record]:
    case = Case(RAMP, "large", -8.0, 302.34, 7)
    return case, record_of(case)


def test_a_record_differs_from_its_truth_by_the_noise_of_the_sensors_alone(ramp: tuple[Case, Record]) -> None:
    case, record = ramp
    noise = np.stack([record.columns["C"], record.columns["T"]], axis=1) - truth_of(case, record).faulty
    # The standard error of a standard deviation from 4,500 values is 1 %, that of their autocorrelation 1.5 %.
    assert np.std(noise, axis=0) == pytest.approx(NOISE_SD, rel=0.05)
    assert [abs(np.corrcoef(column[1:], column[:-1])[0, 1]) for column in noise.T] < [0.06, 0.06]


def test_until_the_onset_the_fault_changes_nothing_and_a_ramp_then_reaches_its_size(ramp: tuple[Case, Record]) -> None:
    case, record = ramp
    truth = truth_of(case, record)
    before = record.time_min < case.onset_min
    assert np.array_equal(truth.nominal[before], truth.faulty[before])
    assert truth.faulty[-1] - truth.nominal[-1] == pytest.approx([0.0, -8.0], abs=1e-9)


def test_a_gross_loss_of_heat_is_noted_to_put_the_reactor_out() -> None:
    case = Case(Fault("heat_loss", "step", (0.01, 0.02, 0.1)), "large", 0.1, 300.0, 3)
    assert truth_of(case, record_of(case)).left_branch


@pytest.mark.parametrize("phi", [0.0, 0.5])
def test_noise_is_as_autocorrelated_as_asked_for_and_always_of_the_same_spread(phi: float) -> None:
    columns = [fault_free(seed=5, rows=4000, phi=value).columns for value in (phi, 0.999999)]
    # At phi = 1 the noise never changes: that run is the noise-free one, shifted.
    noise = np.stack([columns[0][signal] - columns[1][signal] for signal in ("C", "T")], axis=1)
    assert np.std(noise, axis=0) == pytest.approx(NOISE_SD, rel=0.1)
    assert [np.corrcoef(column[1:], column[:-1])[0, 1] for column in noise.T] == pytest.approx([phi, phi], abs=0.06)


def test_twins_are_the_causes_that_imitate_each_other_but_for_a_hundredth() -> None:
    signatures = {effect.name: _signature(effect.name) for effect in CAUSES}
    found = {
        cause: {
            other
            for other, rival in signatures.items()
            if other != cause and 1 - (own @ rival) ** 2 / ((own @ own) * (rival @ rival)) < 0.01
        }
        for cause, own in signatures.items()
    }
    assert {cause: set(twins) for cause, twins in TWINS.items()} == {c: twins for c, twins in found.items() if twins}


def _signature(cause: str) -> Array:
    """Response of both measurements to a tenth of the small step, over their noise, in two runs."""
    fault = next(item for item in BANK if item.cause == cause and item.profile == "step")
    effect = next(item for item in CAUSES if item.name == cause)
    simulator = Simulator(effect.extend(cstr(), STEP))
    changes = {f"{cause}.size": fault.signs[0] * fault.sizes[0] / 10, f"{cause}.onset": 20.0}
    time_min = np.arange(round((20 + AFTER_MIN) * 10)) / 10
    parts = []
    for seed in (1, 2):
        flows = np.repeat(np.random.default_rng(seed).uniform(90, 111, time_min.size // 10), 10)
        start = start_state(cstr(), flows[:1], "operating")
        runs = [simulator.run(time_min, flows, start, item).outputs for item in (changes, {})]
        parts.append((runs[0] - runs[1]) / NOISE_SD)
    return np.concatenate(parts).ravel()


def test_the_ratio_is_that_of_normal_densities() -> None:
    rng = np.random.default_rng(1)
    y, y0, y1 = rng.normal(size=(3, 5, 2))
    sd = np.array([0.5, 2.0])
    expected = np.sum(stats.norm.logpdf(y, y1, sd) - stats.norm.logpdf(y, y0, sd), axis=1)
    assert log_likelihood_ratio(y, y0, y1, sd) == pytest.approx(expected)


def test_rows_that_are_just_what_the_fault_gives_add_up_until_the_threshold() -> None:
    time_min = np.arange(1000) / 10
    nominal, faulty = np.zeros((1000, 1)), np.full((1000, 1), 0.6)
    # Each row adds 0.6^2 / 2 = 0.18, so ln(432,000) = 12.98 is reached with the 73rd row from the onset.
    delay_min = oracle_delay_min(time_min, log_likelihood_ratio(faulty, nominal, faulty, np.ones(1)), 20.05, ARL0)
    assert delay_min == pytest.approx(20.1 + 7.2 - 20.05)


def test_in_noise_the_mean_delay_is_that_of_walds_identity() -> None:
    rng = np.random.default_rng(2)
    time_min = np.arange(4000) / 10
    nominal, faulty = np.zeros((4000, 1)), np.full((4000, 1), 0.3)
    delays_min = [
        oracle_delay_min(
            time_min, log_likelihood_ratio(faulty + rng.normal(size=(4000, 1)), nominal, faulty, np.ones(1)), 0.0, ARL0
        )
        for _ in range(400)
    ]
    # h + overshoot = drift x rows; the overshoot of a normal walk of step 0.3 is 0.583 x 0.3 (Siegmund 1985, ch. X).
    rows = (log(ARL0) + 0.583 * 0.3) / 0.045
    # A delay's standard deviation is about sqrt(2 h) / 0.045 = 113 rows, the mean's standard error 5.7.
    assert np.mean(delays_min) * 10 + 1 == pytest.approx(rows, abs=3 * 5.7)


@pytest.mark.parametrize("shift", [0.25, 1.0, 3.0])
def test_pages_test_with_that_threshold_has_at_least_the_promised_run_length(shift: float) -> None:
    arl0 = 2000.0
    # In units of sigma: allowance shift / 2, limit ln(arl0) / shift; one side has twice the run length of two.
    one_sided = 2 * cusum_run_length(0.0, shift / 2, log(arl0) / shift)
    assert one_sided >= arl0


@pytest.mark.parametrize(("cause", "size"), [("temperature_bias", -0.55), ("heat_transfer", -0.25)])
def test_the_oracle_suspects_the_true_cause_of_a_fault_that_no_other_cause_imitates(cause: str, size: float) -> None:
    fault = next(item for item in BANK if item.cause == cause and item.profile == "step")
    case = Case(fault, "medium", size, 300.04, 11)
    record = record_of(case)
    assert oracle_suspect(case, record, truth_of(case, record)) == cause


def linear_record(rows: int, output_error: bool) -> Record:
    """Two linear outputs of order 3 with noise of standard deviation 1, that the plant feels or that it does not."""
    rng = np.random.default_rng(3)
    flows = np.repeat(rng.uniform(90, 111, rows // 10), 10)
    columns = {"qc": flows}
    for signal in ("C", "T"):
        noise, y = rng.normal(size=rows), np.zeros(rows)
        for k in range(3, rows):
            y[k] = A[0] * y[k - 1] + A[1] * y[k - 2] + A[2] * y[k - 3]
            y[k] += B[0] * flows[k - 1] + B[1] * flows[k - 2] + B[2] * flows[k - 3] + (0 if output_error else noise[k])
        columns[signal] = y + (noise if output_error else 0)
    return Record(np.arange(rows) / 10, columns, "linear")


@pytest.mark.parametrize(("method", "output_error"), [(ARX, False), (OE, True)])
def test_on_a_plant_that_its_model_can_describe_3_sigma_is_left_by_chance(
    method: ReportMethod, output_error: bool
) -> None:
    statistic = method.statistic(linear_record(41_000, output_error))
    by_chance = 1 - (1 - 2 * stats.norm.sf(3.0)) ** 2  # of one of two independent normal residuals
    # Standard error of the share: 3.7e-4; and limits learned from 1,000 rows are up to 5 % too narrow or wide.
    assert float(np.mean(statistic[TRAINING_ROWS:] > 3.0)) == pytest.approx(by_chance, abs=1.5e-3)


def test_an_alarm_lasts_from_the_first_point_out_to_the_first_that_is_in() -> None:
    statistic = np.array([9.0, 1.0, 1.0, 4.0, 4.0, 2.0, 5.0])
    found = alarms_of(np.arange(7) / 10, statistic, 3.0)
    assert found == [Interval(0.0, 0.1), Interval(0.3, 0.5), Interval(0.6, np.inf)]
    assert count_alarms([statistic, np.zeros(5)], 3.0) == 3


def test_limits_for_independent_normal_points_are_widened_to_the_normal_quantile() -> None:
    rows = np.abs(np.random.default_rng(4).normal(size=(20, 50_000)))
    width = calibrated_width(list(rows), rows_to_false_alarm=1000.0)
    # 1,000 alarms are counted: a rate known to 3 %, which at 3.3 sigma is a width known to 1 %.
    assert width == pytest.approx(stats.norm.isf(0.5 / 1000), rel=0.02)


def test_limits_count_alarms_and_not_the_points_of_one() -> None:
    # Every hundredth row 10 points in a row are out: one alarm in 100 rows, though one point in ten is out.
    run = np.tile(np.concatenate([np.zeros(90), np.full(10, 5.0)]), 50)
    assert calibrated_width([run], rows_to_false_alarm=99.0) < 5.0
    assert calibrated_width([run], rows_to_false_alarm=101.0) == 5.0


@pytest.mark.parametrize("rows_to_false_alarm", [50.0, 500.0])
def test_at_the_widened_limits_no_more_alarms_come_than_promised(rows_to_false_alarm: float) -> None:
    shocks = np.random.default_rng(5).normal(size=(4, 5000))
    runs = [np.abs(np.convolve(item, np.ones(10), "valid")) for item in shocks]  # each resembles its neighbours
    count = count_alarms(runs, calibrated_width(runs, rows_to_false_alarm))
    allowed = sum(run.size for run in runs) / rows_to_false_alarm
    assert allowed - 1 <= count <= allowed


@pytest.mark.parametrize(
    ("alarms", "delay_min", "false_alarms"),
    [
        ([], inf, 0),
        ([Interval(303.0, inf)], 3.0, 0),
        ([Interval(310.0, inf), Interval(303.0, 305.0)], 3.0, 0),
        ([Interval(150.0, 160.0), Interval(303.0, inf)], 3.0, 1),
        ([Interval(299.0, 302.0), Interval(301.0, 304.0), Interval(305.0, inf)], 5.0, 1),
        ([Interval(299.0, inf), Interval(301.0, inf)], inf, 1),
        ([Interval(303.0, 304.0), Interval(303.0, inf)], 3.0, 0),
        ([Interval(451.0, inf)], inf, 0),
    ],
    ids=[
        "silence",
        "one alarm",
        "the first of two",
        "after a false alarm that is over",
        "not while a false alarm stands",
        "never while a false alarm stands",
        "two at once",
        "too late",
    ],
)
def test_the_first_alarm_after_the_onset_that_none_stood_before_is_the_detection(
    alarms: list[Interval], delay_min: float, false_alarms: int
) -> None:
    outcome = outcome_of(alarms, watching_since_min=100.0, onset_min=300.0, until_min=450.0)
    assert outcome == Outcome(delay_min, false_alarms, watched_min=200.0)


def test_what_is_not_detected_counts_as_endless_in_the_quantiles() -> None:
    assert quantiles([1.0, 3.0, inf, 2.0]) == (2.0, inf)
    assert quantiles([inf, inf, 1.0, inf]) == (inf, inf)


def alarm(event: str, minute: float, name: str = "ewma/T", incident: int = 1) -> Alarm:
    return Alarm(
        time_ns=to_time_ns(minute),
        alarm=name,
        raised_ns=to_time_ns(minute) if event == "raised" else 0,
        cleared_ns=to_time_ns(minute) if event == "cleared" else 0,
        event=event,
        incident=incident,
    )


def suspected(minute: float, incident: int = 1, **suspects: float) -> Incident:
    named = [Suspect(cause=cause, probability=probability) for cause, probability in suspects.items()]
    return Incident(time_ns=to_time_ns(minute), number=incident, suspects=named)


def test_an_alarm_is_active_from_raised_to_cleared_whatever_is_published_between() -> None:
    messages = [
        alarm("raised", 301.0),
        alarm("raised", 302.0, "ewma/C"),
        alarm("acknowledge", 303.0),
        alarm("cleared", 304.0),
        alarm("raised", 305.0),
        alarm("raised", 306.0, "mewma/all"),
        alarm("cleared", 307.0, "mewma/all"),
    ]
    expected = {Interval(301.0, 304.0), Interval(302.0, inf), Interval(305.0, inf), Interval(306.0, 307.0)}
    assert set(intervals_of(messages)) == expected


@pytest.mark.parametrize(
    ("until_min", "expected"),
    [
        (302.0, Suspicion()),
        (310.0, Suspicion(first=False, likely=True, twin_first=True)),
        (400.0, Suspicion(first=True, likely=True, twin_first=False)),
    ],
)
def test_what_counts_is_the_newest_word_on_the_incident(until_min: float, expected: Suspicion) -> None:
    messages = Watched(
        [alarm("raised", 301.0, incident=2), alarm("cleared", 360.0, incident=2)],
        [
            suspected(303.0, 2, heat_loss=0.85, coolant_flow=0.15),
            suspected(350.0, 2, heat_loss=0.05, coolant_flow=0.95),
            suspected(370.0, 3, temperature_bias=1.0),
        ],
        0.0,
        450.0,
    )
    assert suspicion(messages, "coolant_flow", detected_min=301.0, until_min=until_min) == expected


def test_a_suspect_of_little_probability_is_not_among_the_likely() -> None:
    messages = Watched(
        [alarm("raised", 301.0)], [suspected(303.0, temperature_bias=0.92, coolant_flow=0.08)], 0.0, 450.0
    )
    assert suspicion(messages, "coolant_flow", 301.0, 400.0) == Suspicion()
    assert suspicion(messages, "coolant_flow", detected_min=inf, until_min=450.0) == Suspicion()  # nothing is detected


@pytest.fixture(scope="module")
def result() -> CaseResult:
    return run_case(GROSS, (BUDGET,), WIDTHS)


@pytest.fixture(scope="module")
def quiet() -> FaultFreeResult:
    return run_fault_free((31, 0.0), 3000, (BUDGET,), WIDTHS)


def test_a_sensor_that_is_off_by_17_standard_deviations_is_seen_at_once_by_the_oracle_and_by_the_report_method(
    result: CaseResult,
) -> None:
    outcomes = result.outcomes[BUDGET]
    assert set(outcomes) == set(detectors())
    delays_min = [outcomes[name].delay_min for name in (ORACLE, "ARX equal rate", "OE 3 sigma")]
    assert delays_min == pytest.approx([0.06, 0.06, 0.06], abs=1e-6)  # the first row after the onset
    assert outcomes[MONITOR].delay_min < 1.0


def test_false_alarms_are_counted_in_the_200_minutes_between_training_and_onset(result: CaseResult) -> None:
    by_3_sigma = result.outcomes[BUDGET]["ARX 3 sigma"]
    assert by_3_sigma.watched_min == pytest.approx(ONSET_MIN - 100.0)
    # Were the residuals white and normal: 2,000 rows x 0.54 %, about 11. A linear model of this plant makes it more.
    assert 5 <= by_3_sigma.false_alarms <= 60


def test_the_table_and_the_summary_list_the_results(result: CaseResult, quiet: FaultFreeResult) -> None:
    console = Console(file=io.StringIO(), width=200)
    print_table(console, [result], BUDGET)
    print_summary(console, [result], BUDGET, WIDTHS)
    print_fault_free(console, [quiet], BUDGET)
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    (row,) = (line for line in lines if "temperature_bias" in line)
    assert [cell.strip() for cell in row.split("│")][1:4] == ["temperature_bias", "5", "100% 0.06 / 0.06"]
    assert "limits of the report's method at equal rate: ARX +- 5.00 sigma, OE +- 7.60 sigma" in lines
