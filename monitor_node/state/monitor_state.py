"""Serialised state of a monitor.

The bytes are MessagePack behind a seal (see `seal`): damaged bytes are refused. A state learned with other settings, or
with another model of the plant, is refused as well, and the difference is named.
"""

from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import AlignmentState
from monitor_node.ingest.sequence_check import SequenceCheck
from monitor_node.pipeline.pipeline_state import PipelineState
from monitor_node.state import version_2, version_3
from monitor_node.state.seal import Seal
from reactorwatch.errors import InputError
from reactorwatch.process.fingerprint import fingerprint
from reactorwatch.process.model import ProcessModel
from reactorwatch.spc.charts.catalogue import CHARTS
from reactorwatch.spc.value_chart import ValueChart
from reactorwatch.stored_state import Memory

MAGIC = b"reactorwatch monitor"
UPGRADES = {2: lambda body: version_3.upgrade(version_2.upgrade(body)), 3: version_3.upgrade}
SEAL = Seal(MAGIC, 4, "state of a monitor", UPGRADES)

NOT_LEARNED_BY = frozenset(
    {"process", "alarm_state_file", "state_file", "state_every_s", "health_period_s", "diagnose_training"}
)
"""Settings that do not change what was learned; the model is identified by its equations, not by its file."""

TRAINING = ("training_min", "training_rows")
"""Settings that are compared only where they are stated."""


ROLES = ("setpoints", "modes", "startup_modes", "labels", "bounds", "resolution")
"""Settings of signals that a state has only where there are any; earlier versions had none."""


class OtherSettingsError(InputError):
    """The state is intact, but was learned with other settings."""


class MonitorMemory(Memory, kw_only=True):
    """Memory of a monitor beside its parts, while it runs and in its stored state.

    Attributes:
        runs: sequence checks of the signals, the inputs first.
        units: newest unit by signal.
        heard_from_ns: time of the first accepted sample by signal.
        first_ns: time of the first row; None before it.
        last_ns: time of the last row; None before the first.
        watching_since_ns: time of the first evaluated row; None before it.
        snapshot_due_ns: plant time of the next model snapshots; None before the first row.
        received: number of messages received.
        published: number of messages published.
        refused: number of rejected messages by reason.
        failures: number of contained errors of this software by stage.
    """

    runs: list[SequenceCheck]
    units: dict[str, str]
    heard_from_ns: dict[str, int] = msgspec.field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int | None = None
    watching_since_ns: int | None = None
    snapshot_due_ns: int | None = None
    received: int = 0
    published: int = 0
    refused: dict[str, int] = msgspec.field(default_factory=dict)
    failures: dict[str, int] = msgspec.field(default_factory=dict)


class MonitorState(MonitorMemory, kw_only=True):
    """State of a monitor: its memory and its parts.

    Attributes:
        settings: settings of the training, see `learning_settings`.
        alignment: state of the alignment.
        board: state of the alarms, see `Annunciator.to_bytes`.
        watch: state of the pipeline.
        unconfirmed: the newest publications, which may not have left the process; empty if they have.
    """

    settings: dict[str, Any]
    alignment: AlignmentState
    board: bytes
    watch: PipelineState
    unconfirmed: list[tuple[str, bytes, str]] = msgspec.field(default_factory=list)  # key, payload and encoding


def learning_settings(config: MonitorConfig, model: ProcessModel | None, *, points: bool) -> dict[str, Any]:
    """Settings that must be equal to resume from a state.

    Args:
        config: settings of the monitor.
        model: process model.
        points: see `Monitor`.
    """
    fields = {field: value for field, value in msgspec.structs.asdict(config).items() if field not in NOT_LEARNED_BY}
    for name in TRAINING:
        if fields[name] is None:
            del fields[name]
    for name in ROLES:
        if not fields[name]:
            del fields[name]
    for kind in CHARTS:
        if issubclass(kind, ValueChart) and kind.name not in config.charts:  # earlier versions had none
            for setting in kind.settings:
                del fields[setting.key]
    if model is not None:
        del fields["units"]  # the equations have their own
    fields |= {"points": points, "equations": "" if model is None else fingerprint(model)}
    settings: dict[str, Any] = msgspec.msgpack.decode(msgspec.msgpack.encode(fields))  # as they are read back
    return settings


def seal_state(state: MonitorState, settings: dict[str, Any]) -> bytes:
    """Serialise and seal a state, with the settings of its training (see `learning_settings`)."""
    return SEAL.close(msgspec.structs.replace(state, settings=settings).to_bytes())


def open_state(data: bytes, settings: dict[str, Any]) -> MonitorState:
    """Open a sealed state.

    Args:
        data: bytes from `seal_state`.
        settings: see `learning_settings`.

    Raises:
        ForeignFileError: the bytes were never a state.
        InputError: the state is damaged, or of another version.
        OtherSettingsError: the state was learned with other settings.
    """
    body = SEAL.open(data)
    try:
        state = MonitorState.from_bytes(body)
    except ValueError as error:
        raise InputError(f"is no state of this software's monitor: {error}") from error
    stored = {name: value for name, value in state.settings.items() if name in settings or name not in TRAINING}
    if stored != settings:
        raise OtherSettingsError(f"was learned with other settings: {_difference(stored, settings)}")
    return state


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    names = [name for name in sorted(before | now) if before.get(name) != now.get(name)]
    return ", ".join(f"{name} was {before.get(name)!r} and is {now.get(name)!r}" for name in names)
