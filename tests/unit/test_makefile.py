"""Each target of the Makefile is defined once: a second recipe would silently replace the first."""

import re
from collections import Counter
from pathlib import Path

MAKEFILE = Path(__file__).parents[2] / "Makefile"


def test_each_target_has_one_recipe_and_is_declared_once() -> None:
    text = MAKEFILE.read_text(encoding="utf-8")
    targets = Counter(re.findall(r"^([a-z]+):", text, re.MULTILINE))
    declared = Counter(re.findall(r"^\.PHONY: (.*)$", text, re.MULTILINE)[0].split())
    assert set(targets.values()) == {1}, targets
    assert declared == targets
