"""Keys and certificates as such, in memory: ECDSA over P-256, which every TLS library of the fleet takes."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.errors import CredentialsError

AUTHORITY_LIFE = timedelta(days=3653)
"""Ten years: to replace it, every computer of the fleet has to be visited."""
CLOCK_TOLERANCE = timedelta(hours=1)
"""Certificates begin so much before they are made, for computers whose clocks are behind."""
OWN_HOSTS = ("localhost", "127.0.0.1", "::1")
"""Names by which a router's own computer reaches it."""

_HOST_NAME = r"(?![0-9.]+$)(?!-)[A-Za-z0-9-]{1,63}(?<!-)(?:\.(?!-)[A-Za-z0-9-]{1,63}(?<!-))*"


@dataclass(frozen=True, slots=True)
class Pair:
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    def certificate_pem(self) -> bytes:
        return self.certificate.public_bytes(Encoding.PEM)

    def key_pem(self) -> bytes:
        return self.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def make_authority(now: datetime) -> Pair:
    """A key that signs itself, and may sign certificates that sign no others."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _named(f"Coverage-Recon authority of {now:%Y-%m-%d}")
    signs = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    builder = (
        _builder(name, name, key.public_key(), now, now + AUTHORITY_LIFE)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(signs, critical=True)
    )
    return Pair(builder.sign(key, SHA256()), key)


def make_certificate(
    authority: Pair, common_name: str, *, now: datetime, life: timedelta, hosts: Iterable[str] = ()
) -> Pair:
    """A key and its certificate for TLS clients; with ``hosts`` also for the server of these addresses and names.

    It ends with the authority's at the latest.

    Raises:
        CredentialsError: a host is neither an address nor a name.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    names = [_general_name(host) for host in dict.fromkeys(hosts)]
    expires = min(now + life, authority.certificate.not_valid_after_utc)
    client, server = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
    shows = x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=False,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    builder = (
        _builder(_named(common_name), authority.certificate.subject, key.public_key(), now, expires)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(shows, critical=True)
        .add_extension(x509.ExtendedKeyUsage([server, client] if names else [client]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
            critical=False,
        )
    )
    if names:
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return Pair(builder.sign(authority.key, SHA256()), key)


def hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    """Addresses and names by which a server with ``certificate`` may be called."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def serial_of(certificate: x509.Certificate) -> str:
    return f"{certificate.serial_number:X}"


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, expires: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_TOLERANCE)
        .not_valid_after(expires)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _named(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if re.fullmatch(_HOST_NAME, host) is None:
            raise CredentialsError(
                f"{host!r} is neither an address nor a name; write what stands in the endpoint between / and :,"
                " like 10.0.0.1 or ground.example"
            ) from None
        return x509.DNSName(host)
