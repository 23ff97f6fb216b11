"""Serialised state of a monitor.

The bytes are MessagePack behind a seal: a magic word, a version and a digest. Without it a wrong bit in a covariance,
or in the name of an alarm, would stay unnoticed for months; the magic word distinguishes a state from a user's file. A
state learned with other settings, or with another model of the plant, is refused as well, and the difference is named.
"""

from hashlib import blake2b
from typing import Any

import msgspec

from monitor_node.alarms.annunciator import AnnunciatorMemory
from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import AlignmentMemory
from monitor_node.ingest.intake import IntakeMemory
from monitor_node.watch.pipeline import PipelineMemory
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel, fingerprint
from reactorwatch.version import this_build

DIGEST_BYTES = 16


class ForeignFileError(InputError):
    """The bytes are no stored state, not even a damaged one: the software must not rename or overwrite the file."""


MAGIC = b"reactorwatch monitor"
VERSION = 10
"""Version of the layout of the stored state."""


def seal(body: bytes, version: int = VERSION) -> bytes:
    """Seal a serialised state: magic word, version, digest and body."""
    return MAGIC + version.to_bytes(2, "big") + _digest(body) + body


def open_seal(data: bytes) -> bytes:
    """Serialised state in sealed bytes.

    Raises:
        ForeignFileError: the bytes are no state of a monitor.
        InputError: the state is truncated, damaged or of another version.
    """
    name, head_bytes = "state of a monitor", len(MAGIC) + 2
    head, body = data[:head_bytes], data[head_bytes + DIGEST_BYTES :]
    is_intact = data[head_bytes : head_bytes + DIGEST_BYTES] == _digest(body)
    if not head.startswith(MAGIC) or len(head) < head_bytes:
        text = f"is no {name}: {len(data)} bytes that do not begin like one"
        # A damaged or truncated header before an intact body, or the remains of a power failure: nothing or zeros.
        is_ours = MAGIC.startswith(head[: len(MAGIC)]) or is_intact or not data.strip(b"\0")
        raise InputError(text) if is_ours else ForeignFileError(text)
    version = int.from_bytes(head[len(MAGIC) :], "big")
    if version != VERSION:
        raise InputError(f"is the {name} in version {version}, this software reads {VERSION}")
    if not is_intact:
        raise InputError(f"is a damaged {name}: its digest is another")
    return body


def _digest(body: bytes) -> bytes:
    return blake2b(body, digest_size=DIGEST_BYTES).digest()


NOT_LEARNED_BY = frozenset({"process", "state_file", "state_every_s", "health_period_s", "diagnose_training"})
"""Settings that do not change what was learned; the model is identified by its equations, not by its file."""

TRAINING = ("training_min", "training_rows", "order")
"""Settings that are compared only where they are stated."""


class OtherSettingsError(InputError):
    """The state is intact, but was learned with other settings; its alarms can be used."""

    def __init__(self, text: str, alarms: AnnunciatorMemory) -> None:
        super().__init__(text)
        self.alarms = alarms


class MonitorMemory(IntakeMemory, kw_only=True):
    """Memory of a monitor beside its parts, while it runs and in its stored state.

    Attributes:
        first_ns: time of the first row; None before it.
        last_ns: time of the last row; None before the first.
        watching_since_ns: time of the first evaluated row; None before it.
        snapshot_due_ns: plant time of the next model snapshots; None before the first row.
        received: number of messages received.
        published: number of messages published.
        failures: number of contained errors of this software by stage.
    """

    first_ns: int | None = None
    last_ns: int | None = None
    watching_since_ns: int | None = None
    snapshot_due_ns: int | None = None
    received: int = 0
    published: int = 0
    failures: dict[str, int] = msgspec.field(default_factory=dict)


class MonitorState(MonitorMemory, kw_only=True):
    """State of a monitor: its memory and its parts.

    Attributes:
        settings: settings of the training, see `learning_settings`.
        alignment: state of the alignment.
        board: memory of the alarms.
        watch: memory of the pipeline.
        unconfirmed: the newest publications, which may not have left the process; empty if they have.
        build: build of the software that stored it, see `reactorwatch.version`; empty before version 0.3.
    """

    settings: dict[str, Any]
    alignment: AlignmentMemory
    board: AnnunciatorMemory
    watch: PipelineMemory
    unconfirmed: list[tuple[str, bytes, str]] = msgspec.field(default_factory=list)  # key, payload and encoding
    build: str = ""


def learning_settings(config: MonitorConfig, model: ProcessModel | None, *, points: bool) -> dict[str, Any]:
    """Settings that must be equal to resume from a state."""
    fields = {field: value for field, value in msgspec.structs.asdict(config).items() if field not in NOT_LEARNED_BY}
    for name in TRAINING:
        if fields[name] is None:
            del fields[name]
    if model is not None:
        del fields["units"]  # the equations have their own
    fields |= {"points": points, "equations": "" if model is None else fingerprint(model)}
    settings: dict[str, Any] = msgspec.msgpack.decode(msgspec.msgpack.encode(fields))  # as they are read back
    return settings


def seal_state(state: MonitorState, settings: dict[str, Any]) -> bytes:
    """Serialise and seal a state, with the settings of its training (see `learning_settings`)."""
    return seal(msgspec.structs.replace(state, settings=settings, build=this_build()).to_bytes())


def open_state(data: bytes, settings: dict[str, Any]) -> MonitorState:
    """Open a sealed state.

    Raises:
        ForeignFileError: the bytes were never a state, or are one of another plant.
        InputError: the state is damaged, or of another version.
        OtherSettingsError: the state was learned with other settings.
    """
    body = open_seal(data)
    try:
        state = MonitorState.from_bytes(body)
    except ValueError as error:
        raise InputError(f"is no state of this software's monitor: {error}") from error
    by = f" by {state.build}" if state.build not in ("", this_build()) else ""
    older = {"order": 3}  # which earlier versions stored where none was stated
    stored = {
        name: value
        for name, value in state.settings.items()
        if name in settings or name not in TRAINING or older.get(name, value) != value
    }
    if stored.get("plant") != settings["plant"]:
        raise ForeignFileError(f"is the state of plant {stored.get('plant')!r}, not of {settings['plant']!r}")
    if stored != settings:
        text = f"was learned{by} with other settings: {_difference(stored, settings)}"
        raise OtherSettingsError(text, state.board)
    return state


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    names = [name for name in sorted(before | now) if before.get(name) != now.get(name)]
    states = [[repr(item[name]) if name in item else "not stated" for item in (before, now)] for name in names]
    return ", ".join(f"{name} was {was} and is {value}" for name, (was, value) in zip(names, states, strict=True))
