"""What a streaming part remembers, in a form that can be stored: one explicit structure, no pickle."""

from typing import Self

import msgspec


class StoredState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the states; a subclass lists what there is to remember."""

    def to_bytes(self) -> bytes:
        """The state as MessagePack; numbers come back bit for bit."""
        return msgspec.msgpack.encode(self)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """The state that `to_bytes` stored.

        Raises:
            ValueError: the bytes are not such a state.
        """
        try:
            return msgspec.msgpack.decode(data, type=cls)
        except msgspec.DecodeError as error:
            raise ValueError(f"not a {cls.__name__}: {error}") from error
