"""A folder that is to be written into."""

from pathlib import Path

from reactorwatch.errors import InputError


def make_folder(folder: Path, option: str = "", *, may_exist: bool = True) -> Path:
    """Make a folder, and those that it is in.

    Args:
        folder: its path.
        option: of the command line that names it, such as `--out`, to be told with it; empty: none does.
        may_exist: whether it may be there already.

    Returns:
        The folder.

    Raises:
        InputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=may_exist)
    except OSError as error:
        named = f"{option} {folder}" if option else folder
        raise InputError(f"{named}: the folder cannot be made: {error.strerror}") from error
    return folder
