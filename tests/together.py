"""Which tests one worker has all of, when there are several workers.

Tests of a file share what is made once for them: a demonstration that was run, a cluster, a record that was diagnosed.
Several workers would each make it. And where no machine code of a diagnosis was ever made, whoever diagnoses first
makes it, for a quarter of a minute; it is on the disk for those that come after. It is the same with the monitors of a
fleet. So the files named here are three pieces of work, which are begun first; all other tests go one by one to the
worker that is free.

The marks of pytest-xdist for this, `xdist_group`, group nothing with pytest 9.2 (pytest-dev/pytest-xdist#1386).
"""

import pytest
from xdist.scheduler import LoadScopeScheduling

PIECES = {
    "tests/end_to_end/test_demo.py": "diagnosing",
    "tests/end_to_end/test_diagnose.py": "diagnosing",
    "tests/end_to_end/test_documents.py": "diagnosing",
    "tests/end_to_end/test_many_files.py": "diagnosing",
    "tests/hidden_effect/test_found.py": "diagnosing",
    "tests/hidden_effect/test_outside.py": "diagnosing",
    "tests/integration/test_fleet_on_router.py": "fleets",
    "tests/integration/test_soak.py": "fleets",
    "tests/unit/runtime/test_jobs.py": "clusters",
}


def scheduling(config: pytest.Config, log: object) -> LoadScopeScheduling:
    """How tests are given to workers: what has the most tests first."""
    made = LoadScopeScheduling(config, log)
    made._split_scope = _piece_of_work
    return made


def _piece_of_work(test: str) -> str:
    return PIECES.get(test.partition("::")[0], test)
