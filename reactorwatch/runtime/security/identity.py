"""How a client shows who it is, in Zenoh's settings for TLS."""

from typing import Any

from reactorwatch.runtime.config import BusConfig

TLS = "transport/link/tls"
ROUTER_FILES = ("root_ca_certificate", "listen_certificate", "listen_private_key")
"""Of a router's settings for TLS, those that name a file."""


def client_settings(config: BusConfig) -> dict[str, Any]:
    """What a client shows of itself, and wants to see of the router; empty without certificates."""
    if config.ca is None:
        return {}
    return {
        f"{TLS}/root_ca_certificate": config.ca,
        f"{TLS}/connect_certificate": config.certificate,
        f"{TLS}/connect_private_key": config.key,
        f"{TLS}/enable_mtls": True,
        f"{TLS}/verify_name_on_connect": True,
        f"{TLS}/close_link_on_expiration": True,
    }
