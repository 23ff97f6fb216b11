"""Section 3.5 and the sampling rate: inputs that excite a model enough, and periods that are good."""

from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Drawing

from benchmarks.study_figures.report_scheme import EVERY, SKIP, report_rows
from benchmarks.study_figures.study import (
    BLACK,
    BLUE,
    FAST_PERIOD_MIN,
    GREEN,
    GREY,
    IDENTIFICATION_HOLD_MIN,
    ORANGE,
    ORDERS,
    PURPLE,
    VERMILION,
    Finding,
    Study,
    Verdict,
    label,
    levels,
    panels,
    row_times,
    verdict,
)
from plant_node.scenario import RandomSteps, Scenario, Sines, Square
from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.identification.checks import (
    FASTEST_SAMPLES,
    LARGEST_CONDITION,
    SLOWEST_SAMPLES,
    conditioning,
    persistence,
    sampling,
)
from reactorwatch.identification.data import Rows, ScaledRecord
from reactorwatch.identification.least_squares import SINGULAR_CONDITION, least_squares
from reactorwatch.identification.structure import Structure
from reactorwatch.records.record import Record

_INPUTS: tuple[tuple[str, Scenario], ...] = (
    ("single sinusoid", Sines(100.0, (6.0,), (5.0,))),
    ("sum of three sinusoids", Sines(100.0, (4.0, 3.0, 2.0), (3.1, 7.3, 19.7))),
    ("square wave", Square(95.0, 105.0, 20.0)),
    ("random steps", RandomSteps(90.0, 111.0, 1.0)),
)
_ROWS, _PERIOD_MIN, _SHOWN_MIN = 4000, 0.1, 40.0


def excitation(study: Study, drawing: Drawing) -> Finding:
    """Each input, its spectrum, and what the check says of it."""
    time_min = row_times(_ROWS, _PERIOD_MIN)
    frequency = np.fft.rfftfreq(_ROWS, _PERIOD_MIN)
    needed = 2 * max(ORDERS)
    axes = panels(drawing, len(_INPUTS), 2, sharex="col", gridspec_kw={"width_ratios": (1.0, 1.0)})
    rows, accepted = [], {}
    for (name, scenario), over_time, over_frequency in zip(_INPUTS, axes[::2], axes[1::2], strict=True):
        u = levels(scenario, time_min, study.seed)
        checks = {order: persistence(u, 2 * order) for order in ORDERS}
        accepted[name] = checks[max(ORDERS)].passed
        colour = GREEN if accepted[name] else VERMILION
        shown = time_min <= _SHOWN_MIN
        over_time.step(time_min[shown], u[shown], where="post", color=BLUE, linewidth=1.2)
        spectrum = 2 * np.abs(np.fft.rfft(u - u.mean())) / _ROWS
        over_frequency.semilogy(frequency[1:], np.maximum(spectrum[1:], 1e-4), color=colour, linewidth=1)
        over_frequency.set_ylim(1e-4, 20)
        over_frequency.set_xlim(0, 1.0)
        said = "accepted" if accepted[name] else "refused"
        label(over_time, "", "l/min", name)
        label(over_frequency, "", "l/min", f"excites order {checks[max(ORDERS)].value:.0f} of {needed}: {said}")
        verdicts = " | ".join("accepted" if checks[order].passed else "refused" for order in ORDERS)
        rows.append(f"| {name} | {verdicts} |")
    axes[-2].set_xlabel("time, min")
    axes[-1].set_xlabel("frequency, 1/min (amplitude spectrum)")
    reason = persistence(levels(_INPUTS[0][1], time_min, study.seed), needed).result
    text = (
        "An ARX or OE model of order n has 2 n parameters on past outputs and inputs, and needs an input that excites "
        "as many.\n\n| input | order 1 | order 2 | order 3 |\n|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        f'What the software says of the single sinusoid for a third-order model: "{reason}".'
    )
    as_reported = not accepted["single sinusoid"] and accepted["sum of three sinusoids"] and accepted["square wave"]
    return Finding(text, verdict(as_reported))


_DECIMATIONS = (1, 2, 4, 5, 10, 20, 30, 40, 60, 80, 120, 240)
"""Every level of the fast records is held for a whole number of such periods."""
_CLOCK = 10
"""The decimation that gives the clock of 0.1 min, which is that of the DaISy record."""
_OUTPUT = "T"
_STEPS = f"steps every {IDENTIFICATION_HOLD_MIN:g} min"
_DRIVEN_BY: dict[str, dict[str, Any]] = {
    "sum of three sinusoids": {"kind": "sines"},
    "square wave": {"kind": "square"},
    _STEPS: {"kind": "random-steps", "hold_min": IDENTIFICATION_HOLD_MIN},
}
_TOP = 1e7  # of the picture; what is above is drawn at its edge
_STRUCTURE = Structure.of_order(3)


def sampling_rate(study: Study, drawing: Drawing) -> Finding:
    """Condition number and length of the step response over the sampling period."""
    for_condition, for_response = panels(drawing, 1, 2)
    periods = np.array(_DECIMATIONS) * FAST_PERIOD_MIN
    conditions: dict[bool, Array] = {}
    judged = []
    for noise, colour, name in ((False, BLUE, "no noise"), (True, ORANGE, "with the sensors' noise")):
        record = study.fast(noise)
        u, y = record.columns["qc"], record.columns[_OUTPUT]
        conditions[noise] = np.array(
            [conditioning(ScaledRecord.of(_STRUCTURE, u[::d], y[::d])).value for d in _DECIMATIONS]
        )
        for_condition.loglog(periods, conditions[noise], "o-", color=colour, markersize=4, label=name)
        if not noise:
            judged = [sampling(ScaledRecord.of(_STRUCTURE, u[::d], y[::d])) for d in _DECIMATIONS]
            really = u[:: _CLOCK * EVERY], y[:: _CLOCK * EVERY]
    samples = np.array([check.value for check in judged])
    chosen = {name: report_choice(study.quiet(scenario)) for name, scenario in _DRIVEN_BY.items()}
    slowed = _condition(ScaledRecord.of(_STRUCTURE, *really).rows())
    clock_min = _CLOCK * FAST_PERIOD_MIN
    for_condition.axhline(LARGEST_CONDITION, color=BLACK, linewidth=1, linestyle=":", label="largest that is accepted")
    for (name, (_, condition, *_)), colour in zip(chosen.items(), (GREEN, VERMILION, PURPLE), strict=True):
        beyond = condition > _TOP
        for_condition.plot(
            clock_min * (1.25 if name == _STEPS else 1.0),
            _TOP if beyond else condition,
            "^" if beyond else "X",
            color=colour,
            markersize=9,
            clip_on=False,
            label=f"every 6th row, {name}" + (": singular" if condition > SINGULAR_CONDITION else ""),
        )
    for_condition.set_ylim(10, _TOP)
    for_condition.plot(
        clock_min * EVERY,
        slowed,
        "D",
        color=BLACK,
        markersize=6,
        label="really sampled 6 times more slowly",
    )
    label(for_condition, "sampling period, min", "condition number of the regressors", "third-order ARX of T")
    for_condition.legend(loc="upper right", bbox_to_anchor=(1.0, 0.95))
    for_response.axhspan(SLOWEST_SAMPLES, FASTEST_SAMPLES, color=GREEN, alpha=0.12, label="accepted")
    for_response.loglog(periods, samples, "-", color=GREY, linewidth=1)
    for name, colour, mark in (("ok", GREEN, "o"), ("too fast", VERMILION, "^"), ("too slow", ORANGE, "v")):
        of_kind = [check.result.startswith(name) for check in judged]
        for_response.plot(
            periods[of_kind], samples[of_kind], mark, color=colour, label=name if name != "ok" else "good"
        )
    label(for_response, "sampling period, min", "samples to 95 % of a step response", "the check of the sampling rate")
    for_response.legend(loc="upper right")
    good = periods[[check.passed for check in judged]]
    too_fast = conditions[False][0] > LARGEST_CONDITION
    worse = [name for name, (_, condition, _, blind) in chosen.items() if condition > SINGULAR_CONDITION and blind]
    cured = [name for name, (every, condition, *_) in chosen.items() if condition < 0.5 * every]
    (_, pole) = study.operating().eigenvalues
    rows = "\n".join(
        f"| {name} | {_format_condition(every)} | {_format_condition(condition)} | {said} |"
        for name, (every, condition, said, _) in chosen.items()
    )
    text = (
        f"Every {periods[0]:g} min the condition number is {conditions[False][0]:.3g} without noise, at most "
        f"{LARGEST_CONDITION:.0g} is accepted: {'' if too_fast else 'not '}too close to singular. With noise it is "
        f"only {conditions[True][0]:.3g}: noise hides the near dependence, it does not cure it. The check, which "
        f"looks at the response instead, accepts periods of {good.min():g} to {good.max():g} min; slower, the "
        f"response is over between two samples (one swing takes {2 * np.pi / abs(pole.imag):.2f} min). Sampled every "
        f"{clock_min * EVERY:g} min the condition number is {slowed:.3g}.\n\n"
        f"The report's choice, every {EVERY}th row from the {SKIP + 1}th on with lags of the "
        f"fast clock, on runs without noise with {clock_min:g} min between rows (the clock of the DaISy record; the "
        "report's own is not known):\n\n"
        "| input | condition number, all rows | the report's rows | what the software says of the report's rows |\n"
        f"|---|---|---|---|\n{rows}\n\n"
        f"It makes the regressors better conditioned for {' and '.join(cured) or 'none of these inputs'}: the lags "
        "stay as close as they were, rows are thrown away, the sampling is not slowed."
    )
    if worse:
        text += (
            f" For {' and '.join(worse)} it makes them singular: in every row that is chosen, two of the input's lags "
            "are equal, because the input moves in step with the choice."
        )
    if not too_fast:
        return Finding(text, Verdict.DISAGREES)
    return Finding(text, Verdict.AGREES if cured and not worse else Verdict.IN_PART)


def report_choice(record: Record) -> tuple[float, float, str, bool]:
    """The report's rows of a record."""
    u, y = record.columns["qc"], record.columns[_OUTPUT]
    all_rows = ScaledRecord.of(_STRUCTURE, u, y).rows()
    chosen = report_rows(all_rows)
    try:
        least_squares(chosen.regressors, chosen.outputs)
        said = "fits"
    except InputError as refusal:
        said = f"refused: {str(refusal).partition(':')[0]}"
    rows = np.arange(SKIP, u.size, EVERY)
    lags = [u[rows - lag] for lag in range(_STRUCTURE.delays[0], _STRUCTURE.delays[0] + _STRUCTURE.input_lags)]
    blind = any(np.array_equal(one, other) for one, other in combinations(lags, 2))
    return _condition(all_rows), _condition(chosen), said, blind


def _format_condition(value: float) -> str:
    """A condition number; beyond what can be solved its digits are rounding."""
    return f"{value:.3g}" if value <= SINGULAR_CONDITION else f"above {SINGULAR_CONDITION:.0e}: singular"


def _condition(rows: Rows) -> float:
    return float(np.linalg.cond(rows.regressors))
