"""A diagnosis in words: its verdict, causes, law and errors in sentences, and all of it as lines for a terminal."""

import re
from collections.abc import Collection, Sequence
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from reactorwatch.process import LOCATION_PHRASES
from reactorwatch.process.effect import Effect
from reactorwatch.sentences.numbers import format_error, format_interval, odds, percent, round_estimate
from reactorwatch.terminal import printable_lines

if TYPE_CHECKING:
    from reactorwatch.diagnosis.difference import Difference
    from reactorwatch.diagnosis.result import (
        AdjustedParameter,
        Alternative,
        Cause,
        Curves,
        Diagnosis,
        HeldOut,
        Law,
        Nuisance,
        Remaining,
    )

INDENT = 14

TIME = "time"  # the axis of time in a difference

BETWEEN = " relative to the outputs"  # of a delay that is known better than the clock of either

MOSTLY_NOISE, WORSE = 0.9, 1.2
"""Noise share above which no range is named; error above which a range or an output is named, relative to that of all
rows, or to the noise."""


def describe_verdict(diagnosis: "Diagnosis", *, are_listed: bool = False) -> str:
    """Verdict in a sentence or two; it counts rival explanations that are listed elsewhere, and names others."""
    off = [name for name, item in diagnosis.parameters.items() if item.differs]
    if diagnosis.verdict == "nominal" and off:
        return (
            f"The simulation is right within what was stated of its parameters: {' and '.join(off)} "
            f"{'is' if len(off) == 1 else 'are'} a little off, and the rest of the record is noise."
        )
    if diagnosis.verdict == "nominal" and (corrections := describe_nuisance(diagnosis)):
        return f"The simulation is right but for small corrections: {corrections}."
    if diagnosis.verdict == "nominal" and diagnosis.with_nuisance:
        return "The simulation is right but for corrections that are too small to be listed one by one."
    if diagnosis.verdict == "nominal":
        more = [name for name, item in diagnosis.gain.held_out.items() if item.rmse_after > WORSE * item.noise_sd]
        if more:
            return (
                f"The simulation is right as far as this record tells: {' and '.join(more)} "
                f"{'differs' if len(more) == 1 else 'differ'} by more than the noise of the sensor, but no cause "
                "explains that better than disturbances of the process do."
            )
        return "The simulation is right: the rest of the record is noise."
    matters = describe_significance(diagnosis)
    if diagnosis.verdict == "ambiguous":
        explanations = [diagnosis.causes, *(item.explanation for item in diagnosis.alternatives)]
        if are_listed:
            return (
                f"The simulation is wrong, and the record cannot tell which of {len(explanations)} explanations is "
                f"right. {matters}"
            )
        names = [" with ".join(f"{item.label} ({describe_timing(item)})" for item in causes) for causes in explanations]
        return f"The simulation is wrong, and the record cannot tell why: {' or '.join(names)}. {matters}"
    if diagnosis.verdict == "named":
        causes = [f"{cause.label}, {describe_timing(cause, diagnosis.curves)}" for cause in diagnosis.causes]
        twins = [item.label for other in diagnosis.alternatives if acts_alike(other) for item in other.explanation]
        alike = f", or {' or '.join(twins)}, which acts the same in this record" if twins else ""
        mostly = ", mostly by" if diagnosis.grade == "mostly" else ":"
        share = f" This removes {percent(diagnosis.causes[0].share)} of the squared error." if mostly != ":" else ""
        return f"The simulation is wrong{mostly} {'; and '.join(causes)}{alike}.{share} {matters}"
    text = f"The simulation is wrong, and no known cause explains it; {_describe_unknown(diagnosis)}."
    if diagnosis.grade == "nearest" and (near := nearest_causes(diagnosis)):
        nearest = near[0]
        text += f" Nearest is {nearest.label}, which removes {percent(nearest.share)} of the squared error."
    if diagnosis.law is not None:
        text += f" A law explains it: {diagnosis.law.formula}, {diagnosis.law.term}."
    return f"{text} {matters}"


def describe_nuisance(diagnosis: "Diagnosis") -> str:
    """Small differences beside the causes, in words."""
    return ", ".join(text for text, _ in list_corrections(diagnosis))


def list_corrections(diagnosis: "Diagnosis") -> list[tuple[str, str]]:
    """Small corrections, each with its expected range before the record."""
    items = [*((item, "") for item in diagnosis.nuisance), *((item, BETWEEN) for item in diagnosis.relative_delays)]
    return [(describe_correction(item, diagnosis.remaining) + more, describe_prior(item)) for item, more in items]


def describe_correction(item: "Nuisance", outputs: Collection[str]) -> str:
    """A small correction: times in seconds, shares in per cent.

    Args:
        item: the correction.
        outputs: names of the outputs.
    """
    signal, kind, scale, unit = _correction(item)
    value = replace(item.value, value=scale * item.value.value, sd=scale * item.value.sd, unit=unit)
    amount = format_interval(replace(value, value=abs(value.value)))
    if kind == "lag":
        return f"{signal} lags by {amount}"
    if kind == "delay":  # an output shows what was a delay before its stamp, an input acts a delay after its own
        is_output = signal in outputs
        is_after = (value.value > 0.0) != is_output
        return (
            f"{signal} {'is measured' if is_output else 'acts'} {amount} {'after' if is_after else 'before'} its stamp"
        )
    return f"{item.name} {format_interval(value)}"


def describe_prior(item: "Nuisance") -> str:
    """Expected 95 % range of a small correction before the record."""
    if item.prior_sd is None:
        return "not stated"
    _, kind, scale, unit = _correction(item)
    half = scale * replace(item.value, sd=item.prior_sd).half_width
    return f"{'up to' if kind == 'lag' else '±'} {half:.2g} {unit}".rstrip()


def _correction(item: "Nuisance") -> tuple[str, str, float, str]:
    """Signal, kind (`delay`, `lag` or empty), and scale and unit in which a small correction is shown."""
    signal, _, kind = item.name.rpartition(".")
    if kind in ("delay", "lag") and item.value.unit == "min":
        return signal, kind, 60.0, "s"
    return item.name, "", *((100.0, "%") if item.value.unit == "1" else (1.0, item.value.unit))


def describe_training(diagnosis: "Diagnosis") -> str:
    """Deviation of a plant's training from its equations, in a sentence."""
    if diagnosis.verdict == "nominal":
        return "the training agrees with the equations"
    text = "the training deviates from the equations"
    if not diagnosis.causes:
        return f"{text}, and no cause of the catalogue explains it; {_describe_unknown(diagnosis)}"
    text += f" by {_join_sizes(diagnosis.causes)}"
    others = ", or ".join(_join_sizes(item.explanation) for item in diagnosis.alternatives)
    return f"{text}; its rows do not rule out {others}" if diagnosis.verdict == "ambiguous" else text


def _join_sizes(causes: Sequence["Cause"]) -> str:
    """Causes with their sizes as numbers."""
    texts = []
    for cause in causes:
        size = cause.parameters["size"]
        unit = "" if size.unit == "1" else f" {size.unit}"
        texts.append(
            f"{cause.label} ({cause.cause}) in the course of a curve, which predicts no other rows"
            if cause.profile == "free"
            else f"{cause.label} ({cause.cause}, {cause.profile}) of {size.value:+.3g}{unit}"
        )
    return " and ".join(texts)


def law_rows(law: "Law") -> list[tuple[str, str]]:
    """Facts about a law, each with its name."""
    unit = "" if law.unit == "1" else f", in {law.unit}"
    rows = [("law", f"{law.formula}{unit}, {law.term}")]
    rows += [(name, f"{format_interval(item)}  (95 %)") for name, item in law.parameters.items()]
    for name, item in law.correlations.items():
        rows.append(
            (name, f"would have the correlation {item.correlation:.2f} with {item.parameter}, if that were uncertain")
        )
    ranges = ", ".join(f"{name} from {low:.4g} to {high:.4g}" for name, (low, high) in law.range.items())
    rows.append(("range", f"seen with {ranges}; it need not hold outside"))
    rows += [
        ("or", f"{item.formula} ({item.form}, {describe_place(item.location)}), {_less_likely(item.delta_bic)}")
        for item in law.rivals
    ]
    return rows


def describe_significance(diagnosis: "Diagnosis") -> str:
    """Practical significance."""
    return "It matters in practice." if diagnosis.practical else "In practice the difference is too small to matter."


def describe_place(location: str) -> str:
    """Phrase of a location; the names of a user's own process get no article.

    >>> describe_place("upper_tank"), describe_place("tank3"), describe_place("T1")
    ('in the upper tank', 'in tank 3', 'at T1')
    """
    if location in LOCATION_PHRASES:
        return LOCATION_PHRASES[location]
    words = re.fullmatch(r"([a-z]{3,}(?:_[a-z]+)*)_?(\d*)", location)
    return f"at {location}" if words is None else f"in {words[1].replace('_', ' ')} {words[2]}".rstrip()


def describe_best_place(diagnosis: "Diagnosis") -> str:
    """Place of a deviation without a cause, with its odds against the next place."""
    place, listed = describe_place(diagnosis.location or "record"), diagnosis.locations
    if not listed or listed[0].location != diagnosis.location:
        return place
    if len(listed) == 1:  # all others are worse by 10 BIC or more
        return f"{place} (odds of over 100 to 1 against any other place)"
    return f"{place} (odds of {odds(listed[1].delta_bic)} against the next, {describe_place(listed[1].location)})"


def _describe_unknown(diagnosis: "Diagnosis") -> str:
    if not diagnosis.location:
        return "this record does not tell where it acts"
    return f"an unknown deviation of a single place fits best {describe_best_place(diagnosis)}"


def describe_timing(cause: "Cause", curves: "Curves | None" = None) -> str:
    """Onset of a cause, or its profile in time."""
    if cause.profile == "constant":
        return "all the time"
    if cause.profile == "sine":
        return f"swinging with a period of {format_interval(cause.parameters['period'])}"
    if cause.profile == "free":
        largest = "" if curves is None else f", largest at {_largest_min(cause, curves):.4g} min"
        return f"changing over the record{largest}"
    since = "from the beginning" if cause.from_beginning else f"since {format_interval(cause.parameters['onset'])}"
    if (cause.run or 1) > 1:
        since += f" of run {cause.run}"
    if cause.profile == "ramp":
        return f"growing {since}"
    return f"settling {since}" if cause.profile == "decay" else since


def describe_size(cause: "Cause", effects: Sequence[Effect]) -> str:
    """Size of a cause with its 95 % interval, the part of the profile it belongs to, and constants of the effect.

    Args:
        cause: cause of an explanation.
        effects: the catalogue, which has its meaning.
    """
    of_what = {"ramp": " at the end", "decay": " in the end", "sine": " to either side", "free": " at its largest"}
    own = (item for effect in effects if effect.name == cause.cause for item in effect.constants)
    constants = [f", {item.name} {format_interval(cause.parameters[item.name])}" for item in own]
    return _describe_size(cause, effects) + of_what.get(cause.profile, "") + "".join(constants)


def describe_explanation(causes: Sequence["Cause"], effects: Sequence[Effect]) -> str:
    """Causes of an explanation, each with its size and onset."""
    return " with ".join(
        f"{item.label} ({item.cause}, {item.profile}): {describe_size(item, effects)}, {describe_timing(item)}"
        for item in causes
    )


def _describe_size(cause: "Cause", effects: Sequence[Effect]) -> str:
    size = cause.parameters["size"]
    effect = next((item for item in effects if item.name == cause.cause), None)
    if effect is None or not effect.larger:
        return format_interval(size)
    share = effect.is_share
    amount = replace(size, value=100.0 * size.value, sd=100.0 * size.sd, unit="%") if share else size
    if cause.profile == "sine":  # its sign has no meaning
        return format_interval(amount)
    text = effect.larger
    if amount.value < 0.0 and effect.smaller:
        text, amount = effect.smaller, replace(amount, value=-amount.value)
    value, half = round_estimate(amount)
    unit = "" if amount.unit == "1" else f" {amount.unit}"
    return text.format(value) + (f" (± {half}{unit})" if half else "")


def describe_causes(causes: Sequence[tuple[str, str]], effects: Sequence[Effect]) -> str:
    """Causes of an explanation by their labels.

    Args:
        causes: (cause, profile) of each.
        effects: the catalogue.
    """
    named = {effect.name: effect for effect in effects}
    labels = []
    for cause, profile in causes:
        effect = named.get(cause)
        label = cause if effect is None else effect.labels.get(profile, effect.label)
        labels.append(f"{label} ({cause}, {profile})")
    return " with ".join(labels)


def describe_parameter(item: "AdjustedParameter") -> str:
    """Estimate of an uncertain parameter, with its prior."""
    return f"{format_interval(item.estimate)}; stated: {format_interval(item.prior)}"


def describe_remaining(item: "Remaining") -> str:
    """Error of an output that is left, beside the noise."""
    return f"{format_error(item.rmse, item.unit)}; the noise alone is {item.noise_sd:.3g} {item.unit}"


def describe_holdout(name: str, item: "HeldOut", *, improved: bool) -> str:
    """Error of the simulation on held-out rows, in one line."""
    before = f", before {format_error(item.rmse_before, item.unit)}" if improved else ""
    return f"{name} off by {format_error(item.rmse_after, item.unit)}{before}; noise {item.noise_sd:.3g} {item.unit}"


def describe_difference(item: "Difference") -> str:
    """Error of the simulation in an output, its share of noise, and the time or operating point where it is largest."""
    if not isfinite(item.rmse):
        return "without limit: the simulation ran away from the record"
    text = f"by {item.rmse:.3g} {item.unit}, {percent(item.noise_share)} of it noise"
    if item.noise_share > MOSTLY_NOISE:
        return text
    worst = {axis: part for axis in item.units if (part := item.worst(axis)) and part.rmse > WORSE * item.rmse}
    if not worst:
        return f"{text}; everywhere alike"
    axis, part = max(worst.items(), key=lambda pair: (pair[0] == TIME, pair[1].rmse))
    where = "from" if axis == TIME else f"at {axis}"
    return f"{text}; most {where} {part.lower:.4g} to {part.upper:.4g} {item.units[axis]} ({part.rmse:.3g})"


def _differences(diagnosis: "Diagnosis") -> list[str]:
    """Lines of the outputs that differ in practice, and the count of the others."""
    shown = {name: item for name, item in diagnosis.differences.items() if item.matters}
    lines = [_line("differs", f"{name} {describe_difference(item)}") for name, item in shown.items()]
    if (few := len(diagnosis.differences) - len(shown)) > 0:
        what = f"{few} {'other ' if shown else ''}output{'s' if few > 1 else ''}"
        lines.append(_line("differs", f"{what} by less than matters in practice"))
    return lines


def describe_weight(item: "Cause | Alternative") -> str:
    """Share of the squared error that an explanation removes, and its probability among all explanations."""
    likely = f"{percent(item.probability)} likely against the other causes"
    return f"removes {percent(item.share)} of the squared error; {likely}"


def acts_alike(alternative: "Alternative") -> bool:
    """True if an explanation has the same effect on the outputs as the best one, so that no record separates them."""
    return alternative.delta_bic == 0.0


def following(diagnosis: "Diagnosis") -> "Cause | None":
    """The next best cause that is neither named nor listed as an alternative."""
    listed = {item.cause for item in diagnosis.causes}
    listed |= {item.cause for other in diagnosis.alternatives for item in other.explanation}
    return next((item for item in diagnosis.nearest if item.cause not in listed), None)


def nearest_causes(diagnosis: "Diagnosis") -> list["Cause"]:
    """Causes that remove part of the error that neither a cause nor a law explains, by that share."""
    if diagnosis.verdict != "unknown" or diagnosis.law is not None:
        return []
    return sorted((item for item in diagnosis.nearest if item.share >= 0.01), key=lambda item: -item.share)


def _less_likely(delta_bic: float) -> str:
    return f"less likely by odds of {odds(delta_bic)}"


def _largest_min(cause: "Cause", curves: "Curves") -> float:
    return float(curves.time_min[int(np.argmax(np.abs(curves.deviation[cause.cause])))])


def diagnosis_text(diagnosis: "Diagnosis", effects: Sequence[Effect]) -> str:
    """Verdict, causes with their 95 % intervals, gain, alternatives and remarks.

    Args:
        diagnosis: diagnosis of a record.
        effects: the catalogue.
    """
    lines = [f"{diagnosis.file}: {diagnosis.samples} rows over {diagnosis.span_min:g} min", describe_verdict(diagnosis)]
    ambiguous = diagnosis.verdict == "ambiguous"
    if ambiguous:
        lines += [_line("either", f"{describe_explanation(diagnosis.causes, effects)}  (95 %)")]
        lines += _alternatives(diagnosis, effects) + _experiment(diagnosis)
    for cause in () if ambiguous else diagnosis.causes:
        lines += [
            _line("cause", f"{cause.label} ({cause.cause}, {cause.profile})"),
            _line("size", f"{describe_size(cause, effects)}  (95 %)"),
            _line("when", describe_timing(cause, diagnosis.curves)),
        ]
    if diagnosis.causes and isfinite(diagnosis.causes[0].share) and not ambiguous:
        lines.append(_line("share", describe_weight(diagnosis.causes[0])))
    if diagnosis.verdict != "nominal" and (corrections := describe_nuisance(diagnosis)):
        lines.append(_line("corrected", f"{corrections}  (95 %)"))
    if diagnosis.causes and (after := following(diagnosis)) is not None:
        lines.append(_line("next", f"{after.label} ({after.cause}, {after.profile}), which {describe_weight(after)}"))
    for near in nearest_causes(diagnosis):
        removed = f"removes {percent(near.share)} of the squared error"
        lines.append(_line("nearest", f"{describe_explanation([near], effects)}; {removed}"))
    if len(diagnosis.locations) > 1 and diagnosis.verdict != "named":  # named causes have their places
        places = [
            describe_place(item.location) + (f", {_less_likely(item.delta_bic)}" if item.delta_bic >= 0.05 else "")
            for item in diagnosis.locations
        ]
        lines.append(_line("where", "; ".join(places)))
    if diagnosis.law is not None:
        lines += [_line(name, text) for name, text in law_rows(diagnosis.law)]
    if diagnosis.is_extended and not diagnosis.with_nuisance:
        lines.append(_line("evidence", f"odds of {odds(diagnosis.gain.delta_bic)} against the simulation as it was"))
    if diagnosis.verdict != "nominal":
        lines += _differences(diagnosis)
    for name, known in diagnosis.parameters.items():
        lines.append(_line("parameter", f"{name} {describe_parameter(known)}  (95 %)"))
    for name, item in diagnosis.gain.held_out.items():
        lines.append(_line("held out", describe_holdout(name, item, improved=diagnosis.is_extended)))
    if not ambiguous:
        lines += _alternatives(diagnosis, effects) + _experiment(diagnosis)
    lines += [_line("note", remark) for remark in diagnosis.remarks]
    return printable_lines(lines)


def _alternatives(diagnosis: "Diagnosis", effects: Sequence[Effect]) -> list[str]:
    return [
        _line("or", f"{describe_explanation(item.explanation, effects)}, {describe_rival(item, diagnosis)}")
        for item in diagnosis.alternatives
    ]


def describe_rival(item: "Alternative", diagnosis: "Diagnosis") -> str:
    """Comparison of an alternative with the best explanation."""
    if not diagnosis.with_nuisance:
        return _less_likely(item.delta_bic)
    return "which acts the same in this record" if acts_alike(item) else f"which {describe_weight(item)}"


def _experiment(diagnosis: "Diagnosis") -> list[str]:
    return [] if diagnosis.experiment is None else [_line("experiment", diagnosis.experiment.why)]


def _line(key: str, text: str) -> str:
    return f"  {key:<{INDENT - 2}}{text}"
