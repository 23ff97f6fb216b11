"""Section 3.1: the plant under its proportional controllers of temperature and level."""

import numpy as np
from matplotlib.figure import Figure as Drawing
from scipy.optimize import brentq

from benchmarks.study_figures.figure import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    Finding,
    label,
    legend_below,
    panels,
)
from benchmarks.study_figures.study import NAMES, Study
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW, OPERATING_STATE
from reactorwatch.process.library.cstr_operation import LevelControl, TemperatureControl
from reactorwatch.process.simulate import Simulator

GAIN, LEVEL_GAIN = TemperatureControl().gain_l_min_K, LevelControl().gain_per_min
_SET_POINT_STEP_K = 2.0
_STEP_MIN, _END_MIN = 2.0, 10.0
_GAINS = ((1.0, SKY, "--"), (GAIN, BLUE, "-"), (12.0, ORANGE, "-."))
_INFLOW_STEP = 5.0  # l/min
_LEVEL_GAINS = ((0.2, SKY, "--"), (1.0, ORANGE, "-."), (LEVEL_GAIN, BLUE, "-"), (50.0, VERMILION, ":"))


def temperature(study: Study, drawing: Drawing) -> Finding:
    """A step of the set point, at three gains."""
    for_T, for_qc = panels(drawing, 2, 1, sharex=True)
    set_point = OPERATING_STATE[1]
    steps = ((0.0, set_point), (_STEP_MIN, set_point + _SET_POINT_STEP_K))
    rows, off = [], []
    for gain, colour, style in _GAINS:
        config = PlantConfig(
            seed=study.seed,
            noise_sd={"C": 0.0, "T": 0.0},
            temperature_control=TemperatureControl(set_point_K=steps, gain_l_min_K=gain),
        )
        record = simulate_record(config, round(_END_MIN / config.period_min) + 1)
        T, qc = record.columns["T"], record.columns["qc"]
        for_T.plot(record.time_min, T, style, color=colour, label=f"gain {gain:g} l/min/K")
        for_qc.step(record.time_min, qc, style, where="post", color=colour)
        rest = _closed_loop_rest(study, set_point + _SET_POINT_STEP_K, gain)
        reached, predicted = T[-1] - steps[1][1], rest - steps[1][1]
        off.append(abs(reached - predicted))
        rows.append(f"| {gain:g} | {reached:+.3f} | {predicted:+.3f} | {qc[-1]:.2f} |")
    for_T.step(
        [0.0, _STEP_MIN, _END_MIN], [steps[0][1], steps[1][1], steps[1][1]], where="post", color=GREY, label="set point"
    )
    label(for_T, "", NAMES["T"])
    label(for_qc, "time, min", NAMES["qc"])
    legend_below(drawing, for_T, 4)
    text = (
        f"The set point rises by {_SET_POINT_STEP_K:g} K; rows of 0.1 min, no noise. A proportional controller has no "
        f"other way to hold another flow than by an offset, (qc - {OPERATING_COOLANT_FLOW}) / gain.\n\n"
        "| gain, l/min/K | T - set point at the end, K | at rest by the balances, K | qc at the end, l/min |\n"
        "|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        f"Run and balances differ by at most {max(off):.0e} K. The report's gain is not known; the software's own is "
        f"{GAIN:g} l/min/K."
    )
    return Finding(text)


def level(study: Study, drawing: Drawing) -> Finding:
    """A step of the inflow, at four gains, and at the constant volume that is their limit."""
    for_V, for_T = panels(drawing, 2, 1, sharex=True)
    time_min = np.arange(0.0, 15.0 + 1e-9, 0.05)
    inputs = np.full(time_min.size, OPERATING_COOLANT_FLOW)
    start = study.operating().state
    inflow = {"q": study.model.parameter("q").value + _INFLOW_STEP}
    volume = study.model.parameter("V").value
    constant = study.simulator.run(time_min, inputs, start, inflow).states
    rows, distances, off = [], [], []
    for gain, colour, style in _LEVEL_GAINS:
        model = LevelControl(gain).extend(study.model)
        states = Simulator(model).run(time_min, inputs, np.array([*start, volume]), inflow).states
        for_V.plot(time_min, states[:, 2], style, color=colour, label=f"gain {gain:g} 1/min")
        for_T.plot(time_min, states[:, 1], style, color=colour)
        distance, risen = float(np.max(np.abs(states[:, 1] - constant[:, 1]))), states[-1, 2] - volume
        exact = _INFLOW_STEP / gain * (1 - np.exp(-gain * time_min[-1]))
        distances.append(distance)
        off.append(abs(risen - exact))
        rows.append(f"| {gain:g} | {risen:.3f} | {exact:.3f} | {distance:.3f} |")
    for_V.plot(time_min, np.full(time_min.size, volume), color=BLACK, linewidth=1, label="constant volume")
    for_T.plot(time_min, constant[:, 1], color=BLACK, linewidth=1)
    label(for_V, "", "V, l")
    label(for_T, "minutes after the step of the inflow", NAMES["T"])
    legend_below(drawing, for_V, 5)
    text = (
        f"The inflow rises by {_INFLOW_STEP:g} l/min at {OPERATING_COOLANT_FLOW} l/min of coolant; the volume is a "
        "state.\n\n| gain, 1/min | rise of the volume at the end, l | by the balance, l | largest distance of T from "
        "the plant of constant volume, K |\n|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        "From the slowest controller to the fastest the distance to the plant of constant volume, which the report's "
        f"equations suppose, goes from {distances[0]:.2f} to {distances[-1]:.2f} K. Run and balance of the volume "
        f"differ by at most {max(off):.0e} l."
    )
    return Finding(text)


def _closed_loop_rest(study: Study, set_point_K: float, gain: float) -> float:
    """The temperature at which plant and controller rest together."""

    def off(qc: float) -> float:
        return float(study.operating(qc).state[1]) - set_point_K - (qc - OPERATING_COOLANT_FLOW) / gain

    return float(study.operating(float(brentq(off, 95.0, 110.0, xtol=1e-6))).state[1])
