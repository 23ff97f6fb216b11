"""The page of a diagnosis in a browser: on a phone, at 1,400 px, on a light and on a dark ground."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.unit.diagnosis.cases import CASES

from .browser import Browser, browser

SPILLED = "[...document.querySelectorAll({selector!r})].filter(item => item.scrollWidth > item.clientWidth + 1).length"
BEYOND = """[...document.querySelectorAll('figure > svg')].filter(item => {
  const ends = item.getBoundingClientRect(); return ends.left < 0 || ends.right > document.documentElement.clientWidth;
}).length"""
GROUNDS = """[...document.querySelectorAll('.strips td')].map(item => [
  parseFloat(item.style.getPropertyValue('--shade')), getComputedStyle(item).backgroundColor])"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


def show(page: Browser, case: str, folder: Path, *, unfold: bool = True) -> None:
    path = folder / "report.html"
    path.write_text(as_page(CASES[case], cstr(), EFFECTS, "plant.csv", "extended.json"), encoding="utf-8")
    page.go_to(path.as_uri())
    if unfold:
        page.evaluate("document.querySelectorAll('details').forEach(item => { item.open = true }) || 0")


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("width", [390, 800, 1400])
def test_plots_and_tables_end_within_the_page(page: Browser, case: str, width: int, tmp_path: Path) -> None:
    page.resize(width, 1000)
    show(page, case, tmp_path)
    assert page.evaluate("document.querySelectorAll('figure > svg').length") >= 4
    assert page.evaluate(BEYOND) == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    tables = ".wide" if width >= 800 else ".wide:has(.strips), .wide:has(.alternatives)"
    assert page.evaluate(SPILLED.format(selector=tables)) == 0
    assert page.evaluate(SPILLED.format(selector="figure")) == 0


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_what_is_worse_has_the_stronger_colour_on_either_ground(page: Browser, scheme: str, tmp_path: Path) -> None:
    page.prefer(scheme)
    show(page, "named", tmp_path)
    shades = page.evaluate(GROUNDS)
    opacity = [(shade, float(colour.rpartition("/")[2].rstrip(" )"))) for shade, colour in shades if "/" in colour]
    assert len(opacity) > 10
    ordered = sorted(opacity)
    assert all(first[1] <= second[1] + 1e-3 for first, second in pairwise(ordered))
    assert ordered[-1][1] > ordered[0][1] + 0.2


A4_PX = 688
"""Width of A4 without its margins of 14 mm, at 96 pixels an inch."""

CLOSED = """[...document.querySelectorAll('details > :not(summary)')].filter(item => !item.checkVisibility({
  contentVisibilityAuto: true, checkOpacity: true}) || item.getBoundingClientRect().height === 0).length"""


@pytest.mark.parametrize("case", CASES)
def test_in_print_sections_are_open_in_colour_on_a_light_ground_and_no_equation_is_cut(
    page: Browser, case: str, tmp_path: Path
) -> None:
    page.prefer("dark")
    page.emulate_print(A4_PX)
    show(page, case, tmp_path, unfold=False)
    assert page.evaluate("document.querySelectorAll('details:not([open])').length") >= 4
    assert page.evaluate(CLOSED) == 0
    assert page.evaluate(SPILLED.format(selector=".equation, figure, .wide")) == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= A4_PX
    body = "getComputedStyle(document.body)"
    assert page.evaluate(f"{body}.backgroundColor") == "rgb(255, 255, 255)"
    assert page.evaluate(f"{body}.printColorAdjust") == "exact"
