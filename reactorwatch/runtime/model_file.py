"""Extended models as files: what `diagnose` writes and `--model` takes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from reactorwatch.errors import InputError
from reactorwatch.process.extended_model import ExtendedModel, parse_extended_model
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.atomic import replacing


def read_extended_model(path: Path) -> ExtendedModel:
    """The model in a file.

    Raises:
        InputError: the file cannot be read, or holds no model; the text begins with its path.
    """
    try:
        return parse_extended_model(path.read_bytes())
    except OSError as error:
        raise InputError(f"model file {path}: cannot be read: {error.strerror}") from error
    except InputError as error:
        raise InputError(f"model file {path}: {error}") from error


def model_on_the_bus(path: str | None, zero_ns: int = 0) -> ProcessModel | None:
    """The model in a file, its clock that of the samples: minutes since 1970-01-01 UTC. None if there is no file.

    Args:
        path: of the file.
        zero_ns: the time that its minutes count from, where it does not say.

    Raises:
        InputError: as `read_extended_model`.
    """
    if path is None:
        return None
    model = read_extended_model(Path(path))
    return replace(model, zero_ns=model.zero_ns or zero_ns).rebase(0).build()


def write_extended_model(path: Path, written: dict[str, Any]) -> None:
    """Write the object that `ExtendedModel.to_object` gives; the file appears whole or not at all.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
