"""Register of a site, stored with its authority: `SITE/authority/site.json`."""

import secrets
from pathlib import Path

import msgspec

from reactorwatch.errors import InputError
from reactorwatch.limits import parse_json
from reactorwatch.records.decode import read_regular
from reactorwatch.records.write import atomic_write
from reactorwatch.runtime.security.acl import SERIAL_BYTES, common_name


class Register(msgspec.Struct, forbid_unknown_fields=True):
    """Addresses of a site's router, and valid common names of its certificates.

    Attributes:
        endpoint: the address at which nodes connect to the router.
        listen: the address at which it listens.
        names: common names of certificates by holder, such as `cstr/monitor`, where earlier ones were revoked.
        revoked: common names that the router refuses, oldest first.
    """

    endpoint: str
    listen: str
    names: dict[str, str] = {}
    revoked: list[str] = []

    def name_of(self, holder: str) -> str:
        """Common name of a holder's certificates."""
        plant, _, role = holder.partition("/")
        return self.names.get(holder) or common_name(plant, role)

    def revoke(self, holder: str) -> str:
        """Revoke all present certificates of a holder; returns their common name."""
        name = self.name_of(holder)
        plant, _, role = holder.partition("/")
        self.revoked.append(name)
        self.names[holder] = f"{common_name(plant, role)}.{secrets.token_hex(SERIAL_BYTES)}"
        return name

    def write(self, path: Path) -> None:
        """Write the file, completely or not at all."""
        with atomic_write(path) as part:
            part.write_bytes(msgspec.json.encode(self) + b"\n")


def read_register(path: Path) -> Register | None:
    """Read the register of a site; None if there is none.

    Raises:
        InputError: the file cannot be read.
    """
    if not path.exists():
        return None
    try:
        return msgspec.convert(parse_json(read_regular(path)), Register)
    except (OSError, InputError, msgspec.ValidationError) as error:
        raise InputError(f"{path}: cannot be read as what `certify` has written there: {error}") from error
