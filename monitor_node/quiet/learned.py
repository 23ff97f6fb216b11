"""Between a record and what the parts of a watch have learned and remember: signals, filter and prewhitening."""

from math import inf, isfinite
from typing import TypeAlias

import msgspec
import numpy as np

from monitor_node.baseline.references import ProcessReferenceState
from monitor_node.ingest.sampling import Spacing
from monitor_node.signal_checks.spike import SpikeState
from monitor_node.signal_checks.stage import SignalChecksState
from monitor_node.signal_checks.stuck import StuckState, longest_normal_run
from monitor_node.signal_checks.timeout import DataTimeoutState
from monitor_node.state.pipeline_state import PipelineState, TrainedState
from reactorwatch.kalman.ekf import FilterState, NoiseLevels, variances
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.prewhitening import PrewhitenerState, Prewhitening

EqualRuns: TypeAlias = tuple[dict[int, int], float]
"""How often an output read the same so many times in a row, in the training; and the run length of its alarm."""


def is_usual(watch: PipelineState, watched: TrainedState, reference: ProcessReferenceState, last_ns: int) -> bool:
    """Whether the newest row was judged by all, and left nothing undecided."""
    sampling, signals = watch.sampling, watch.signals
    if sampling.last_ns != last_ns or sampling.period_ns is None or sampling.spacing_ns is None:
        return False
    if (
        reference.guessed
        or reference.held_rows
        or reference.filter.time_min != last_ns / MINUTE_NS
        or True in watched.withheld
    ):
        return False
    return (
        reference.filter.inputs == (reference.last_input,)
        and all(not silence.standing and silence.last_ns == last_ns for silence in signals.silences)
        and all(not stuck.learning and stuck.last is not None for stuck in signals.stuck)
        and all(spike is None or (spike.phase == "quiet" and not spike.recent) for spike in signals.spikes)
        and all(len(item.past) == max(len(item.learned.coefficients), 1) for item in watched.whiteners)
    )


def write_signals(p: np.void, signals: SignalChecksState) -> None:
    """Note what is remembered of silences, stuck sensors and spikes."""
    receipts = signals.silences[0].receipts
    p["receipt_count"], p["receipt_mean"], p["receipt_deviation"] = msgspec.structs.astuple(receipts)
    for place, silence in enumerate(signals.silences):
        count, mean, deviation = msgspec.structs.astuple(silence.rows)
        p["silence_count"][place], p["silence_mean"][place], p["silence_deviation"][place] = count, mean, deviation
    for place, (stuck, spike) in enumerate(zip(signals.stuck, signals.spikes, strict=True)):
        p["spike_limit"][place] = inf if spike is None else spike.limit
        p["equal_limit"][place], p["quietest"][place] = longest_normal_run(stuck.runs, stuck.arl0), stuck.quietest
        p["last"][place], p["repeats"][place] = stuck.last, stuck.repeats
        p["stepped"][place] = len(stuck.steps)
        p["steps"][place, : len(stuck.steps)] = stuck.steps


def signals_of(p: np.void, runs: list[EqualRuns], silence_periods: float, least_s: float) -> SignalChecksState:
    """What is remembered of silences, stuck sensors and spikes.

    Args:
        p: record of the plant.
        runs: of equal readings in the training, of each output.
        silence_periods: as in the settings.
        least_s: see `DataTimeout`.
    """
    receipts = Spacing(int(p["receipt_count"]), float(p["receipt_mean"]), float(p["receipt_deviation"]))
    silences = []
    spacings = zip(*(p[f"silence_{field}"].tolist() for field in ("count", "mean", "deviation")), strict=True)
    for place, (count, mean, deviation) in enumerate(spacings):
        heard = Spacing() if place else receipts
        spacing = Spacing(count, mean, deviation)
        silences.append(DataTimeoutState(silence_periods, least_s, spacing, heard, int(p["last_ns"]), False))
    stuck = [
        StuckState(
            arl0,
            of_training,
            float(p["quietest"][place]),
            float(p["last"][place]),
            int(p["repeats"][place]),
            p["steps"][place, : p["stepped"][place]].tolist(),
            False,
        )
        for place, (of_training, arl0) in enumerate(runs)
    ]
    spikes = [
        SpikeState(float(limit), "quiet", 0.0, []) if isfinite(limit) else None for limit in p["spike_limit"].tolist()
    ]
    return SignalChecksState(silences, stuck, spikes)


def write_whitener(p: np.void, place: int, state: PrewhitenerState) -> None:
    """Note the prewhitening of an output."""
    learned, order = state.learned, len(state.learned.coefficients)
    p["order"][place], p["learned_rows"][place] = order, learned.rows
    p["constant"][place], p["sigma"][place] = learned.constant, learned.sd
    p["coefficients"][place, :order] = learned.coefficients
    p["sigma_variance"][place], p["passed_variance"][place] = learned.sd_variance, learned.passed_variance
    p["past"][place, : len(state.past)] = state.past


def whitener_of(p: np.void, place: int) -> PrewhitenerState:
    """The prewhitening of an output."""
    order = int(p["order"][place])
    learned = Prewhitening(
        float(p["constant"][place]),
        tuple(p["coefficients"][place, :order].tolist()),
        float(p["sigma"][place]),
        int(p["learned_rows"][place]),
        float(p["sigma_variance"][place]),
        float(p["passed_variance"][place]),
    )
    return PrewhitenerState(learned, p["past"][place, : max(order, 1)].tolist())


def write_reference(p: np.void, reference: ProcessReferenceState, model: ProcessModel) -> None:
    """Note the filter; of a plant that was judged already."""
    p["time_min"], p["input"] = reference.filter.time_min or 0.0, reference.last_input
    p["reach"] = reference.reach
    p["memory"] = [*reference.filter.x, *reference.filter.P]
    p["noise"] = [*reference.noise.measurement_sd, *reference.noise.process_sd]
    p["variance"], p["typical_sd"] = variances(model, reference.noise), reference.typical_sd


def reference_of(p: np.void, states: int) -> ProcessReferenceState:
    """The filter, of a model with so many states."""
    memory, noise, outputs = p["memory"].tolist(), p["noise"].tolist(), len(p["typical_sd"])
    last_input = float(p["input"])
    return ProcessReferenceState(
        NoiseLevels(tuple(noise[:outputs]), tuple(noise[outputs:])),
        FilterState(float(p["time_min"]), (last_input,), tuple(memory[:states]), tuple(memory[states:])),
        last_input,
        False,
        p["typical_sd"].tolist(),
        0,
        float(p["reach"]),
    )
