"""How the certificates of a folder fare: the authority's, with the whole fleet's register, or a single computer's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from deploy.pki.authority import AUTHORITY_KEY_FILE
from deploy.pki.signing import serial_of
from protocol.certificates import common_name_of, days_left, load_certificate, open_to_others
from protocol.credentials import (
    AUTHORITY_FILE,
    DRONE,
    EXPIRY_WARNING,
    GROUND,
    MAPPER,
    MOCAP,
    OPERATOR,
    REGISTER_FILE,
    ROUTER,
    SIM,
    Entry,
    identities_in,
    load_credentials,
    load_register,
    split_common_name,
)
from protocol.errors import CredentialsError

State = Literal["valid", "expires soon", "expired", "revoked", "replaced"]
"""replaced: there is a newer issue; this one is admitted until it expires or is revoked."""
AUTHORITY = "ca"


@dataclass(frozen=True, slots=True)
class Item:
    """One certificate, in use or not."""

    name: str
    """Identity, or ``ca``."""
    issue: int
    """0 of the authority's own."""
    expires: datetime
    days_left: int
    """Negative once it has expired."""
    state: State


@dataclass(frozen=True, slots=True)
class Inventory:
    items: tuple[Item, ...]
    faults: tuple[str, ...]
    """What is to be mended, each with what to do; a process that uses it would refuse to start."""

    @property
    def is_sound(self) -> bool:
        """Whether nothing that is in use has expired or is unsafe."""
        return not self.faults and all(item.state != "expired" for item in self.items)


def take_inventory(folder: Path, now: datetime) -> Inventory:
    """What ``folder`` holds, and what its register knows of.

    Raises:
        CredentialsError: it has no certificate of an authority, so it is no folder of `covrecon pki`.
    """
    if not folder.is_dir():
        raise CredentialsError(f"{folder}: no such folder; covrecon pki init makes one")
    authority = load_certificate(
        folder / AUTHORITY_FILE, "this is no folder that covrecon pki made; begin with: covrecon pki init"
    )
    faults: list[str] = []
    entries: dict[str, Entry] = {}
    if (folder / REGISTER_FILE).exists():
        try:
            entries = {entry.common_name: entry for entry in load_register(folder).certificates}
        except CredentialsError as error:
            faults.append(str(error))
    found = identities_in(folder)
    for identity in found:
        try:
            entry = _entry_of(folder / f"{identity}.pem")
            entries.setdefault(entry.common_name, entry)
            load_credentials(folder, identity, now=now)
        except CredentialsError as error:
            faults.append(str(error))
    faults += _permission_faults(folder)
    end = authority.not_valid_after_utc
    own = Item(AUTHORITY, 0, end, days_left(end, now), _state_by_time(end, now))
    items = sorted(_items(list(entries.values()), now), key=_order)
    return Inventory((own, *items), tuple(dict.fromkeys(faults)))


def _entry_of(path: Path) -> Entry:
    """As the register would have it; raises `CredentialsError`."""
    certificate = load_certificate(path, "copy it again from the authority's computer")
    common_name = common_name_of(certificate)
    split_common_name(common_name)
    return Entry(
        common_name=common_name,
        serial=serial_of(certificate),
        issued=certificate.not_valid_before_utc,
        expires=certificate.not_valid_after_utc,
    )


def _items(entries: Sequence[Entry], now: datetime) -> Iterator[Item]:
    newest: dict[str, int] = {}
    for entry in entries:
        if entry.revoked is None:
            newest[entry.identity] = max(entry.issue, newest.get(entry.identity, 0))
    for entry in entries:
        state: State
        if entry.revoked is not None:
            state = "revoked"
        elif entry.issue < newest[entry.identity]:
            state = "replaced"
        else:
            state = _state_by_time(entry.expires, now)
        yield Item(entry.identity, entry.issue, entry.expires, days_left(entry.expires, now), state)


def _order(item: Item) -> tuple[int, int, str, int]:
    """The ground station's computer first, then drones by number, then operators by name."""
    kind, _, rest = item.name.partition("-")
    kinds = (ROUTER, GROUND, SIM, MAPPER, MOCAP, DRONE, OPERATOR)
    return kinds.index(kind), int(rest) if kind == DRONE else 0, rest, item.issue


def _state_by_time(expires: datetime, now: datetime) -> Literal["valid", "expires soon", "expired"]:
    if now >= expires:
        return "expired"
    return "expires soon" if expires - now < EXPIRY_WARNING else "valid"


def _permission_faults(folder: Path) -> Iterator[str]:
    key = folder / AUTHORITY_KEY_FILE
    if open_to_others(folder):
        yield f"{folder}: others than its owner may enter it; run: chmod 700 {folder}"
    if key.exists() and open_to_others(key):
        yield f"{key}: others than its owner may read or change it; run: chmod 600 {key}"
