"""Something acts that no catalogue has: it is called unknown, in the right place; every other effect, shorter records.

`make study` has all of them.
"""

from dataclasses import replace
from functools import cache

import pytest

from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import UNKNOWN
from reactorwatch.process.library.cstr import cstr
from tests.hidden_effect.catalogue import OUTSIDE
from tests.hidden_effect.draw import draw
from tests.hidden_effect.excitation import NAMED_CIRCUMSTANCES
from tests.hidden_effect.judge import Judged, judge
from tests.hidden_effect.test_found import at_least

pytestmark = pytest.mark.slow

SPAN_MIN = 150.0
SEED = 4100
NAMES = [effect.name for effect in OUTSIDE]
SAMPLE = NAMES[::2]


@cache
def found(name: str) -> Judged:
    """Diagnosis of a record with a hidden effect, and its evaluation."""
    place = NAMES.index(name)
    hidden = draw(SEED + place, (OUTSIDE[place],), replace(NAMED_CIRCUMSTANCES["medium"], span_min=SPAN_MIN))
    return judge(hidden, diagnose(hidden.record, cstr()), seconds=0.0)


def test_what_is_called_unknown_is_in_the_right_place() -> None:
    unknown = {name: found(name) for name in SAMPLE if found(name).verdict == UNKNOWN}
    wrong = {name: judged.location for name, judged in unknown.items() if not judged.right_place}
    assert len(unknown) >= 3
    assert not wrong


def test_as_many_are_unknown_in_the_right_place_as_promised() -> None:
    right = [judged.verdict == UNKNOWN and judged.right_place for judged in map(found, SAMPLE)]
    assert sum(right) >= at_least(len(right), 0.85)
