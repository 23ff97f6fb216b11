"""Zenoh's settings for mutual TLS."""

from typing import Any

from reactorwatch.runtime.config import BusConfig

TLS = "transport/link/tls"
ROUTER_FILES = ("root_ca_certificate", "listen_certificate", "listen_private_key")
"""Keys of a router's TLS settings whose values are files."""


def client_tls(config: BusConfig) -> dict[str, Any]:
    """TLS settings of a client; empty without certificates."""
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
