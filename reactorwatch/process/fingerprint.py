"""Digest of a model's equations, to recognise them."""

from hashlib import blake2b

import casadi as ca

from reactorwatch.process.model import ProcessModel

DIGEST_BYTES = 16


def fingerprint(model: ProcessModel) -> str:
    """Digest of a model's equations, names and numbers."""
    x, u, p = model.arguments()
    memory = [*model.at_rest.values(), *model.resets.values()]
    function = ca.Function("memory", [x, u, p], memory, {"allow_free": True})
    words = (model.name, *model.state_names, *model.input_names, *model.output_names, *model.parameter_names)
    texts = (*words, *model.breakpoints, *model.at_rest, *model.resets, model.function().serialize())
    values = model.values().tobytes()
    return blake2b("\0".join((*texts, function.serialize())).encode() + values, digest_size=DIGEST_BYTES).hexdigest()
