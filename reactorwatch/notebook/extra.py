"""Import of the optional libraries."""

import importlib
from typing import Any

from reactorwatch.errors import InputError


def import_optional(module: str, purpose: str) -> Any:
    """Import a module of an optional library.

    Args:
        module: name of the module.
        purpose: what it is needed for, for the error.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        library = module.partition(".")[0]
        raise InputError(
            f"{purpose} needs {library}, which is not installed: pip install 'reactorwatch[notebook]'"
        ) from error
