"""A process as a command names it: by name or file, or by the columns of its signals."""

from dataclasses import dataclass, replace
from pathlib import Path

from reactorwatch.description.find import DEFAULT_PROCESS, FILE_KINDS, find_process
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError

UNDESCRIBED = "plant"
"""Name of a process that only its columns describe."""


@dataclass(frozen=True)
class ProcessChoice:
    """Choice of a process.

    Attributes:
        process: a name in the catalogue or a path, see `find_process`; None: the reactor, unless columns are named.
        inputs: columns that are inputs of a process without a description.
        outputs: columns that are its outputs.
        modes: columns that say how it is operated.

    Raises:
        InputError: a process and columns are named, or inputs or modes without an output.
    """

    process: str | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    modes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.process is not None and (self.inputs or self.outputs or self.modes):
            raise InputError(
                "--input, --output and --mode describe a process without a file, got them beside --process "
                f"{self.process}; leave one of the two out"
            )
        for role, names in (("mode", self.modes), ("input", self.inputs)):
            if names and not self.outputs:
                raise InputError(f"--{role} needs an --output, got only the {role} {', '.join(names)}")

    @property
    def is_default(self) -> bool:
        """True if neither a process nor columns are named."""
        return self.process is None and not self.outputs

    @property
    def file(self) -> Path | None:
        """File that describes the process; None: it is named otherwise."""
        path = None if self.process is None else Path(self.process)
        return path if path is not None and path.suffix.lower() in FILE_KINDS else None

    def absolute(self) -> "ProcessChoice":
        """Copy with the absolute path of the file."""
        return self if self.file is None else replace(self, process=str(self.file.absolute()))

    def load(self, zero_ns: int = 0, *, on_bus: bool = False) -> Process:
        """Load the process.

        Args:
            zero_ns: time from which the minutes of an extended model count; 0: the one that its file states.
            on_bus: see `find_process`.

        Raises:
            InputError: as `find_process`.
        """
        if self.outputs:
            roles = {"input": self.inputs, "output": self.outputs, "mode": self.modes}
            signals = (Signal(name, role=role) for role, names in roles.items() for name in names)
            return Process(UNDESCRIBED, tuple(signals))
        return find_process(self.process or DEFAULT_PROCESS, zero_ns, on_bus=on_bus)


DEFAULT_CHOICE = ProcessChoice()
"""No process and no columns are named: the reactor."""
