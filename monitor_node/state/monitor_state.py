"""All that a monitor remembers, as bytes: what they are made of, and how they are known to be whole and of this plant.

The bytes are MessagePack behind a seal (see `seal`): whatever is not exactly what was stored is refused. What was
learned with other settings, or with another model of the plant, is refused as well, and the difference is named.
"""

from hashlib import blake2b
from typing import Any

import casadi as ca
import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import AlignmentState
from monitor_node.ingest.sequence_check import SampleRun
from monitor_node.state.pipeline_state import WatchState
from monitor_node.state.seal import DIGEST_BYTES, Seal
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import StoredState

MAGIC = b"reactorwatch monitor"
SEAL = Seal(MAGIC, 2, "state of a monitor")

NOT_LEARNED_BY = frozenset({"model", "alarm_state_file", "state_file", "state_every_s", "health_period_s"})
"""Settings that what is learned does not depend on; the model is known by its equations, not by its file."""


class OtherSettingsError(InputError):
    """A state that is whole, but was learned with other settings."""


class MonitorState(StoredState, frozen=True):
    """All that a monitor remembers.

    Attributes:
        settings: that it was learned with, see `settings_of`.
        runs: of the samples of each signal, the input first.
        alignment: samples on their way into rows.
        board: the alarms, see `AlarmBoard.to_bytes`.
        watch: all that was learned.
        units: by signal, as heard last.
        heard_from_ns: by signal, the time of the first sample that was heard.
        first_ns: time of the first row; None before it.
        last_ns: time of the last row.
        watching_since_ns: time of the first row that was judged.
        snapshot_due_ns: when the models are told next.
        received: messages so far.
        published: likewise.
        refused: by reason, likewise.
        failures: contained errors of this software, by stage.
    """

    settings: dict[str, Any]
    runs: list[SampleRun]
    alignment: AlignmentState
    board: bytes
    watch: WatchState
    units: dict[str, str]
    heard_from_ns: dict[str, int]
    first_ns: int | None
    last_ns: int | None
    watching_since_ns: int | None
    snapshot_due_ns: int | None
    received: int
    published: int
    refused: dict[str, int]
    failures: dict[str, int] = msgspec.field(default_factory=dict)


def settings_of(config: MonitorConfig, model: ProcessModel | None, *, points: bool) -> dict[str, Any]:
    """What has to be the same for a state to be gone on from.

    Args:
        config: of the monitor.
        model: of the plant.
        points: as for `Monitor`.
    """
    said = {field: value for field, value in msgspec.structs.asdict(config).items() if field not in NOT_LEARNED_BY}
    said |= {"points": points, "equations": fingerprint(model)}
    settings: dict[str, Any] = msgspec.msgpack.decode(msgspec.msgpack.encode(said))  # as they are read back
    return settings


def fingerprint(model: ProcessModel | None) -> str:
    """What a model is known by: its equations, names and numbers; empty without a model."""
    if model is None:
        return ""
    x, u, p = model.arguments()
    memory = [*model.at_rest.values(), *model.resets.values()]
    function = ca.Function("memory", [x, u, p], memory, {"allow_free": True})
    words = (model.name, *model.state_names, *model.input_names, *model.output_names, *model.parameter_names)
    said = (*words, *model.breakpoints, *model.at_rest, *model.resets, model.function().serialize())
    values = model.values().tobytes()
    return blake2b("\0".join((*said, function.serialize())).encode() + values, digest_size=DIGEST_BYTES).hexdigest()


def sealed(state: MonitorState) -> bytes:
    """The bytes of a state."""
    return SEAL.close(state.to_bytes())


def opened(data: bytes, settings: dict[str, Any]) -> MonitorState:
    """The state of some bytes.

    Args:
        data: what `sealed` returned.
        settings: see `settings_of`.

    Raises:
        ForeignFileError: the bytes were never a state.
        InputError: they are a damaged one, or of another version.
        OtherSettingsError: they are a state, but learned with other settings.
    """
    body = SEAL.open(data)
    try:
        state = MonitorState.from_bytes(body)
    except ValueError as error:
        raise InputError(f"is no state of this software's monitor: {error}") from error
    if state.settings != settings:
        raise OtherSettingsError(f"was learned with other settings: {_difference(state.settings, settings)}")
    return state


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    names = [name for name in sorted(before | now) if before.get(name) != now.get(name)]
    return ", ".join(f"{name} was {before.get(name)!r} and is {now.get(name)!r}" for name in names)
