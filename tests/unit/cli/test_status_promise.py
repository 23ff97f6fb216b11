"""`status` has the promise and the power of a plant as `backtest --json` has them, and shows them in words."""

from reactorwatch.cli.status import StatusBoard
from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.messages_pb2 import Power, Promise

NOW_NS = 10**12


def board(*, kept: bool = True) -> StatusBoard:
    power = [
        Power(deviation="coolant_flow", unit="1", within_10_min=0.0114, within_1_h=0.00512, within_1_day=0.003),
        Power(deviation="coolant_flow", unit="1", profile="ramp", within_1_day=0.02),
    ]
    message = Promise(
        time_ns=1,
        expected=1.0,
        expected_90=2.3456,
        kept=kept,
        can_keep_per_30_days=40.0,
        text="a sentence",
        power=power,
    )
    status = StatusBoard(NOW_NS)
    status.on_message(Encoded("reactor/a/promise/monitor", *encode_message(message), NOW_NS))
    status.on_token("reactor/a/alive/monitor", True)
    return status


def test_the_json_has_both_in_the_words_of_a_back_test() -> None:
    plant = board(kept=False).plant("a", NOW_NS)
    assert plant["promise"]["expected_90"] == 2.35
    assert (plant["promise"]["kept"], plant["promise"]["can_keep_per_30_days"]) == (False, 40.0)
    step, ramp = plant["power"]
    sizes = {"within_10_min": 0.0114, "within_1_h": 0.00512, "within_1_day": 0.003}
    assert step == {"deviation": "coolant_flow", "unit": "1", **sizes}
    assert (ramp["profile"], ramp["within_10_min"]) == ("ramp", None)


def test_people_see_the_sentence_and_the_steps_of_an_hour() -> None:
    text = board().text(NOW_NS)
    assert "a sentence" in text
    assert "coolant_flow 0.0051" in text


def test_a_plant_without_a_promise_has_none() -> None:
    status = StatusBoard(NOW_NS)
    status.on_token("reactor/b/alive/monitor", True)
    plant = status.plant("b", NOW_NS)
    assert (plant["promise"], plant["power"]) == (None, [])
    assert "promise" not in status.text(NOW_NS)
