"""The catalogue of the report's figures, by the numbers of their captions. A new one: a file here, and a line below.

The report's text refers to several figures by a number one lower than their caption has. Its figures 1 and 2 show no
result: a block diagram and a drawing of the reactor.
"""

from benchmarks.study_figures import (
    best_model,
    controllers,
    data_flow,
    excitation,
    fault_records,
    flow_chart_branches,
    linear_against_plant,
    model_orders,
    phase_plane,
    report_arx,
    sampling_rate,
    steady_state_curve,
    step_responses,
)
from benchmarks.study_figures.figure import Figure

_ORDERS = {1: "first", 2: "second", 3: "third"}
_RECORDS = {
    "17": ("Concentration without a fault", "No fault is detected, and none is there."),
    "18": ("Concentration with input leakage", "The residual shows the fault, a leak of the input."),
    "19": ("Concentration with a changed internal parameter", "The residual shows a change inside the plant."),
    "20": ("Concentration with another changed parameter", "The residual shows another change inside the plant."),
}


def _model(key: str, family: str, order: int) -> Figure:
    title = f"{'ARX' if family == 'arx' else 'OE'}({order},{order}) against the plant"
    claim = f"A model of the {_ORDERS[order]} order predicts the plant's output."
    if order == max(_ORDERS):
        claim += " Of the three orders it predicts best, and its probability of noise is higher."
    return Figure(key, title, claim, model_orders.compare(family, order))


FIGURES: tuple[Figure, ...] = (
    Figure(
        "3",
        "The plant's responses over the coolant flow",
        "At 85 to 95 l/min the response is of first order; beyond 100 l/min it oscillates before it settles.",
        step_responses.draw,
        height_px=640,
    ),
    Figure(
        "4",
        "Steady states over the coolant flow",
        "The plant has several steady states; its operating point is qc = 100 l/min, T = 438.54 K, C = 0.103 mol/l.",
        steady_state_curve.draw,
        height_px=640,
    ),
    Figure("5", "Identification of the ARX(3,3) model", "A scheme of its estimation.", report_arx.estimate),
    Figure(
        "6", "Simulation of the ARX(3,3) model", "An acceptable estimate of the plant's response.", report_arx.simulate
    ),
    Figure(
        "7",
        "The diagnosis scheme",
        "Data, sampling rate good?, model, SPC, mismatch?, parameters accurate?, fault or fault free.",
        flow_chart_branches.draw,
    ),
    Figure(
        "8",
        "C after a unit step at 100 l/min, plant and linear model",
        "The linear model estimates the response around the steady state.",
        linear_against_plant.step_of_c,
    ),
    Figure(
        "9",
        "T after a unit step at 100 l/min, plant and linear model",
        "The linear model estimates the response around the steady state; T behaves in a nonlinear way.",
        linear_against_plant.step_of_t,
    ),
    Figure(
        "10",
        "One linear model at 85, 100 and 110 l/min",
        "After a large step the linear model is off, after a short time it is accurate; at 110 l/min it is not. It is "
        "accurate at the operating point only.",
        linear_against_plant.compare,
        height_px=560,
    ),
    *(_model(str(10 + order), "arx", order) for order in _ORDERS),
    *(_model(str(13 + order), "oe", order) for order in _ORDERS),
    *(Figure(key, title, claim, fault_records.draw_record(key)) for key, (title, claim) in _RECORDS.items()),
    Figure(
        "21-27",
        "Block diagrams of identification and simulation",
        "Simulink diagrams of the models.",
        data_flow.draw,
        360,
    ),
    Figure(
        "section-conclusion",
        "The report's scheme beside the monitor",
        "The diagnosis performance is good, and the approach detects, isolates and identifies a fault.",
        fault_records.compare,
    ),
    Figure(
        "section-best-model",
        "The best model",
        "The third order predicts best. As further work the report recommends a neural network.",
        best_model.draw,
    ),
    Figure(
        "section-steady-states",
        "Phase plane",
        "The nonlinear plant has several steady states.",
        phase_plane.draw,
    ),
    Figure(
        "section-temperature-control",
        "Proportional temperature controller",
        "A proportional controller of the temperature moves the coolant flow.",
        controllers.temperature,
    ),
    Figure(
        "section-level-control",
        "Level controller",
        "A level controller moves the outlet flow; the equations take the volume as constant.",
        controllers.level,
    ),
    Figure(
        "section-excitation",
        "Excitation",
        "A single sinusoid must be avoided; sums of sinusoids and square waves are good.",
        excitation.draw,
        height_px=640,
    ),
    Figure(
        "section-sampling-rate",
        "Sampling rate",
        "Sampling too fast makes neighbouring outputs equal and the regressor matrix singular; the M-files take every "
        "6th row from the 100th on, with lags in samples of the fast clock.",
        sampling_rate.draw,
    ),
)
