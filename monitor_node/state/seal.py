"""Seal of stored bytes: a magic word, a version and a digest.

Without it a wrong bit in a covariance, or in the name of an alarm, would stay unnoticed for months. The magic word
distinguishes a state from a user's file.
"""

from collections.abc import Callable, Mapping
from hashlib import blake2b
from types import MappingProxyType
from typing import NamedTuple

from reactorwatch.errors import InputError

DIGEST_BYTES = 16
_VERSION_BYTES = 2


class ForeignFileError(InputError):
    """The bytes are no stored state, not even a damaged one: the software must not rename or overwrite the file."""


class Seal(NamedTuple):
    """Header of one kind of stored state.

    Attributes:
        word: magic word, the first bytes.
        version: version of the layout that is written.
        name: name of the kind, for messages.
        upgrades: older versions that are read, each with the function from its body to one of `version`.
    """

    word: bytes
    version: int
    name: str
    upgrades: Mapping[int, Callable[[bytes], bytes]] = MappingProxyType({})

    def close(self, body: bytes) -> bytes:
        """Seal a body: word, version, digest and body."""
        return self.word + self.version.to_bytes(_VERSION_BYTES, "big") + _digest(body) + body

    def open(self, data: bytes) -> bytes:
        """Body of sealed bytes, in the layout of `version`.

        Raises:
            ForeignFileError: the bytes are not a state of this kind.
            InputError: the state is truncated, damaged or of another version.
        """
        head_bytes = len(self.word) + _VERSION_BYTES
        head, body = data[:head_bytes], data[head_bytes + DIGEST_BYTES :]
        is_intact = data[head_bytes : head_bytes + DIGEST_BYTES] == _digest(body)
        if not head.startswith(self.word) or len(head) < head_bytes:
            text = f"is no {self.name}: {len(data)} bytes that do not begin like one"
            # A damaged or truncated header before an intact body, or the remains of a power failure: nothing or zeros.
            is_ours = self.word.startswith(head[: len(self.word)]) or is_intact or not data.strip(b"\0")
            raise InputError(text) if is_ours else ForeignFileError(text)
        version = int.from_bytes(head[len(self.word) :], "big")
        if version != self.version and version not in self.upgrades:
            raise InputError(f"is the {self.name} in version {version}, this software reads {self.version}")
        if not is_intact:
            raise InputError(f"is a damaged {self.name}: its digest is another")
        if version == self.version:
            return body
        try:
            return self.upgrades[version](body)
        except ValueError as error:
            raise InputError(f"is a damaged {self.name} in version {version}: {error}") from error


def _digest(body: bytes) -> bytes:
    return blake2b(body, digest_size=DIGEST_BYTES).digest()
