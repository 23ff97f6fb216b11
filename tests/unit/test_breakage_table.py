"""docs/breakage.md names existing tests and counts."""

import re
from pathlib import Path

from reactorwatch.contract.messages_pb2 import Health

ROOT = Path(__file__).parents[2]
TABLE = (ROOT / "docs" / "breakage.md").read_text(encoding="utf-8")


def test_every_test_that_is_named_is_there() -> None:
    named = re.findall(r"`(test_\w+\.py)::(test_\w+)`", TABLE)
    assert len(named) > 20
    files = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    assert [(file, test) for file, test in named if f"def {test}(" not in files.get(file, "")] == []


def test_every_count_that_is_named_is_a_field_of_health_or_a_reason_that_is_used() -> None:
    fields = {field.name for field in Health.DESCRIPTOR.fields}
    assert {"duplicated", "late", "out_of_order", "lost", "lag_ms", "stalls", "not_stored", "rows"} <= fields
    source = "".join(
        path.read_text(encoding="utf-8")
        for folder in ("monitor_node", "plant_node", "recorder", "reactorwatch")
        for path in (ROOT / folder).rglob("*.py")
    )
    reasons = set(re.findall(r"`refused\[([a-z_ ]+)\]`", TABLE))
    assert len(reasons) > 8
    assert {reason for reason in reasons if f'"{reason}"' not in source} == set()
