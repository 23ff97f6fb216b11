"""Suspects of an incident count as new once; the incidents published last are remembered."""

from reactorwatch.contract.messages_pb2 import Suspect
from reactorwatch.contract.suspects import MAX_INCIDENTS, NewSuspects

LEAK, FOULING = [Suspect(cause="leak", probability=0.9)], [Suspect(cause="fouling", probability=0.9)]


def test_suspects_are_new_if_there_are_any_and_they_differ_from_those_before() -> None:
    suspects = NewSuspects({1: LEAK})
    assert [suspects.update(1, item) for item in (LEAK, [], FOULING, FOULING, LEAK)] == [
        False,
        False,
        True,
        False,
        True,
    ]
    assert suspects.update(2, LEAK)


def test_an_incident_that_is_published_again_is_remembered_longer_than_those_that_are_not() -> None:
    suspects = NewSuspects()
    for number in range(MAX_INCIDENTS):
        suspects.update(number, LEAK)
    assert not suspects.update(0, LEAK)  # the longest standing one
    assert suspects.update(MAX_INCIDENTS, LEAK)  # the one published longest ago is forgotten: 1
    assert not suspects.update(0, LEAK)
    assert suspects.update(1, LEAK)
