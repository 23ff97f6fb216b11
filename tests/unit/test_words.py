"""New definitions use the field's words: names, docstrings, comments and messages (tests/words.py has the rules)."""

import pytest

from tests.words import (
    EXCEPTIONS,
    baseline,
    entries,
    entries_of_tests,
    is_participle,
    violations,
    violations_of_test,
)

HINT = "rename it; if it was moved by a merge or renamed for good, see tests/README.md"


@pytest.fixture(scope="module")
def now() -> set[str]:
    return entries()


def test_no_new_definition_breaks_a_rule(now: set[str]) -> None:
    assert sorted(now - baseline() - EXCEPTIONS.keys()) == [], HINT


def test_the_baseline_has_no_entry_that_no_longer_applies(now: set[str]) -> None:
    assert sorted(baseline() - now) == [], HINT


def test_every_exception_is_needed(now: set[str]) -> None:
    assert sorted(EXCEPTIONS.keys() - now) == []


def test_names_and_first_lines_of_the_tests_break_no_rule() -> None:
    assert entries_of_tests() == []


@pytest.mark.parametrize(
    ("source", "entry"),
    [
        ("def test_who_joins_late_is_served(): ...", "test_who_joins_late_is_served: people"),
        ("class Fed:\n    def hear(self): ...", "Fed.hear: people"),
        ("class Told: ...", "Told: people"),
        ("def test_it_goes_on(): ...", "test_it_goes_on: people"),
        ('"""What is told."""', "module: head"),
        ('"""Ports that nobody has."""', "module: head"),
    ],
)
def test_a_breach_in_a_test_is_found_with_its_name(source: str, entry: str) -> None:
    assert violations_of_test(source) == [entry]


@pytest.mark.parametrize(
    "source", ["def test_a_whole_number_is_sheared(): ...", '"""Delivery."""\n\n# nobody', "told = 1"]
)
def test_other_names_in_a_test_pass(source: str) -> None:
    assert violations_of_test(source) == []


@pytest.mark.parametrize(
    "name", ["found", "settled", "_walked", "told_again", "size_said", "received_of", "best_resolved", "held_out"]
)
def test_a_participle_is_no_name_of_a_function(name: str) -> None:
    assert is_participle(name)


@pytest.mark.parametrize(
    "name",
    [
        "find",
        "settled_value",
        "is_closed",
        "on_connected",
        "feed",
        "read",
        "run_until_stopped",
        "count_lost",
        "map_unordered",
        "need",
        "on",
    ],
)
def test_verbs_quantities_predicates_and_events_are_names_of_functions(name: str) -> None:
    assert not is_participle(name)


@pytest.mark.parametrize(
    ("source", "entry"),
    [
        ('"""What a monitor does."""', "module: head"),
        ('def f():\n    """Whether it is white."""', "f: head"),
        ('def f():\n    """When it is due."""', "f: head"),
        ('def f():\n    """Does it drift?"""', "f: head"),
        ('def f(a):\n    """Add.\n\n    Args:\n        a: its size.\n    """', "f: fragment"),
        ('class A:\n    x: int\n    """How many there are."""', "A.x: head"),
        ('def f(a):\n    """Add.\n\n    Args:\n        a: of it.\n    """', "f: fragment"),
        ("class A:\n    def f(self):\n        # nobody hears it\n        return 1", "A.f: people, nobody"),
        ('def f(x):\n    return f"{x} was told of it"', "f: people, told"),
        ('TEXT = "begin anew"', "TEXT: people, anew"),
        ("# whoever sent it", "module: people, whoever"),
        ("class A:\n    @property\n    def found(self) -> int: ...", "A.found: participle"),
    ],
)
def test_a_breach_is_found_with_its_place_and_rule(source: str, entry: str) -> None:
    assert violations(f"{source}\n") == {entry}


@pytest.mark.parametrize(
    "source",
    [
        'def f():\n    """Whiteness test of the normalised innovations."""',
        'KEY = "told"',
        "class A:\n    @property\n    def closed(self) -> bool: ...",
    ],
)
def test_the_field_s_words_python_s_flags_and_names_on_the_wire_pass(source: str) -> None:
    assert violations(f"{source}\n") == set()
