"""Balances of a model with causes in them, as MathML with the causes' terms marked."""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from reactorwatch.diagnosis.report import mathml
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import ProcessModel


@dataclass(frozen=True)
class Equation:
    """One equation.

    Attributes:
        left: MathML of the left side.
        right: MathML of the right side; if it is too long, the former one with a remark that it has changed.
        changed: true if a cause is in it.
    """

    left: str
    right: str
    changed: bool


@dataclass(frozen=True)
class Meaning:
    """Meaning of a cause.

    Attributes:
        symbol: MathML of its magnitude in the equations.
        text: effect of the cause in a sentence.
    """

    symbol: str
    text: str


def balances(model: ProcessModel, effects: Sequence[Effect]) -> list[Equation]:
    """All balances, and the output equations that have changed.

    Args:
        model: process model without the effects.
        effects: effects to add.
    """
    symbols = [ca.SX.sym(symbol) for symbol in _symbols(effects)]
    extended = model
    pairs = sorted(zip(effects, symbols, strict=True), key=lambda pair: pair[0].location == TIMING)
    for effect, size in pairs:
        extended = effect.apply(extended, size)
    brought = [state.symbol for state in extended.states if state.name not in model.state_names]
    new = ca.vertcat(*symbols, *brought)
    before = dict(zip(model.state_names, model.rhs, strict=True))
    result, hidden = [], 0
    for state, rate in zip(extended.states, extended.rhs, strict=True):
        if state.name in before or mathml.is_readable(rate, mathml.LONGEST_NEW):
            result.append(_equation(_rate(state.name), rate, before.get(state.name), new))
        else:
            hidden += 1
    if hidden:
        text = f"further balances of the cause's own, too long to be read here: {hidden}"
        result.append(Equation("", mathml.mark_added(f"<mtext>{text}</mtext>"), changed=True))
    for now, was in zip(extended.outputs, model.outputs, strict=True):
        if _has(now.expression, new):
            left = f"<msub>{mathml.name(now.name)}<mi>measured</mi></msub>"
            result.append(_equation(left, now.expression, was.expression, new))
    return result


def meanings(effects: Sequence[Effect]) -> list[Meaning]:
    """Meaning of each magnitude: the first paragraph of the effect's docstring."""
    return [
        Meaning(mathml.name(symbol), (inspect.getdoc(effect) or effect.label).partition("\n\n")[0].replace("\n", " "))
        for symbol, effect in zip(_symbols(effects), effects, strict=True)
    ]


def _symbols(effects: Sequence[Effect]) -> list[str]:
    return ["m"] if len(effects) == 1 else [f"m_{number}" for number in range(1, len(effects) + 1)]


def _equation(left: str, now: ca.SX, before: ca.SX | None, new: ca.SX) -> Equation:
    if before is None:
        return Equation(left, mathml.mark_added(mathml.to_mathml(now)), changed=True)
    if mathml.is_readable(now):
        return Equation(left, mathml.to_mathml(now, before, new), _has(now, new))
    was = mathml.to_mathml(before) if mathml.is_readable(before) else "<mtext>what it was</mtext>"
    remark = mathml.mark_added("<mtext>, changed as said above</mtext>") if _has(now, new) else ""
    return Equation(left, f"{was}{remark}", _has(now, new))


def _rate(state: str) -> str:
    d = '<mi mathvariant="normal">d</mi>'
    return f"<mfrac><mrow>{d}{mathml.name(state)}</mrow><mrow>{d}<mi>t</mi></mrow></mfrac>"


def _has(expression: ca.SX, new: ca.SX) -> bool:
    return new.numel() > 0 and bool(ca.depends_on(expression, new))
