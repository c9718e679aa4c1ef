"""Certificates and keys in files, and what has to hold of a certificate before it may be shown."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.errors import CredentialsError

OTHERS_MAY = 0o077
"""Permissions that nobody but the owner may have on a private key, as for ssh."""


def read_file(path: Path, remedy: str) -> bytes:
    """Raises `CredentialsError` if it cannot be read; ``remedy`` says what to do if it is not there."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise CredentialsError(f"{path}: no such file; {remedy}") from error
    except OSError as error:
        raise CredentialsError(f"{path}: cannot be read: {error.strerror}; whose is it? See: ls -l {path}") from error


def load_certificate(path: Path, remedy: str) -> x509.Certificate:
    """The certificate in a PEM file.

    Args:
        remedy: what to do if there is none, for the error.

    Raises:
        CredentialsError: there is none.
    """
    content = read_file(path, remedy)
    try:
        return x509.load_pem_x509_certificate(content)
    except ValueError as error:
        raise CredentialsError(f"{path}: not a certificate in PEM format; {remedy}") from error


def load_key(path: Path, remedy: str) -> PrivateKeyTypes:
    """The private key in a PEM file that only its owner may read; otherwise as `load_certificate`."""
    content = read_file(path, remedy)
    if open_to_others(path):
        raise CredentialsError(f"{path}: others than its owner may read or change it; run: chmod 600 {path}")
    try:
        return load_pem_private_key(content, password=None)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise CredentialsError(f"{path}: not a private key in PEM format; {remedy}") from error
    except TypeError as error:
        raise CredentialsError(f"{path}: has a passphrase, which no process could type; {remedy}") from error


def open_to_others(path: Path) -> bool:
    """Whether anybody but the owner may do something with a file or folder. Raises OSError."""
    return bool(path.stat().st_mode & OTHERS_MAY)


def common_name_of(certificate: x509.Certificate) -> str:
    """Of whom it is; empty if it does not say exactly one."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if len(names) == 1 else ""


def days_left(expires: datetime, now: datetime) -> int:
    """Whole days; negative once it has expired."""
    return (expires - now) // timedelta(days=1)


def check_issuer(path: Path, certificate: x509.Certificate, authority: x509.Certificate, remedy: str) -> None:
    """Raises `CredentialsError` unless ``certificate`` bears the signature of ``authority``, which may sign."""
    try:
        may_sign = authority.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    except (x509.ExtensionNotFound, ValueError):
        may_sign = False
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm) as error:
        raise CredentialsError(f"{path}: not signed by the authority in the same folder; {remedy}") from error
    if not may_sign:
        raise CredentialsError(f"{path}: signed by a certificate that is no authority's; {remedy}")


def check_uses(path: Path, certificate: x509.Certificate, *, server: bool, remedy: str) -> None:
    """Raises `CredentialsError` unless it is for TLS clients, and with ``server`` for TLS servers too."""
    try:
        uses = set(certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
    except (x509.ExtensionNotFound, ValueError):
        uses = set()
    needed = {ExtendedKeyUsageOID.CLIENT_AUTH: "clients"}
    if server:
        needed[ExtendedKeyUsageOID.SERVER_AUTH] = "servers"
    lacking = [name for use, name in needed.items() if use not in uses]
    if lacking:
        raise CredentialsError(f"{path}: not for {' and '.join(lacking)} (extended key usage); {remedy}")


def check_time(path: Path, certificate: x509.Certificate, now: datetime, remedy: str) -> None:
    """Raises `CredentialsError` before and after the time for which it was made."""
    begins, expires = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now < begins:
        raise CredentialsError(
            f"{path}: not valid before {begins:%Y-%m-%d %H:%M} UTC, and the clock says {now:%Y-%m-%d %H:%M} UTC:"
            " the clock of this computer may be wrong, or was that of the authority's; see: timedatectl"
        )
    if now >= expires:
        raise CredentialsError(
            f"{path}: expired at {expires:%Y-%m-%d %H:%M} UTC, and the clock says {now:%Y-%m-%d %H:%M} UTC; {remedy}"
        )
