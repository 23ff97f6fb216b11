"""Commands by which people change what a plant is judged by: `reactor/{plant}/command/baseline`.

A command is checked when it comes, and holds from the next row on; the change is published with the time of that row,
so a replay does the same there.
"""

from collections.abc import Sequence

from reactorwatch.contract.commands import check_signature
from reactorwatch.contract.messages_pb2 import Baseline, BaselineCommand
from reactorwatch.errors import InputError

BASELINE = "baseline"
"""Name of the command."""

ACCEPT, RELEARN, RESTORE, LIST = "accept", "relearn", "restore", "list"
"""Learn from the rows since the alarm; learn from here on; judge by an earlier baseline again; list the baselines."""

TRAINED = "trained"
"""`Baseline.what` of what was learned first."""


def check_command(command: BaselineCommand, kept: Sequence[int], *, has_rows: bool, has_alarm: bool) -> Baseline:
    """Check a command other than `list`; returns the change, without its time and number.

    Args:
        command: the command.
        kept: numbers of the baselines that can be restored, the one before last.
        has_rows: True if a row has come.
        has_alarm: True if an alarm without a known cause is active, and rows are judged.

    Raises:
        InputError: the command is refused.
    """
    by, why = check_signature(command.by, command.why)
    if not why:
        raise InputError("why must say why the baseline changes, got ''")
    if command.what not in (ACCEPT, RELEARN, RESTORE):
        raise InputError(f"what must be one of {ACCEPT}, {RELEARN}, {RESTORE} and {LIST}, got {command.what!r}")
    if not has_rows:
        raise InputError("no sample has come yet, so there is no baseline to change")
    change = Baseline(what=command.what, by=by, why=why)
    if command.what == ACCEPT and not has_alarm:
        raise InputError("no alarm is active, so there are no rows to accept; relearn learns from the next row on")
    if command.what == RESTORE:
        if not kept:
            raise InputError("there is no earlier baseline to restore: nothing was learned again so far")
        change.restored = command.id if command.HasField("id") else kept[-1]
        if change.restored not in kept:
            raise InputError(f"id must be one of {', '.join(map(str, kept))}, got {change.restored}")
    return change


def is_command(change: Baseline) -> bool:
    """True if a person made a change; False if the diagnosis of the training did, or a version that named no maker."""
    return change.what in (ACCEPT, RELEARN, RESTORE)
