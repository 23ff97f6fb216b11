"""Layout 3 of a monitor's state: a plant had one input, and the equations were called `process`."""

from typing import Any

import msgspec


def upgrade(body: bytes) -> bytes:
    """Body in layout 4 of one in layout 3.

    Raises:
        ValueError: the body is not in layout 3.
    """
    try:
        fields: dict[str, Any] = msgspec.msgpack.decode(body, type=dict[str, Any])
        settings = fields["settings"]
        settings["inputs"] = [settings.pop("input")]
        if not settings["equations"]:
            settings["units"] = {}
        settings["reference"] = {"process": "equations"}.get(settings["reference"], settings["reference"])
        watched = fields["watch"]["watched"]
        if watched is not None:
            _upgrade_reference(watched["reference"], len(fields["settings"]["outputs"]))
            reconstruction = watched["suspicion"] and watched["suspicion"]["reconstruction"]
            if reconstruction:
                reconstruction["last_inputs"] = [reconstruction.pop("last_input")]
    except (msgspec.DecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the input cannot be read: {error}") from error
    return msgspec.msgpack.encode(fields)


def _upgrade_reference(reference: dict[str, Any], outputs: int) -> None:
    if "low" in reference:
        reference["low"], reference["high"] = [reference["low"]], [reference["high"]]
        reference["uses_inputs"] = [True] * outputs
        return
    reference["last_inputs"], reference["guessed"] = [reference.pop("last_input")], [reference["guessed"]]
    reference["held_rows"], reference["reach"] = reference.get("held_rows", 0), [reference.get("reach", 0.0)]
