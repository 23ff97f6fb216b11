"""Expressions as MathML, which browsers render; new parts are marked.

An expression is a tree. Its two versions, with and without a deviation m, are traversed together from the root. Where
the new tree is an operation on the whole old tree, only the other operand is new. Where both are the same operation,
the difference is further down. Elsewhere the whole new part is marked. So in K3 (1 + m), put for K3, the product is
marked, and in f - m (T - 298), put for f, the term after f.
"""

import xml.etree.ElementTree as ElementTree
from html import escape

import casadi as ca

ADDED = "added"
"""Class of new parts."""

LONGEST, LONGEST_NEW = 60, 30
"""Maximum number of nodes of a readable tree, and of one that is all new."""

_SUM, _PRODUCT, _SIGN, _ATOM = 1, 2, 3, 4
_DEPTH = 50
_SPACE = '<mspace width="0.2em"/>'
_NAMES = {
    ca.OP_FMAX: "max", ca.OP_FMIN: "min", ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_TANH: "tanh",
    ca.OP_SINH: "sinh", ca.OP_COSH: "cosh", ca.OP_ATAN: "arctan", ca.OP_LOG: "ln", ca.OP_SIGN: "sign",
    ca.OP_FABS: "abs", ca.OP_ERF: "erf", ca.OP_FLOOR: "floor", ca.OP_CEIL: "ceil",
}  # fmt: skip
_RELATIONS = {ca.OP_LT: "&lt;", ca.OP_LE: "≤", ca.OP_EQ: "=", ca.OP_NE: "≠", ca.OP_AND: "∧", ca.OP_OR: "∨"}
_POWER = ("<msup><mrow>{}</mrow><mrow>{}</mrow></msup>", _ATOM, (_ATOM, 0))
_FORMS: dict[int, tuple[str, int, tuple[int, ...]]] = {
    ca.OP_ADD: ("{}<mo>+</mo>{}", _SUM, (_SUM, _SUM)),
    ca.OP_SUB: ("{}<mo>−</mo>{}", _SUM, (_SUM, _PRODUCT)),
    ca.OP_NEG: ("<mo>−</mo>{}", _SUM, (_PRODUCT,)),
    ca.OP_MUL: (f"{{}}{_SPACE}{{}}", _PRODUCT, (_PRODUCT, _PRODUCT)),
    ca.OP_TWICE: (f"<mn>2</mn>{_SPACE}{{}}", _PRODUCT, (_PRODUCT,)),
    ca.OP_DIV: ("<mfrac><mrow>{}</mrow><mrow>{}</mrow></mfrac>", _ATOM, (0, 0)),
    ca.OP_INV: ("<mfrac><mn>1</mn><mrow>{}</mrow></mfrac>", _ATOM, (0,)),
    ca.OP_EXP: ("<msup><mi>e</mi><mrow>{}</mrow></msup>", _ATOM, (0,)),
    ca.OP_SQ: ("<msup><mrow>{}</mrow><mn>2</mn></msup>", _ATOM, (_ATOM,)),
    ca.OP_POW: _POWER,
    ca.OP_CONSTPOW: _POWER,
    ca.OP_SQRT: ("<msqrt>{}</msqrt>", _ATOM, (0,)),
    ca.OP_IF_ELSE_ZERO: (f"{{1}}{_SPACE}<mo>[</mo>{{0}}<mo>]</mo>", _PRODUCT, (0, _PRODUCT)),
    ca.OP_NOT: ("<mo>¬</mo>{}", _SIGN, (_ATOM,)),
    **{key: (f"{{}}<mo>{sign}</mo>{{}}", _SUM, (_SUM, _SUM)) for key, sign in _RELATIONS.items()},
}
"""For each operation its text, its precedence, and the precedence that each operand needs."""


def to_mathml(expression: ca.SX, before: ca.SX | None = None, new: ca.SX | None = None) -> str:
    """MathML of an expression, without the enclosing `math` element.

    Args:
        expression: a scalar.
        before: the expression without the new parts; None: everything is new.
        new: column of the new symbols; None: nothing is marked.

    Raises:
        ValueError: the expression has an operation without a sign.
    """
    return _Writer(ca.SX() if new is None else new).text(expression, before)


def is_readable(expression: ca.SX, longest: int = LONGEST) -> bool:
    """Return true if a scalar can be written and is short enough to read."""
    return _count(expression, 0, longest) <= longest


def name(symbol: str) -> str:
    """Symbol with its first letter and, if short, the rest as an index: `Tcf`, `k0`, `E_R`.

    >>> name("qc")
    '<msub><mi>q</mi><mi>c</mi></msub>'
    """
    first, rest = escape(symbol[0]), escape(symbol[1:].lstrip("_"))
    if not rest:
        return f"<mi>{first}</mi>"
    if len(rest) > 2 and symbol[1] != "_":
        return f'<mi mathvariant="normal">{escape(symbol.replace("_", " ").replace(".", " "))}</mi>'
    return (
        f"<msub><mi>{first}</mi><{'mn' if rest.isdigit() else 'mi'}>{rest}</{'mn' if rest.isdigit() else 'mi'}></msub>"
    )


def wrappable(text: str) -> list[str]:
    """Split a sum between its terms, so that a page can wrap it; browsers do not break an expression by themselves.

    >>> wrappable("<mi>a</mi><mo>−</mo><mi>b</mi>")
    ['<mi>a</mi>', '<mo form="infix">−</mo><mi>b</mi>']
    """
    parts: list[list[ElementTree.Element]] = [[]]
    for element in ElementTree.fromstring(f"<math>{text}</math>"):  # noqa: S314 (as above)
        first = next((item for item in element.iter() if item.tag != "mrow"), element)
        if first.tag == "mo" and first.text in ("+", "−") and parts[-1]:
            first.set("form", "infix")  # at the start of its row it would be drawn as a sign, without a space
            parts.append([])
        parts[-1].append(element)
    return ["".join(ElementTree.tostring(element, "unicode") for element in part) for part in parts]


def mark_added(text: str) -> str:
    """Mark as new."""
    return f'<mrow class="{ADDED}">{text}</mrow>'


class _Writer:
    def __init__(self, new: ca.SX) -> None:
        self._new = new

    def text(self, now: ca.SX, before: ca.SX | None, binds: int = 0) -> str:
        """Write an expression inside an operation of this precedence."""
        if not depends_on(now, self._new):
            return self._plain(now, (None, None), binds)
        if before is None:
            return mark_added(_Writer(ca.SX())._plain(now, (None, None), binds))
        if now.n_dep() == 2:
            wrapped = [ca.is_equal(now.dep(index), before, _DEPTH) for index in (0, 1)]
            if any(wrapped) and now.op() in (ca.OP_ADD, ca.OP_SUB):
                return self._write_sum(now, wrapped.index(True), binds)
        if not before.is_symbolic() and now.op() == before.op() and now.n_dep() == before.n_dep():
            return self._plain(now, tuple(before.dep(index) for index in range(now.n_dep())), binds)
        return self.text(now, None, binds)

    def _write_sum(self, now: ca.SX, old: int, binds: int) -> str:
        """Write the old expression with a new term, marked with its sign."""
        sign = "+" if now.op() == ca.OP_ADD else "−"
        kept = self.text(now.dep(old), now.dep(old), _SUM if old == 0 or sign == "+" else _PRODUCT)
        term = _Writer(ca.SX())._plain(now.dep(1 - old), (None, None), _SUM if sign == "+" else _PRODUCT)
        if old == 0:
            # at the start of its row it would be drawn as a sign, without a space
            new = mark_added(f'<mo form="infix">{sign}</mo>{term}')
            return _within(f"{kept}{new}", _SUM, binds)
        return _within(f"{mark_added(term)}<mo>{sign}</mo>{kept}", _SUM, binds)

    def _plain(self, now: ca.SX, before: tuple[ca.SX | None, ...], binds: int) -> str:
        if now.is_constant():
            return _number(float(now), binds)
        if now.is_symbolic():
            return name(now.name())
        op, parts = now.op(), [now.dep(index) for index in range(now.n_dep())]
        if op not in _FORMS and op not in _NAMES:
            raise ValueError(f"operation {op} has no sign")
        form, own, inner = _FORMS.get(op, ("", _ATOM, (0,) * len(parts)))
        if op == ca.OP_MUL and parts[1].is_constant():
            form = form.replace(_SPACE, "<mo>·</mo>")
        texts = [
            self.text(part, was if depends_on(part, self._new) else None, needed)
            for part, was, needed in zip(parts, before, inner, strict=False)
        ]
        if op in _NAMES:
            return f'<mi mathvariant="normal">{_NAMES[op]}</mi><mo>(</mo>{"<mo>,</mo>".join(texts)}<mo>)</mo>'
        return _within(form.format(*texts), own, binds)


def depends_on(expression: ca.SX, symbols: ca.SX) -> bool:
    """True if an expression has one of the symbols, of which there may be none."""
    return symbols.numel() > 0 and bool(ca.depends_on(expression, symbols))


def _within(text: str, own: int, binds: int) -> str:
    return f"<mrow><mo>(</mo>{text}<mo>)</mo></mrow>" if own < binds else text


def _number(value: float, binds: int) -> str:
    if value < 0.0:
        return _within(f"<mo>−</mo>{_number(-value, 0)}", _SUM, binds)
    mantissa, exponent, power = f"{value:.6g}".partition("e")
    if not exponent:
        return f"<mn>{mantissa}</mn>"
    ten = f"<msup><mn>10</mn><mn>{int(power)}</mn></msup>".replace("<mn>-", "<mn>−")
    return ten if mantissa == "1" else _within(f"<mn>{mantissa}</mn><mo>·</mo>{ten}", _PRODUCT, binds)


def _count(expression: ca.SX, so_far: int, enough: int) -> int:
    """Count the nodes of the tree up to a limit, because a tree may be larger than its graph."""
    so_far += 1
    if expression.is_symbolic() or expression.is_constant():
        return so_far
    if expression.op() not in _FORMS and expression.op() not in _NAMES:
        return enough + 1
    for index in range(expression.n_dep()):
        if so_far > enough:
            break
        so_far = _count(expression.dep(index), so_far, enough)
    return so_far
