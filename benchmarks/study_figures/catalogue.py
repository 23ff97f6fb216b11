"""The catalogue of figures. A new one: a function that draws it in a file here, and a line below.

What the report says there is as far as the description of that work tells; where it names a subject and no result, so
does the claim.
"""

from benchmarks.study_figures import (
    best_model,
    control_limits,
    controllers,
    excitation,
    fault_records,
    flow_chart_branches,
    linear_against_plant,
    model_fits,
    phase_plane,
    sampling_rate,
    steady_state_curve,
    step_responses,
)
from benchmarks.study_figures.figure import Figure

FIGURES: tuple[Figure, ...] = (
    Figure(
        4,
        "Steady states over the coolant flow",
        "The plant has several steady states; its operating point is qc = 100 l/min, T = 438.54 K, C = 0.103 mol/l.",
        steady_state_curve.draw,
        height_px=640,
    ),
    Figure(
        5,
        "Phase plane",
        "The nonlinear plant has several steady states.",
        phase_plane.draw,
    ),
    Figure(
        6,
        "Open-loop answers to steps of the coolant flow",
        "Simulates the nonlinear plant.",
        step_responses.draw,
    ),
    Figure(
        7,
        "Proportional temperature controller",
        "A proportional controller of the temperature moves the coolant flow.",
        controllers.temperature,
    ),
    Figure(
        8,
        "Level controller",
        "A level controller moves the outlet flow; the volume is taken as constant in the equations.",
        controllers.level,
    ),
    Figure(
        9,
        "Linear model against the plant at 85 l/min",
        linear_against_plant.claim(85.0),
        linear_against_plant.at_85,
    ),
    Figure(
        10,
        "Linear model against the plant at 100 l/min",
        linear_against_plant.claim(100.0),
        linear_against_plant.at_100,
    ),
    Figure(
        11,
        "Linear model against the plant at 110 l/min",
        linear_against_plant.claim(110.0),
        linear_against_plant.at_110,
    ),
    Figure(
        12,
        "Excitation",
        "A single sinusoid is refused; sums of sinusoids and square waves are good.",
        excitation.draw,
        height_px=640,
    ),
    Figure(
        13,
        "Sampling rate",
        "Sampling too fast makes the regressor singular; every 6th row from the 100th on is taken, with lags in "
        "samples "
        "of the fast clock.",
        sampling_rate.draw,
    ),
    Figure(
        14,
        "ARX models of orders 1 to 3, one-step-ahead prediction",
        "Fits ARX models of order 1, 2 and 3 by least squares; the third order is said to be best.",
        model_fits.arx_one_step,
    ),
    Figure(
        15,
        "ARX models of orders 1 to 3, simulation",
        "As figure 14, the models left to run on their own outputs; the third order is said to be best.",
        model_fits.arx_free_run,
    ),
    Figure(
        16,
        "Output-error models of orders 1 to 3, simulation",
        "Fits output-error models of order 1, 2 and 3; the third order is said to be best.",
        model_fits.oe_free_run,
    ),
    Figure(
        17,
        "The best model",
        "The third order is best. As further work it recommends a neural-network predictor.",
        best_model.draw,
    ),
    Figure(
        18,
        "Control limits of the residual",
        "SPC limits mean +- 3 sigma on the model's residual tell fault-free operation from a mismatch.",
        control_limits.draw,
    ),
    Figure(
        19,
        "The four fault records",
        "Fault free, input leakage and two changes of internal parameters; the faults are detected by the residual.",
        fault_records.draw,
        height_px=720,
    ),
    Figure(
        20,
        "The flow chart",
        "Data, sampling rate good?, model, SPC, mismatch?, parameters accurate?, fault or fault free; then isolation, "
        "identification and reconstruction of the fault.",
        flow_chart_branches.draw,
    ),
)
