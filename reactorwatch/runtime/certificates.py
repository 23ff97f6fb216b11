"""Certificates of a site: its own authority, and one certificate for each client of its bus.

Keys are P-256, signatures ECDSA with SHA-256, names as in RFC 5280. Of the bus, only the router's certificate is one of
a server: the extended key usage of the others is that of a client, so that a stolen viewer's certificate makes no false
router.
"""

import datetime
import ipaddress
from dataclasses import dataclass
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from reactorwatch.errors import InputError

CLOCK_MARGIN = datetime.timedelta(minutes=5)
"""Certificates are valid from this long before they are made, because the clocks of a site differ."""


@dataclass(frozen=True)
class Identity:
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    def write(self, certificate: Path, key: Path) -> None:
        """Write both as PEM; only its owner can read the file of the key, from the first byte on."""
        key.touch(mode=0o600)
        key.write_bytes(
            self.key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        certificate.write_bytes(self.certificate.public_bytes(serialization.Encoding.PEM))


def make_authority(name: str, now: datetime.datetime, days: float) -> Identity:
    """Make an authority with a self-signed certificate.

    Args:
        name: common name of the authority.
        now: time from which it is valid.
        days: days for which it is valid.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    builder = (
        _builder(name, _x509_name(name), key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
    )
    return Identity(builder.sign(key, hashes.SHA256()), key)


def issue(
    by: Identity,
    name: str,
    now: datetime.datetime,
    days: float,
    hosts: tuple[str, ...] = (),
    *,
    is_peer: bool = False,
) -> Identity:
    """Issue a certificate signed by an authority.

    Args:
        by: the authority.
        name: the common name, which the router's access rules refer to.
        now: time from which it is valid.
        days: days for which it is valid; cut at the end of the authority's certificate.
        hosts: host names and addresses of a router; empty for a client.
        is_peer: True for a program that is both server and client.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    server, client = ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH
    usages = [server, client] if is_peer else [server if hosts else client]
    days = min(days, (by.certificate.not_valid_after_utc - now) / datetime.timedelta(days=1))
    signer_key = x509.AuthorityKeyIdentifier.from_issuer_public_key(by.key.public_key())
    builder = (
        _builder(name, by.certificate.subject, key.public_key(), now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
        .add_extension(signer_key, critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_host(host) for host in hosts]), critical=False)
    return Identity(builder.sign(by.key, hashes.SHA256()), key)


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate from a PEM file.

    Raises:
        InputError: the file cannot be read, or holds no certificate.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise InputError(f"certificate {path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise InputError(f"certificate {path}: is no certificate in PEM: {_first_line(error)}") from error


def read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a private key from a PEM file.

    Raises:
        InputError: the file cannot be read, or holds no elliptic curve's key without a password.
    """
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        raise InputError(f"private key {path}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError) as error:
        raise InputError(f"private key {path}: is no open private key in PEM: {_first_line(error)}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise InputError(f"private key {path}: must be an elliptic curve's, got {type(key).__name__}")
    return key


def read_common_name(certificate: x509.Certificate) -> str:
    """Common name of a certificate's holder; empty if it has none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _builder(
    name: str, signer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime.datetime, days: float
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_x509_name(name))
        .issuer_name(signer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_MARGIN)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _x509_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
