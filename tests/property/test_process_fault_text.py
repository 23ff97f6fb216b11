"""Any fault can be written down and read back as the same fault."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from reactorwatch.errors import InputError
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.library.cstr import EFFECTS
from reactorwatch.process.profiles import FREE, PROFILES, free_profile


@st.composite
def faults(draw: st.DrawFn) -> FaultSpecification:
    effect, profile = draw(st.sampled_from(EFFECTS)), draw(st.sampled_from(PROFILES))
    values = {"size": draw(st.floats(effect.lower, effect.upper))}
    if profile is FREE:
        times = sorted(draw(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=5, unique=True)))
        values |= {f"time_{number}": time for number, time in enumerate(times, 1)}
        values |= {f"value_{number}": draw(st.floats(0.0, 1.0)) for number in range(1, len(times) + 1)}
        return FaultSpecification(effect, free_profile(len(times)), values)
    for item in profile.parameters:
        if draw(st.booleans()):
            low, high = max(item.lower, -1e6), min(item.upper, 1e6)
            values[item.name] = draw(st.floats(low, high))
    if "onset" in values and "end" in values and not values["onset"] < values["end"]:
        del values["end"]
    return FaultSpecification(effect, profile, values)


@settings(max_examples=300)
@given(faults())
def test_written_and_read_it_is_the_same(fault: FaultSpecification) -> None:
    assert parse_fault(str(fault)) == fault
    assert str(parse_fault(str(fault))) == str(fault)


@settings(max_examples=300)
@given(st.floats(-1e4, 1e4), st.sampled_from([("s", 60.0), ("min", 1.0), ("h", 1 / 60)]))
def test_units_of_time_are_the_same_time(minutes: float, unit: tuple[str, float]) -> None:
    name, per_minute = unit
    found = parse_fault(f"coolant_flow:step:0.1@{minutes * per_minute!r}{name}").values["onset"]
    assert math.isclose(found, minutes, rel_tol=1e-12, abs_tol=1e-300)


@settings(max_examples=500)
@given(st.text(alphabet="coolant_flow:step=-0.5@3min,eE+ \n\t'\"\u0664\u00b2", max_size=40) | st.text(max_size=20))
def test_any_text_is_a_fault_or_is_refused_in_one_line_with_the_reason(text: str) -> None:
    for start, end in (
        ("", ""),
        ("coolant_flow:step:", ""),
        ("coolant_flow:sine:0.1@", ""),
        ("coolant_flow:", ":1"),
        ("coolant_flow:free:1,", ""),
    ):
        candidate = f"{start}{text}{end}"
        said = ""
        try:
            parse_fault(candidate)
        except InputError as error:
            said = str(error)
        assert said == "" or (said.startswith("fault ") and len(said.splitlines()) == 1)
