"""The authority's folder: whom it has given certificates, and what it does when one is asked for, ends, or is stolen.

What is issued goes into the register before there is a certificate: one that the register lacks would be refused by the
router, and could not be revoked; one that was registered and never written harms nobody.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric import ec

from deploy.pki.files import PRIVATE, PUBLIC, locked, make_folder, write
from deploy.pki.signing import OWN_HOSTS, Pair, hosts_of, make_authority, make_certificate, serial_of
from protocol.certificates import check_time, common_name_of, load_certificate, load_key
from protocol.credentials import (
    AUTHORITY_FILE,
    GROUND,
    IDENTITIES,
    REGISTER_FILE,
    ROUTER,
    SIM,
    Entry,
    Register,
    is_identity,
    load_register,
)
from protocol.errors import CredentialsError

AUTHORITY_KEY_FILE = "ca.key"
GROUND_COMPUTER = (ROUTER, GROUND, SIM)
"""Identities that live on the ground station's computer, and are issued with the authority."""
LIFE = timedelta(days=90)
"""Of a certificate: a season of flying; renewed between two missions."""


def init(folder: Path, hosts: Iterable[str], *, now: datetime, life: timedelta = LIFE) -> tuple[Entry, ...]:
    """Make an authority in ``folder``, and the certificates of the ground station's computer.

    Args:
        hosts: addresses and names by which the others will call the router.

    Raises:
        CredentialsError: there is one already, or the folder cannot be written.
    """
    authority = make_authority(now)
    made = _make(authority, Register(), GROUND_COMPUTER, (*hosts, *OWN_HOSTS), now, life)
    make_folder(folder)
    with locked(folder):
        for name in (AUTHORITY_KEY_FILE, AUTHORITY_FILE, REGISTER_FILE):
            if (folder / name).exists():
                raise CredentialsError(
                    f"{folder / name} is there already, and certificates of a new authority would not fit those of"
                    " the old; choose another folder"
                )
        write(folder / AUTHORITY_KEY_FILE, authority.key_pem(), PRIVATE)
        write(folder / AUTHORITY_FILE, authority.certificate_pem(), PUBLIC)
        return _hand_out(folder, Register(), made)


def issue(
    folder: Path, identities: Sequence[str], *, now: datetime, life: timedelta = LIFE, hosts: Sequence[str] = ()
) -> tuple[Entry, ...]:
    """Certificates for those who have none that is admitted.

    Args:
        hosts: of the router alone, as for `init`.

    Raises:
        CredentialsError: one of them has a certificate, or cannot have any; then none is issued.
    """
    identities = _checked(identities)
    with locked(_existing(folder)):
        authority, register = _load_authority(folder, now), load_register(folder)
        for identity in identities:
            for entry in register.of(identity):
                if entry.is_admitted(now):
                    raise CredentialsError(
                        f"{entry.common_name} is valid until {entry.expires:%Y-%m-%d}; to replace it:"
                        f" covrecon pki renew {identity}; if it was lost or stolen: covrecon pki revoke {identity}"
                    )
        made = _make(authority, register, identities, _hosts(folder, identities, hosts), now, life)
        return _hand_out(folder, register, made)


def renew(
    folder: Path,
    identities: Sequence[str] = (),
    *,
    now: datetime,
    life: timedelta = LIFE,
    within: timedelta | None = None,
    hosts: Sequence[str] = (),
) -> tuple[Entry, ...]:
    """New keys and certificates for those who have one; the old ones stay admitted until they expire or are revoked.

    Args:
        identities: whose; all that are not revoked if empty.
        within: only those that expire so soon.
        hosts: of the router alone, instead of those it has.

    Raises:
        CredentialsError: one of them has no certificate to renew; then none is made.
    """
    identities = _checked(identities)
    with locked(_existing(folder)):
        authority, register = _load_authority(folder, now), load_register(folder)
        ends = _ends(register)
        for identity in identities:
            if identity not in ends:
                why = "is revoked" if register.of(identity) else "has no certificate yet"
                raise CredentialsError(f"{identity} {why}; for a new one: covrecon pki issue {identity}")
        due = [name for name in identities or ends if within is None or ends[name] <= now + within]
        made = _make(authority, register, due, _hosts(folder, due, hosts), now, life)
        return _hand_out(folder, register, made)


def revoke(folder: Path, names: Sequence[str], *, now: datetime) -> tuple[Entry, ...]:
    """Have the router admit certificates no more; its files are deleted here, so that nobody copies them by mistake.

    Args:
        names: identities, of which all issues are meant, or common names of single ones.

    Raises:
        CredentialsError: one of them was never issued; then none is revoked.
    """
    with locked(_existing(folder)):
        register = load_register(folder)
        identities = _of(register.certificates)
        unknown = set(names) - set(identities) - {entry.common_name for entry in register.certificates}
        if unknown:
            raise CredentialsError(f"never issued: {', '.join(sorted(unknown))}; there are {', '.join(identities)}")
        meant = {entry.common_name for entry in register.certificates if {entry.common_name, entry.identity} & {*names}}
        entries = tuple(
            entry.model_copy(update={"revoked": now.replace(microsecond=0)})
            if entry.common_name in meant and entry.revoked is None
            else entry
            for entry in register.certificates
        )
        _write_register(folder, Register(certificates=entries))
        revoked = tuple(entry for entry in entries if entry.common_name in meant)
        for identity in {entry.identity for entry in revoked}:
            _delete_revoked(folder / f"{identity}.pem", meant)
        return revoked


def admitted_issues(folder: Path, identity: str, now: datetime) -> tuple[Entry, ...]:
    """What of ``identity`` the router still lets in, the newest last."""
    return tuple(entry for entry in load_register(folder).of(identity) if entry.is_admitted(now))


def _checked(identities: Sequence[str]) -> Sequence[str]:
    for identity in identities:
        if not is_identity(identity):
            raise CredentialsError(f"{identity!r} cannot have a certificate; there are {IDENTITIES}")
    return tuple(dict.fromkeys(identities))


def _existing(folder: Path) -> Path:
    if not folder.is_dir():
        raise CredentialsError(
            f"{folder}: no such folder; name the authority's (--folder), or make one: covrecon pki init"
        )
    return folder


def _load_authority(folder: Path, now: datetime) -> Pair:
    remedy = "this works in the authority's folder alone, which covrecon pki init makes"
    key = load_key(folder / AUTHORITY_KEY_FILE, remedy)
    path = folder / AUTHORITY_FILE
    certificate = load_certificate(path, remedy)
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise CredentialsError(
            f"{folder / AUTHORITY_KEY_FILE}: not the key of {AUTHORITY_FILE}; restore both from a copy"
        )
    check_time(path, certificate, now, "make a new authority in another folder: covrecon pki init")
    return Pair(certificate, key)


def _hosts(folder: Path, identities: Iterable[str], hosts: Sequence[str]) -> tuple[str, ...]:
    """Of the router's new certificate: those that are given, or those it has."""
    if ROUTER not in identities:
        if hosts:
            raise CredentialsError(f"only the {ROUTER} has hosts; name it: covrecon pki renew {ROUTER} --host ADDRESS")
        return ()
    if hosts:
        return (*hosts, *OWN_HOSTS)
    path = folder / f"{ROUTER}.pem"
    if path.exists():
        return hosts_of(load_certificate(path, ""))
    raise CredentialsError(f"say by which address or name the others call the {ROUTER}: --host")


def _ends(register: Register) -> dict[str, datetime]:
    """When the newest certificate of each identity ends, without those that are revoked."""
    live = [entry for entry in register.certificates if entry.revoked is None]
    return {identity: max(entry.expires for entry in live if entry.identity == identity) for identity in _of(live)}


def _of(entries: Iterable[Entry]) -> list[str]:
    return list(dict.fromkeys(entry.identity for entry in entries))


def _make(
    authority: Pair,
    register: Register,
    identities: Iterable[str],
    hosts: Sequence[str],
    now: datetime,
    life: timedelta,
) -> list[tuple[Entry, Pair]]:
    made = []
    for identity in identities:
        number = max((entry.issue for entry in register.of(identity)), default=0) + 1
        common_name = f"{identity}.{number}"
        own_hosts = hosts if identity == ROUTER else ()
        pair = make_certificate(authority, common_name, now=now, life=life, hosts=own_hosts)
        entry = Entry(
            common_name=common_name,
            serial=serial_of(pair.certificate),
            issued=now.replace(microsecond=0),
            expires=pair.certificate.not_valid_after_utc,
        )
        made.append((entry, pair))
    return made


def _hand_out(folder: Path, register: Register, made: Sequence[tuple[Entry, Pair]]) -> tuple[Entry, ...]:
    entries = tuple(entry for entry, _ in made)
    if entries:
        _write_register(folder, Register(certificates=(*register.certificates, *entries)))
    for entry, pair in made:
        write(folder / f"{entry.identity}.key", pair.key_pem(), PRIVATE)
        write(folder / f"{entry.identity}.pem", pair.certificate_pem(), PUBLIC)
    return entries


def _write_register(folder: Path, register: Register) -> None:
    write(folder / REGISTER_FILE, register.model_dump_json(indent=2).encode() + b"\n", PUBLIC)


def _delete_revoked(path: Path, revoked: Iterable[str]) -> None:
    with suppress(CredentialsError):  # not there, or damaged: of no use to anybody
        if common_name_of(load_certificate(path, "")) in revoked:
            path.with_suffix(".key").unlink(missing_ok=True)
            path.unlink()
