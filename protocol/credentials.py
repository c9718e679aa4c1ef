"""Who a process is: its certificate, its key, and the authority by which it knows the others.

A folder that `covrecon pki` filled holds ``ca.pem`` and, for each identity that lives there, ``<identity>.pem`` and
``<identity>.key``. Identities are ``router``, ``ground``, ``sim``, ``mapper``, ``drone-<id>`` and ``operator-<name>``.
The common name of a certificate is identity and issue, ``drone-3.2``, so that a stolen one can be told from its
successor. The register lists all that were ever issued; the router admits those that it neither calls revoked nor
expired.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, ValidationError, model_validator

from protocol.certificates import (
    check_issuer,
    check_time,
    check_uses,
    common_name_of,
    days_left,
    load_certificate,
    load_key,
    read_file,
)
from protocol.errors import CredentialsError

AUTHORITY_FILE, REGISTER_FILE = "ca.pem", "register.json"
ROUTER, GROUND, SIM, MAPPER, MOCAP = "router", "ground", "sim", "mapper", "mocap"
DRONE, OPERATOR = "drone", "operator"
"""Kinds of which there are several: ``drone-<id>``, ``operator-<name>``."""

EXPIRY_WARNING = timedelta(days=14)
"""A certificate that ends sooner is warned of: two weeks are enough to visit every drone."""

_IDENTITY = (
    f"{ROUTER}|{GROUND}|{SIM}|{MAPPER}|{MOCAP}"
    f"|{DRONE}-(?:[1-9][0-9]?|1[0-9]{{2}}|2[0-4][0-9]|25[0-5])"
    f"|{OPERATOR}-[a-z0-9](?:[a-z0-9-]{{0,30}}[a-z0-9])?"
)
_ISSUE = "[1-9][0-9]{0,5}"
_ONE_OF_A_KIND = ", ".join((ROUTER, GROUND, SIM, MAPPER, MOCAP))
IDENTITIES = f"{_ONE_OF_A_KIND}, {DRONE}-1 to {DRONE}-255, and {OPERATOR}-<name> of small letters and digits"


@dataclass(frozen=True, slots=True)
class Credentials:
    """What one process shows, and by what it judges the router; of a router also whom it lets in."""

    folder: Path
    identity: str
    common_name: str
    expires: datetime
    warning: str = ""
    """What people should know of it, that it expires soon; empty if all is well."""

    @property
    def authority(self) -> Path:
        return self.folder / AUTHORITY_FILE

    @property
    def certificate(self) -> Path:
        return self.folder / f"{self.identity}.pem"

    @property
    def key(self) -> Path:
        return self.folder / f"{self.identity}.key"


# --- names ---------------------------------------------------------------------------------------------------------


def is_identity(text: str) -> bool:
    return re.fullmatch(_IDENTITY, text) is not None


def identity_of_drone(drone: int) -> str:
    return f"{DRONE}-{drone}"


def split_common_name(common_name: str) -> tuple[str, int]:
    """Identity and number of issue, ``("drone-3", 2)`` of ``drone-3.2``.

    Raises:
        CredentialsError: it is anything but exactly these two.
    """
    found = re.fullmatch(rf"({_IDENTITY})\.({_ISSUE})", common_name)
    if found is None:
        raise CredentialsError(f"{common_name!r} is not the name of a certificate, which is like drone-3.1")
    return found[1], int(found[2])


def identity_of_name(common_name: str) -> str:
    """Of a certificate; raises as `split_common_name`."""
    return split_common_name(common_name)[0]


def identities_in(folder: Path) -> list[str]:
    """Those whose certificates lie in ``folder``; none if it cannot be read."""
    return sorted(path.stem for path in folder.glob("*.pem") if is_identity(path.stem))


def find_operator(folder: Path, name: str = "") -> str:
    """The identity of operator ``name``, or of the only one whose certificate is in ``folder``.

    Raises:
        CredentialsError: it is not there, or there are several.
    """
    found = [identity for identity in identities_in(folder) if identity.startswith(f"{OPERATOR}-")]
    listed = f"{folder} has {', '.join(found)}" if found else f"{folder} has no operator's certificate"
    remedy = f"{listed}; make one on the authority's computer: covrecon pki issue {OPERATOR}-{name or 'anna'}"
    if name:
        identity = f"{OPERATOR}-{name.removeprefix(f'{OPERATOR}-')}"
        if identity not in found:
            raise CredentialsError(f"no certificate of {identity}: {remedy}")
        return identity
    if len(found) == 1:
        return found[0]
    raise CredentialsError(f"say which operator you are: {listed}" if found else remedy)


# --- the register --------------------------------------------------------------------------------------------------


def _checked_name(common_name: str) -> str:
    try:
        split_common_name(common_name)
    except CredentialsError as error:
        raise ValueError(str(error)) from error
    return common_name


class Entry(BaseModel):
    """One certificate that was issued."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    common_name: Annotated[str, AfterValidator(_checked_name)]
    serial: str
    """Hexadecimal, as openssl shows it."""
    issued: AwareDatetime
    expires: AwareDatetime
    revoked: AwareDatetime | None = None
    """Since when it is not to be admitted any more."""

    @property
    def identity(self) -> str:
        return split_common_name(self.common_name)[0]

    @property
    def issue(self) -> int:
        return split_common_name(self.common_name)[1]

    def is_admitted(self, now: datetime) -> bool:
        return self.revoked is None and now < self.expires


class Register(BaseModel):
    """Every certificate that the authority has issued, in that order."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: Literal[1] = 1
    certificates: tuple[Entry, ...] = ()

    @model_validator(mode="after")
    def _names_are_unique(self) -> Register:
        names = [entry.common_name for entry in self.certificates]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"{', '.join(twice)} is listed twice")
        return self

    def admitted(self, now: datetime) -> tuple[str, ...]:
        """Common names that are neither revoked nor expired."""
        return tuple(entry.common_name for entry in self.certificates if entry.is_admitted(now))

    def of(self, identity: str) -> tuple[Entry, ...]:
        """All issues of one identity, the newest last."""
        return tuple(sorted((entry for entry in self.certificates if entry.identity == identity), key=_issue))


def _issue(entry: Entry) -> int:
    return entry.issue


def load_register(folder: Path) -> Register:
    """Raises `CredentialsError` if it is missing or damaged."""
    path = folder / REGISTER_FILE
    again = "copy it again from the authority's computer"
    content = read_file(path, f"{again}; the router needs it to know whom to admit")
    try:
        return Register.model_validate_json(content)
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(map(str, fault["loc"]))
        raise CredentialsError(f"{path}: damaged: {': '.join(filter(None, (place, fault['msg'])))}; {again}") from error


# --- credentials ---------------------------------------------------------------------------------------------------


def load_credentials(folder: Path, identity: str, *, now: datetime) -> Credentials:
    """The certificate of ``identity``, after every check that the others would make of it.

    Where the register lies beside it, that has to admit it too.

    Raises:
        CredentialsError: it cannot be used; says why, and what to do.
    """
    if not is_identity(identity):
        raise CredentialsError(f"{identity!r} cannot have a certificate; there are {IDENTITIES}")
    issue, renew = f"covrecon pki issue {identity}", f"covrecon pki renew {identity}"
    if not folder.is_dir():
        raise CredentialsError(
            f"{folder}: no such folder; it holds the certificates that the authority's computer makes: {issue}"
        )
    made = f"make it on the authority's computer ({issue}) and copy it here"
    anew = f"make a new one on the authority's computer ({renew}) and copy it here"
    authority_path, path = folder / AUTHORITY_FILE, folder / f"{identity}.pem"
    authority = load_certificate(authority_path, "copy it from the authority's computer")
    certificate = load_certificate(path, made)
    key_path = path.with_suffix(".key")
    if load_key(key_path, made).public_key() != certificate.public_key():
        raise CredentialsError(f"{key_path}: not the key of {path.name}; copy both again, or {anew}")
    check_issuer(path, certificate, authority, f"copy both from one authority's computer ({issue})")
    common_name = common_name_of(certificate)
    if re.fullmatch(rf"{identity}\.{_ISSUE}", common_name) is None:
        raise CredentialsError(f"{path}: is the certificate of {common_name!r}, not of {identity}; {made}")
    check_uses(path, certificate, server=identity == ROUTER, remedy=anew)
    check_time(authority_path, authority, now, "make a new authority: covrecon pki init")
    check_time(path, certificate, now, anew)
    if (folder / REGISTER_FILE).exists():
        _check_register(load_register(folder), path, common_name, issue)
    expires = certificate.not_valid_after_utc
    return Credentials(folder, identity, common_name, expires, expiry_warning(common_name, expires, now))


def expiry_warning(common_name: str, expires: datetime, now: datetime) -> str:
    """What to say of a certificate that ends within `EXPIRY_WARNING`; empty of any other."""
    if expires - now >= EXPIRY_WARNING:
        return ""
    renew = f"covrecon pki renew {identity_of_name(common_name)}"
    return (
        f"certificate {common_name} expires in {days_left(expires, now)} days, at {expires:%Y-%m-%d %H:%M} UTC: {renew}"
    )


def _check_register(register: Register, path: Path, common_name: str, issue: str) -> None:
    """The router would refuse it without a word to whoever shows it."""
    entry = next((entry for entry in register.certificates if entry.common_name == common_name), None)
    if entry is None:
        raise CredentialsError(
            f"{path}: {common_name} is not in {REGISTER_FILE} beside it, so the router refuses it;"
            f" copy the newest {REGISTER_FILE} from the authority's computer"
        )
    if entry.revoked is not None:
        raise CredentialsError(
            f"{path}: {common_name} was revoked at {entry.revoked:%Y-%m-%d %H:%M} UTC;"
            f" make another on the authority's computer ({issue}) and copy it here"
        )
