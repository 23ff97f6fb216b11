"""Files of extended models, as `diagnose` writes and `--model` reads them."""

import json
from pathlib import Path
from typing import Any

from reactorwatch.errors import InputError
from reactorwatch.process.extended_model import ExtendedModel, parse_extended_model
from reactorwatch.records.decode import read_regular
from reactorwatch.records.write import atomic_write


def read_extended_model(path: Path) -> ExtendedModel:
    """Read the model in a file.

    Raises:
        InputError: the file cannot be read, or holds no model; the text starts with its path.
    """
    try:
        return parse_extended_model(read_regular(path))
    except OSError as error:
        raise InputError(f"model file {path}: cannot be read: {error.strerror}") from error
    except InputError as error:
        raise InputError(f"model file {path}: {error}") from error


def write_extended_model(path: Path, written: dict[str, Any]) -> None:
    """Write the object from `ExtendedModel.to_object`; the file appears complete or not at all.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
