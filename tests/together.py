"""Which tests one worker has all of, when there are several workers.

Tests of a file share what is made once for them: a demonstration that was run, a cluster, a record that was diagnosed.
Several workers would each make it. So the files named here go to one worker each, those with the most tests first; all
other tests go one by one to whoever is free.

The marks of pytest-xdist for this, `xdist_group`, group nothing with pytest 9.2 (pytest-dev/pytest-xdist#1386).
"""

import pytest
from xdist.scheduler import LoadScopeScheduling

FILES = frozenset(
    {
        "tests/end_to_end/test_demo.py",
        "tests/end_to_end/test_diagnose.py",
        "tests/hidden_effect/test_found.py",
        "tests/hidden_effect/test_outside.py",
    }
)


def scheduling(config: pytest.Config, log: object) -> LoadScopeScheduling:
    """A file of these is one piece of work, and so is each other test."""
    made = LoadScopeScheduling(config, log)
    made._split_scope = _piece_of_work
    return made


def _piece_of_work(test: str) -> str:
    file = test.partition("::")[0]
    return file if file in FILES else test
