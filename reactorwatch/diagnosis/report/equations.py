"""The balances of a model with causes in them, as MathML in which what the causes bring is marked."""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from reactorwatch.diagnosis.report import mathml
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import ProcessModel


@dataclass(frozen=True)
class Equation:
    """One line.

    Attributes:
        left: MathML of what it is of.
        right: MathML of what that is; where it is too long to be read, what it was before, and that it has changed.
        changed: whether a cause is in it.
    """

    left: str
    right: str
    changed: bool


@dataclass(frozen=True)
class Meaning:
    """What a cause is.

    Attributes:
        symbol: MathML of its size in the equations.
        text: what it does, in a sentence.
    """

    symbol: str
    text: str


def balances(model: ProcessModel, effects: Sequence[Effect]) -> list[Equation]:
    """All balances, and of the outputs those that show something else than before.

    Args:
        model: without the effects.
        effects: that are put in.
    """
    symbols = [ca.SX.sym(symbol) for symbol in _symbols(effects)]
    extended = model
    pairs = sorted(zip(effects, symbols, strict=True), key=lambda pair: pair[0].location == TIMING)
    for effect, size in pairs:
        extended = effect.apply(extended, size)
    brought = [state.symbol for state in extended.states if state.name not in model.state_names]
    new = ca.vertcat(*symbols, *brought)
    before = dict(zip(model.state_names, model.rhs, strict=True))
    found, hidden = [], 0
    for state, rate in zip(extended.states, extended.rhs, strict=True):
        if state.name in before or mathml.readable(rate, mathml.LONGEST_NEW):
            found.append(_equation(_rate(state.name), rate, before.get(state.name), new))
        else:
            hidden += 1
    if hidden:
        text = f"further balances of the cause's own, too long to be read here: {hidden}"
        found.append(Equation("", mathml.marked(f"<mtext>{text}</mtext>"), changed=True))
    for now, was in zip(extended.outputs, model.outputs, strict=True):
        if _has(now.expression, new):
            left = f"<msub>{mathml.name(now.name)}<mi>measured</mi></msub>"
            found.append(_equation(left, now.expression, was.expression, new))
    return found


def meanings(effects: Sequence[Effect]) -> list[Meaning]:
    """What the sizes in the equations stand for: the first sentences of what an effect says of itself."""
    return [
        Meaning(mathml.name(symbol), (inspect.getdoc(effect) or effect.label).partition("\n\n")[0].replace("\n", " "))
        for symbol, effect in zip(_symbols(effects), effects, strict=True)
    ]


def _symbols(effects: Sequence[Effect]) -> list[str]:
    return ["m"] if len(effects) == 1 else [f"m_{number}" for number in range(1, len(effects) + 1)]


def _equation(left: str, now: ca.SX, before: ca.SX | None, new: ca.SX) -> Equation:
    if before is None:
        return Equation(left, mathml.marked(mathml.written(now)), changed=True)
    if mathml.readable(now):
        return Equation(left, mathml.written(now, before, new), _has(now, new))
    was = mathml.written(before) if mathml.readable(before) else "<mtext>what it was</mtext>"
    said = mathml.marked("<mtext>, changed as said above</mtext>") if _has(now, new) else ""
    return Equation(left, f"{was}{said}", _has(now, new))


def _rate(state: str) -> str:
    d = '<mi mathvariant="normal">d</mi>'
    return f"<mfrac><mrow>{d}{mathml.name(state)}</mrow><mrow>{d}<mi>t</mi></mrow></mfrac>"


def _has(expression: ca.SX, new: ca.SX) -> bool:
    return new.numel() > 0 and bool(ca.depends_on(expression, new))
