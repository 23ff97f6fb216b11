"""Which tests one worker has all of, when there are several workers.

Tests of a file share what is made once for them: a demonstration that was run, a cluster, a record that was diagnosed.
Several workers would each make it. And where no machine code of a diagnosis was ever made, whoever diagnoses first
makes it, for a quarter of a minute; it is on the disk for those that come after. So the files named here are one piece
of work, which is begun first; all other tests go one by one to whoever is free.

The marks of pytest-xdist for this, `xdist_group`, group nothing with pytest 9.2 (pytest-dev/pytest-xdist#1386).
"""

import pytest
from xdist.scheduler import LoadScopeScheduling

DIAGNOSING = frozenset(
    {
        "tests/end_to_end/test_demo.py",
        "tests/end_to_end/test_diagnose.py",
        "tests/end_to_end/test_documents.py",
        "tests/end_to_end/test_many_files.py",
        "tests/hidden_effect/test_found.py",
        "tests/hidden_effect/test_outside.py",
    }
)


def scheduling(config: pytest.Config, log: object) -> LoadScopeScheduling:
    """How tests are given to workers: what has the most tests first."""
    made = LoadScopeScheduling(config, log)
    made._split_scope = _piece_of_work
    return made


def _piece_of_work(test: str) -> str:
    return "diagnosing" if test.partition("::")[0] in DIAGNOSING else test
