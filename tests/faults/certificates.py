"""Certificates for tests: a fleet's folder in a moment, and folders of those who must not be let in.

Those of the bad have the fleet's own ``ca.pem``, so that only the router can be who refuses them.
"""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric import ec

from deploy.pki.authority import AUTHORITY_KEY_FILE, init, issue, revoke
from deploy.pki.files import PRIVATE, PUBLIC, make_folder, write
from deploy.pki.signing import Pair, make_authority, make_certificate
from protocol.certificates import load_certificate, load_key
from protocol.credentials import AUTHORITY_FILE, Credentials, identities_in, identity_of_drone, split_common_name

LIFE = timedelta(days=90)


def make_credentials(
    folder: Path,
    drones: tuple[int, ...] = (1, 2),
    operators: tuple[str, ...] = ("anna",),
    hosts: tuple[str, ...] = ("127.0.0.1",),
) -> None:
    """Fill ``folder``, which need not be there, with an authority and the certificates of a fleet."""
    now = datetime.now(UTC)
    init(folder, hosts, now=now)
    issue(folder, [*map(identity_of_drone, drones), *(f"operator-{name}" for name in operators)], now=now)


def make_expired(folder: Path, fleet: Path, common_name: str = "drone-1.1") -> Credentials:
    """Signed by the authority in the folder ``fleet``, and over since yesterday."""
    authority = load_authority(fleet)
    made = make_certificate(authority, common_name, now=datetime.now(UTC) - timedelta(days=31), life=timedelta(days=30))
    return _put(folder, fleet, split_common_name(common_name)[0], made, common_name)


def make_foreign(folder: Path, fleet: Path, common_name: str = "drone-1.1") -> Credentials:
    """By an authority of the same name with another key."""
    now = datetime.now(UTC)
    made = make_certificate(make_authority(now), common_name, now=now, life=LIFE)
    return _put(folder, fleet, split_common_name(common_name)[0], made, common_name)


def make_misnamed(
    folder: Path, fleet: Path, identity: str = "drone-1", common_name: str = "somebody-1.1"
) -> Credentials:
    """Signed by the authority in ``fleet``, in the files of ``identity``, but for somebody else."""
    made = make_certificate(load_authority(fleet), common_name, now=datetime.now(UTC), life=LIFE)
    return _put(folder, fleet, identity, made, common_name)


def make_revoked(folder: Path, fleet: Path, identity: str = "drone-1") -> Credentials:
    """What ``identity`` had, which the register in ``fleet`` now calls revoked; it is issued first if need be."""
    if identity not in identities_in(fleet):
        issue(fleet, [identity], now=datetime.now(UTC))
    names = (AUTHORITY_FILE, f"{identity}.pem", f"{identity}.key")
    make_folder(folder)
    for name in names:
        shutil.copy2(fleet / name, folder / name)
    (revoked, *_) = reversed(revoke(fleet, [identity], now=datetime.now(UTC)))
    return Credentials(folder, identity, revoked.common_name, revoked.expires)


def load_authority(fleet: Path) -> Pair:
    key = load_key(fleet / AUTHORITY_KEY_FILE, "")
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return Pair(load_certificate(fleet / AUTHORITY_FILE, ""), key)


def _put(folder: Path, fleet: Path, identity: str, made: Pair, common_name: str) -> Credentials:
    make_folder(folder)
    write(folder / AUTHORITY_FILE, (fleet / AUTHORITY_FILE).read_bytes(), PUBLIC)
    write(folder / f"{identity}.key", made.key_pem(), PRIVATE)
    write(folder / f"{identity}.pem", made.certificate_pem(), PUBLIC)
    return Credentials(folder, identity, common_name, made.certificate.not_valid_after_utc)
