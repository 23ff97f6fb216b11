"""The page of a diagnosis: self-contained, well-formed, its curves first."""

import hashlib
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from msgspec import structs

from reactorwatch.api.shown import report_origin
from reactorwatch.diagnosis.report import mathml
from reactorwatch.diagnosis.report.equations import balances
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import UnknownInputCurve
from reactorwatch.figures import Line, Panel, panel_svg
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.model import ProcessModel
from reactorwatch.version import this_build
from tests.unit.diagnosis.cases import ADJUSTED, CASES

EMPTY = {"meta", "br", "hr", "img", "link", "input"}


@cache
def page(case: str) -> str:
    return as_page(CASES[case], cstr(), EFFECTS, "plant <1>.csv", "out/extended.json")


class Balanced(HTMLParser):
    """Holds that every element is closed where it was opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.parametrize("case", CASES)
def test_the_page_is_well_formed_and_needs_nothing_from_elsewhere(case: str) -> None:
    text = page(case)
    parser = Balanced()
    parser.feed(text)
    parser.close()
    assert parser.open == []
    assert not {"script", "link", "img", "iframe", "object", "base"} & set(parser.seen)
    assert not re.search(r"https?:|//[a-z]|@import|url\(|\ssrc=|\shref=", text)


@pytest.mark.parametrize("case", CASES)
def test_what_stands_in_the_page_from_outside_is_escaped(case: str) -> None:
    text = page(case)
    assert "<1>" not in text
    assert "plant &lt;1&gt;.csv" in text
    assert "<control>" not in text


@pytest.mark.parametrize(
    ("case", "parts"),
    [
        ("nominal", ["The simulation is right", "Errors of the simulation", "Unchanged."]),
        (
            "named",
            [
                "coolant leak",
                "4.996 % of the coolant lost (± 0.017 %)",
                "m = -0.04996 ± 0.00017",
                "Improvement",
                "A closer look",
                "10^45389 to 1",
                'class="added"',
            ],
        ),
        ("pair", ["drift of the temperature sensor", "Please note", "<msub><mi>m</mi><mn>2</mn></msub>"]),
        (
            "ambiguous",
            [
                *(
                    "The experiment that would decide",
                    "Wider steps",
                    "ran away",
                    "5 to 1",
                    "10^9 to 1",
                    "more than 99 %",
                ),
                *("as predicted under each", "reactorwatch plant --scenario experiment.csv --duration 20"),
            ],
        ),
        ("unknown", ["no known cause explains it", "in the energy balance"]),
    ],
)
def test_the_page_answers_what_it_is_asked(case: str, parts: list[str]) -> None:
    text = page(case)
    for part in parts:
        assert part in text


def test_an_ambiguous_verdict_shows_all_rivals_with_their_sizes_and_the_experiment_at_the_top() -> None:
    top = page("ambiguous").partition("<h2>")[0]
    for part in (
        *("coolant leak", "on the side of the coolant", "4.996 % of the coolant lost (± 0.017 %)", "150.33 ± 0.02 min"),
        *("wrong feed temperature", "in the feed", "feed warmer by 1.23 K (± 0.10 K)", "150.1 ± 0.8 min", "5 to 1"),
        "Wider steps of qc tell both apart.",
    ):
        assert part in top
    assert "cannot tell which of 2 explanations" in top
    assert "<th>cause</th>" not in top
    assert "<th>cause</th>" in page("named").partition("<h2>")[0]
    assert "which is not certain" in page("ambiguous")
    assert "which is not certain" not in page("named")


def test_with_nuisance_the_page_leads_with_cause_share_and_what_is_left_and_speaks_of_no_filter() -> None:
    top, _, below = page("inexact").partition("<h2>")
    parts = (
        *("<th>cause</th>", "removes 97 % of the squared error; 48 % likely", "it acts the same in this record"),
        *(
            "left in T</th><td>0.4 K; the noise alone is 0.303 K",
            "T is measured 2.00 ± 0.20 s after its stamp",
            "± 12 s",
        ),
        *("C lags by 12 ± 2 s", "up to 35 s", "volume 1.2 ± 0.4 %", "± 3.9 %"),
    )
    places = [top.index(part) for part in parts]
    assert places == sorted(places)
    for part in ("One-step-ahead", "one-step-ahead", "(p = ", "BIC"):
        assert part not in below
        assert part in page("named")
    assert "removes 41 % of the squared error; less than 1 % likely against the other causes" in below


def test_an_unknown_leads_with_the_nearest_causes() -> None:
    top = page("nearest").partition("<h2>")[0]
    for part in (
        "nearest causes",
        "feed warmer by 1.23 K (± 0.10 K)",
        "41 %",
        "left in T</th><td>0.9 K; the noise",
    ):
        assert part in top


def test_an_ambiguous_verdict_without_an_experiment_states_it() -> None:
    text = as_page(structs.replace(CASES["ambiguous"], experiment=None), cstr(), EFFECTS, "a.csv", "extended.json")
    assert "No experiment within the limits separates them." in text.partition("<h2>")[0]


@pytest.mark.parametrize("case", CASES)
def test_curves_come_before_tables_which_are_folded(case: str) -> None:
    body = page(case).partition("</style>")[2].partition('<div class="facts')[2].partition("</div>\n\n")[2]
    shown, _, folded = body.partition("<details>")
    assert shown.count("<figure>") >= 4
    assert "<table" not in shown
    assert "<figure>" not in folded
    assert "dark" not in body, "colours are the style sheet's"
    assert "min-width" not in page(case)


def test_something_unknown_is_drawn_over_time_as_what_would_do_the_same() -> None:
    curves = CASES["unknown"].curves
    assert curves is not None
    assert "Size of the unknown effect" not in page("unknown")
    reported = replace(
        curves, unknown=UnknownInputCurve("heat loss", "1/min", np.linspace(0.0, 0.01, curves.time_min.size))
    )
    text = as_page(structs.replace(CASES["unknown"], curves=reported), cstr(), EFFECTS, "a.csv", "extended.json")
    assert "Size of the unknown effect" in text
    assert "Estimated as the size of: heat loss, 1/min" in text


def test_the_page_explains_how_the_extended_model_is_used() -> None:
    text = page("named")
    for command in ("simulate", "diagnose", "monitor", "plant"):
        assert re.search(rf"reactorwatch {command} .*--model out/extended.json", text)


def test_the_page_lists_the_posterior_of_uncertain_parameters() -> None:
    text = as_page(ADJUSTED, cstr(), EFFECTS, "plant.csv", "extended.json")
    assert "<tr><th>K3</th><td>711 ± 3 l/min; stated: 700 ± 30 l/min" in text


def test_a_page_without_curves_is_refused() -> None:
    with pytest.raises(ValueError, match="without its curves"):
        as_page(structs.replace(CASES["named"], curves=None), cstr(), EFFECTS, "a.csv", "extended.json")


def test_a_free_run_that_ran_away_and_a_size_of_unknown_spread_are_drawn_as_far_as_they_go() -> None:
    curves = CASES["named"].curves
    assert curves is not None
    nothing = np.full(curves.time_min.size, np.nan)
    for broken in (
        replace(curves, simulated_before={"C": nothing, "T": nothing}),
        replace(curves, simulated_before={"C": nothing, "T": nothing}, simulated_after={"C": nothing, "T": nothing}),
        replace(curves, deviation_sd={"coolant_flow": nothing}),
        replace(curves, deviation_sd={"coolant_flow": np.full(nothing.size, np.inf)}),
        replace(curves, residual_before={"C": nothing, "T": nothing}),
        replace(curves, measured={"C": nothing, "T": curves.measured["T"]}),
    ):
        text = as_page(structs.replace(CASES["named"], curves=broken), cstr(), EFFECTS, "a.csv", "extended.json")
        drawn = re.findall(r'\b(?:d|points)="([^"]*)"', text)
        assert not [part for part in drawn if "nan" in part or "inf" in part]


def test_a_page_of_many_rows_stays_small() -> None:
    curves = CASES["named"].curves
    assert curves is not None
    times = np.linspace(0.0, 7500.0, 75_000)
    panel = Panel("T, K", (Line("measured", times, np.sin(times)),))
    assert len(panel_svg(panel)) < 30_000
    assert len(page("named")) < 300_000


@pytest.mark.parametrize("effect", EFFECTS, ids=[effect.name for effect in EFFECTS])
def test_every_effect_marks_a_part_of_some_equation_and_leaves_the_others(effect: Effect) -> None:
    model = cstr()
    extended = effect.apply(model, ca.SX.sym("m"))
    for number, equation in enumerate(balances(model, [effect])):
        ElementTree.fromstring(f"<math>{equation.left}{equation.right}</math>")
        touched = number >= len(model.states) or not ca.is_equal(extended.rhs[number], model.rhs[number], 50)
        assert equation.changed == touched
        assert ("added" in equation.right) == touched
    assert any(equation.changed for equation in balances(model, [effect]))


def marked(text: str) -> list[str]:
    """The marked parts, without their tags."""
    root = ElementTree.fromstring(f"<math>{text}</math>")
    return ["".join(item.itertext()) for item in root.iter("mrow") if item.get("class") == "added"]


def test_what_is_marked_is_what_is_new() -> None:
    x, k, m = (ca.SX.sym(name) for name in ("x", "k", "m"))
    before = k * x - ca.exp(-x)
    cases: list[tuple[ca.SX, list[str]]] = [
        (before - m * (x - 298), ["−m(x−298)"]),
        (before + m, ["+m"]),
        (ca.substitute(before, k, k * (1 + m)), ["k(1+m)"]),
        (ca.substitute(before, k, k + m), ["+m"]),
        (ca.substitute(before, x, x * (1 + m)), ["x(1+m)", "x(1+m)"]),
        (m * before, ["m(kx−e−x)"]),
    ]
    for now, expected in cases:
        assert marked(mathml.to_mathml(now, before, m)) == expected
    assert marked(mathml.to_mathml(before, before, m)) == []


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (lambda x, y: (x + y) * x, "(x+y)x"),
        (lambda x, y: x - (y - x), "x−(y−x)"),
        (lambda x, y: x - y - x, "x−y−x"),
        (lambda x, y: -(x + y), "−(x+y)"),
        (lambda x, y: (x * y) ** y, "(xy)y"),
        (lambda x, y: ca.fmax(x, 1e-6), "max(x,10−6)"),
        (lambda x, y: x * -2.5e7, "(−2.5·107)x"),
    ],
)
def test_brackets_stand_where_they_are_needed(expression: object, expected: str) -> None:
    assert callable(expression)
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    root = ElementTree.fromstring(f"<math>{mathml.to_mathml(expression(x, y))}</math>")
    assert "".join(root.itertext()) == expected


def test_a_page_can_wrap_an_equation_between_the_terms_of_its_sum() -> None:
    x, y, m = (ca.SX.sym(name) for name in ("x", "y", "m"))
    before = -x + (x - y) * x
    text = mathml.to_mathml(before - m * x, before, m)
    parts = mathml.wrappable(text)
    assert ["".join(ElementTree.fromstring(f"<math>{part}</math>").itertext()) for part in parts] == [
        *("(x−y)x", "−x", "−mx")
    ]
    assert marked(parts[-1]) == ["−mx"]


def test_what_is_long_or_has_no_sign_is_not_written_out() -> None:
    x = ca.SX.sym("x")
    long = x
    for _ in range(40):
        long = long * (1 + long)
    assert not mathml.is_readable(long)
    assert not mathml.is_readable(ca.hypot(x, 1 + x))  # which has no sign here
    assert mathml.is_readable(x * (1 + x))


class Timing(Effect):
    """The rows are stamped m too late."""

    name = "late"
    label = "late stamps"
    location = "timing"
    unit = "min"
    lower = 0.0
    upper = 1.0

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        long = size
        for _ in range(40):
            long = long * (1 + long)
        return replace(model, rhs=(model.rhs[0] + long, model.rhs[1]))


def test_a_change_that_is_too_long_is_named_beside_what_was_there() -> None:
    nominal = balances(cstr(), [])
    changed = balances(cstr(), [Timing()])
    assert changed[0].right.startswith(nominal[0].right)
    assert "changed as said above" in changed[0].right
    assert changed[1] == nominal[1]


def test_the_origin_has_time_version_hash_of_the_file_and_chosen_settings(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_bytes(b"time_min,qc\n")
    origin = report_origin(file, {"process": "cstr", "plant": None, "tolerance": {"T": 0.5}})
    assert origin["software"] == f"reactorwatch {this_build()}"
    assert origin["SHA-256 of the file"] == hashlib.sha256(b"time_min,qc\n").hexdigest()
    assert origin["settings"] == "process cstr, tolerance T=0.5"
    assert origin["made"][:2] == "20"
    assert origin["made"][-5] in "+-"
    assert "SHA-256 of the file" not in report_origin(tmp_path, {})


def test_the_page_shows_its_origin_as_text_if_it_is_stated() -> None:
    arguments = (CASES["named"], cstr(), EFFECTS, "a.csv", "extended.json")
    page = as_page(*arguments, origin={"file": "<a>.csv"})
    assert '<tr><th>file</th><td class="any">&lt;a&gt;.csv</td></tr>' in page
    assert "This report" not in as_page(*arguments)
