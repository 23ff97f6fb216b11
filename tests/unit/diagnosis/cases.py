"""Diagnoses constructed by hand, for tests of reports and drawings."""

from collections.abc import Sequence
from math import nan

import numpy as np
from msgspec.structs import replace

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.difference import compute_difference
from reactorwatch.diagnosis.result import (
    Adequacy,
    AdjustedParameter,
    Alternative,
    Cause,
    Correlation,
    Curves,
    Diagnosis,
    Estimate,
    Experiment,
    ExperimentCurves,
    Gain,
    HeldOut,
    Law,
    LawCurve,
    LocationEvidence,
    Nuisance,
    Remaining,
    RivalLaw,
    Separation,
)
from reactorwatch.process.law import ExtendedLaw

ROWS = 2000

LEAK = Cause(
    cause="coolant_flow",
    profile="step",
    label="coolant leak",
    location="coolant",
    parameters={"size": Estimate(-0.0499634, 8.5e-5, "1"), "onset": Estimate(150.3349, 0.0122, "min")},
)
DRIFT = Cause(
    cause="temperature_bias",
    profile="ramp",
    label="drift of the temperature sensor",
    location="temperature_sensor",
    parameters={
        "size": Estimate(2.5, 0.1, "K"),
        "onset": Estimate(20.0, 3.0, "min"),
        "end": Estimate(199.9, 0.0, "min"),
    },
)
CURVE = Cause(
    cause="feed_temperature",
    profile="free",
    label="wrong feed temperature",
    location="feed",
    parameters={
        "size": Estimate(3.0, 0.2, "K"),
        "time_1": Estimate(0.0, 0.0, "min"),
        "time_2": Estimate(199.9, 0.0, "min"),
        "value_1": Estimate(0.0, 0.07, "1"),
        "value_2": Estimate(1.0, 0.0, "1"),
    },
)
EXPERIMENT = Experiment(
    why="Wider steps of qc tell both apart.",
    input=((0.0, 103.4), (10.0, 90.0)),
    separates=("coolant_flow", "feed_temperature"),
    expected_delta_bic=42.0,
    probability=0.994,
    signal="qc",
    span_min=20.0,
    limits={"qc": (85.0, 115.0), "C": (0.05, 0.2), "T": (425.0, 455.0)},
    separations=(Separation(("coolant_flow", "feed_temperature"), 42.0, 0.994),),
    predicted={
        "coolant_flow": {"C": (0.06, 0.1), "T": (438.5, 448.7)},
        "feed_temperature": {"C": (0.06, 0.11), "T": (438.4, 448.8)},
    },
    curves=ExperimentCurves(
        np.linspace(0.0, 19.9, 200),
        np.repeat([103.4, 90.0], 100),
        {
            name: {"C": np.linspace(0.1, 0.06, 200), "T": np.linspace(438.5, 448.7 + off, 200)}
            for name, off in (("coolant_flow", 0.0), ("feed_temperature", 0.1))
        },
    ),
)


def curves(causes: Sequence[Cause], seed: int = 1) -> Curves:
    """Noise about a sine; the rest follows the names of the causes alone."""
    random = np.random.default_rng(seed)
    time_min: Array = np.linspace(0.0, 199.9, ROWS)
    truth = {"C": 0.1 + 0.01 * np.sin(time_min), "T": 440.0 + 5.0 * np.sin(time_min)}
    noise = {name: random.standard_normal(ROWS) for name in truth}
    measured = {name: truth[name] + sd * noise[name] for name, sd in (("C", 0.002), ("T", 0.3))}
    off = dict.fromkeys(truth, 3.0 * (time_min > 150.0))
    return Curves(
        time_min,
        {"qc": 100.0 + np.floor(time_min) % 7},
        measured,
        {name: truth[name] + off[name] for name in truth},
        truth,
        {name: noise[name] - 10.0 * off[name] for name in truth},
        noise,
        {cause.cause: np.where(time_min > 150.0, cause.parameters["size"].value, 0.0) for cause in causes},
        {cause.cause: np.full(ROWS, cause.parameters["size"].sd) for cause in causes},
    )


def diagnosis_of(
    verdict: str,
    causes: tuple[Cause, ...] = (),
    alternatives: tuple[Alternative, ...] = (),
    *,
    practical: bool = True,
    location: str = "",
    experiment: Experiment | None = None,
    remarks: tuple[str, ...] = (),
    ran_away: bool = False,
    parameters: dict[str, AdjustedParameter] | None = None,
) -> Diagnosis:
    """A diagnosis of 2,000 rows."""
    before = nan if ran_away else 3.2
    held_out = {
        "C": HeldOut(0.0147, 0.00202, 0.0147, 0.00202, 0.00197, "mol/l"),
        "T": HeldOut(before, 0.292, 3.2, 0.292, 0.303, "K"),
    }
    drawn = curves(causes)
    signals = {"qc": (drawn.inputs["qc"], "l/min"), "C": (drawn.simulated_before["C"], "mol/l")}
    differences = {
        name: compute_difference(
            drawn.measured[name] - run,
            drawn.residual_before[name],
            item.noise_sd,
            item.unit,
            drawn.time_min,
            signals,
            item.noise_sd,
        )
        for (name, run), item in zip(drawn.simulated_before.items(), held_out.values(), strict=True)
    }
    return Diagnosis(
        file="run.csv",
        zero=None,
        samples=ROWS,
        runs=1,
        span_min=199.9,
        seconds=1.25,
        verdict=verdict,
        grade="",
        nearest=(),
        onset=None,
        nuisance=(),
        remaining={},
        causes=causes,
        alternatives=alternatives,
        location=location or (causes[0].location if causes else None),
        locations=(LocationEvidence(location, 0.0),) if location else (),
        law=None,
        significant=verdict != "nominal",
        practical=practical and verdict != "nominal",
        gain=Gain(209025.5 if causes else 0.0, held_out),
        adequacy={"C": Adequacy(0.3), "T": Adequacy(0.35)},
        experiment=experiment,
        extended_model={"format": "reactorwatch.model.v1", "model": "cstr", "effects": []},
        parameters=parameters or {},
        differences=differences,
        remarks=remarks,
        curves=drawn,
    )


FEED = Alternative(
    (
        Cause(
            cause="feed_temperature",
            profile="step",
            label="wrong feed temperature",
            location="feed",
            parameters={"size": Estimate(1.234, 0.05, "K"), "onset": Estimate(150.1, 0.4, "min")},
        ),
    ),
    3.21,
)
CASES = {
    "nominal": diagnosis_of("nominal"),
    "named": diagnosis_of("named", (LEAK,)),
    "pair": diagnosis_of("named", (LEAK, DRIFT), remarks=("The record runs under <control>.",)),
    "curve": diagnosis_of("named", (CURVE,), practical=False),
    "ambiguous": diagnosis_of("ambiguous", (LEAK,), (FEED,), experiment=EXPERIMENT, ran_away=True),
    "unknown": diagnosis_of("unknown", location="energy_balance"),
    "law": replace(
        diagnosis_of("unknown", location="energy_balance"),
        locations=(LocationEvidence("energy_balance", 0.0), LocationEvidence("coolant", 4.5)),
        law=Law(
            location="energy_balance",
            form="power",
            formula="a (T/440)^n",
            term="added to dT/dt",
            unit="K/min",
            variables=("T",),
            parameters={"a": Estimate(-0.88, 0.01, "K/min"), "n": Estimate(4.1, 0.2, "1")},
            rivals=(RivalLaw("coolant", "linear", "a + b (qc - 100)", 4.5),),
            range={"T": (425.0, 452.0)},
            held_out={"T": HeldOut(0.98, 0.301, 0.31, 0.3, 0.3, "K")},
            correlations={"a": Correlation("Tf", 0.97)},
            extended=ExtendedLaw(
                "energy balance", "power", ("T",), (440.0,), {"a": -0.88, "n": 4.1}, {"T": (425.0, 452.0)}
            ),
            curves=(
                LawCurve("T", "K", np.array([425.0, 440.0, 452.0]), *(np.array([-0.8, -0.9, -1.0]) for _ in range(3))),
            ),
        ),
    ),
}
TWIN = Cause(
    cause="heat_transfer",
    profile="step",
    label="fouled jacket",
    location="energy_balance",
    parameters={"size": Estimate(-0.12, 0.004, "1"), "onset": Estimate(150.3, 0.1, "min")},
)
CASES["inexact"] = replace(
    diagnosis_of("named", (replace(LEAK, share=0.97, probability=0.48),), (Alternative((TWIN,), 0.0, 0.97, 0.48),)),
    grade="explained",
    with_nuisance=True,
    nearest=(
        replace(LEAK, share=0.97, probability=0.48),
        *(replace(cause, share=0.41, probability=1e-9) for cause in FEED.explanation),
    ),
    nuisance=(
        Nuisance("T.delay", Estimate(-2.0 / 60.0, 0.1 / 60.0, "min"), 0.1),
        Nuisance("C.lag", Estimate(0.2, 0.02, "min"), 0.3),
        Nuisance("volume", Estimate(0.012, 0.002, "1"), 0.02),
    ),
    remaining={"C": Remaining(0.00202, 0.00197, "mol/l", None), "T": Remaining(0.4, 0.303, "K", None)},
    relative_delays=(Nuisance("qc.delay", Estimate(-0.03, 0.005, "min"), 0.12),),
)
"""Compared with nuisance: another cause acts the same."""

CASES["nearest"] = replace(
    diagnosis_of("unknown", location="energy_balance"),
    grade="nearest",
    nearest=CASES["inexact"].nearest[1:],
    remaining={"T": Remaining(0.9, 0.303, "K", "energy_balance")},
)
ROUGHLY = {
    "K3": AdjustedParameter(700.0, 14.0, 711.2, 1.5, "l/min"),
    "Tf": AdjustedParameter(350.0, 0.5, 350.0, 0.1, "K"),
}
ADJUSTED = diagnosis_of("nominal", parameters=ROUGHLY)
"""Where parameters were stated to be uncertain."""
