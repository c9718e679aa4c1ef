"""``covrecon pki``: certificates for the computers of a fleet (docs/certificates.md)."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

if TYPE_CHECKING:
    from deploy.pki.inventory import Inventory
    from protocol.credentials import Entry

pki_app = App(
    name="pki",
    help="""Make the certificates by which the computers of a fleet know each other, renew them, and revoke stolen ones.

    All but "show" works in the authority's folder, which is best kept away from the network (docs/certificates.md).
    """,
)

FOLDER = Path("pki")
GROUND_PLACE = "GROUND:/etc/covrecon/pki/"
"""Where the files lie on the ground station's computer and on drones, as the systemd units have it."""
RELOAD = "ssh GROUND systemctl reload covrecon-router"

Folder = Annotated[Path, Parameter(help="The authority's folder.")]
Name = Annotated[str, Parameter(help="router, ground, sim, drone-3, drone-1..8, operator-anna.")]
Days = Annotated[int, Parameter(help="For how long they are valid.", validator=Number(gte=1, lte=3650))]
Hosts = Annotated[
    tuple[str, ...],
    Parameter(name="--host", negative="", show_default=False, help="Address or name of the router; may be repeated."),
]


@pki_app.command
def init(folder: Folder = FOLDER, *, host: Hosts, days: Days = 90) -> None:
    """Make an authority, and the certificates of router, ground station and simulator.

    ```
    covrecon pki init --host 10.0.0.1                       # in the folder pki
    covrecon pki init fleet --host 10.0.0.1 --host ground.example
    ```

    Parameters
    ----------
    host
        Address or name by which drones call the router, as in transport.endpoint; may be repeated. The computer's own,
        localhost and 127.0.0.1, are added.
    """
    from deploy.pki.authority import init as make

    now = _now()
    entries = make(folder, host, now=now, life=timedelta(days=days))
    print(f"{folder}: a new authority; keep {folder / 'ca.key'} secret, and a copy of the folder in a safe place")
    _tell(folder, entries, now)
    print(f"Next, for each drone and operator: covrecon pki issue drone-1 operator-anna{_option(folder)}")


@pki_app.command
def issue(*names: Name, folder: Folder = FOLDER, days: Days = 90, host: Hosts = ()) -> None:
    """Make certificates for those who have none, or none that is valid.

    ```
    covrecon pki issue drone-1..8 operator-anna
    covrecon pki issue router --host 10.0.0.1               # after its old one was revoked
    ```
    """
    from deploy.pki.authority import issue as make

    now = _now()
    _tell(folder, make(folder, _named(names), now=now, life=timedelta(days=days), hosts=host), now)


@pki_app.command
def renew(
    *names: Name,
    folder: Folder = FOLDER,
    every: Annotated[bool, Parameter(name="--all", negative="", show_default=False, help="Of everybody.")] = False,
    within: Annotated[
        int | None,
        Parameter(help="Only those that expire within so many days.", validator=Number(gte=0), show_default=False),
    ] = None,
    days: Days = 90,
    host: Hosts = (),
) -> None:
    """Make new keys and certificates for those who have one. The old ones stay valid until they expire or are revoked.

    ```
    covrecon pki renew drone-3
    covrecon pki renew --all --within 30                    # what ends within a month
    covrecon pki renew router --host 10.0.0.7               # when the router has moved; without --host it keeps its own
    ```
    """
    from deploy.pki.authority import admitted_issues
    from deploy.pki.authority import renew as make
    from protocol.errors import CredentialsError

    if bool(names) == every:
        raise CredentialsError("say whose, or --all, not both: covrecon pki renew drone-3")
    now = _now()
    chosen = () if every else _named(names)
    entries = make(
        folder,
        chosen,
        now=now,
        life=timedelta(days=days),
        within=None if within is None else timedelta(days=within),
        hosts=host,
    )
    if not entries:
        print("nothing to renew")
        return
    _tell(folder, entries, now)
    old = [
        issue.common_name
        for entry in entries
        for issue in admitted_issues(folder, entry.identity, now)
        if issue != entry
    ]
    if old:
        print("The old ones stay valid until they expire. Once the new ones are in place:")
        print(f"  covrecon pki revoke {' '.join(old)}{_option(folder)}")


@pki_app.command
def revoke(*names: Name, folder: Folder = FOLDER) -> None:
    """Have the router refuse certificates: a drone's that was stolen or lost, or an old one that was renewed.

    ```
    covrecon pki revoke drone-3                             # all that drone 3 ever had
    covrecon pki revoke drone-3.1                           # that one alone
    ```
    """
    from deploy.pki.authority import admitted_issues
    from deploy.pki.authority import revoke as make
    from protocol.credentials import ROUTER

    now = _now()
    revoked = make(folder, _named(names), now=now)
    for entry in revoked:
        print(f"{entry.common_name}: revoked at {entry.revoked:%Y-%m-%d %H:%M} UTC")
    left = {entry.identity: admitted_issues(folder, entry.identity, now) for entry in revoked}
    if left.get(ROUTER) == ():
        print("A router whose own certificate is revoked reads no register. Give it another before all else:")
        print(f"  covrecon pki issue {ROUTER} --host ADDRESS{_option(folder)}")
    print("The router admits them until it has the new register. Copy it now, and have it read:")
    print(f"  {_copy(folder, ['register.json'], GROUND_PLACE)}")
    print(f"  {RELOAD}")
    for identity, others in left.items():
        if others:
            print(f"Still valid: {', '.join(entry.common_name for entry in others)}")
        elif identity != ROUTER:
            print(f"A new one for {identity}: covrecon pki issue {identity}{_option(folder)}")
    if ROUTER in left:
        print("Nobody tells drones that a router is revoked: whoever has its key can pose as the router until it")
        print("expires. If it was stolen, make a new authority: covrecon pki init NEW-FOLDER --host ADDRESS")


@pki_app.command
def show(
    folder: Annotated[Path, Parameter(help="The authority's, or that of any computer of the fleet.")] = FOLDER,
    *,
    as_json: Annotated[bool, Parameter(name="--json", negative="", show_default=False)] = False,
) -> int:
    """List the certificates of a folder, until when they are valid, and what is to be mended. Nothing is changed.

    Exit code 1 if anything in use has expired or is unsafe: run it once a day.

    ```
    covrecon pki show
    covrecon pki show /etc/covrecon/pki --json              # on a drone
    ```

    Parameters
    ----------
    as_json
        For machines: "certificates" with name, issue, expires, days_left and state, and "faults", what is to be mended.
    """
    from deploy.pki.inventory import take_inventory

    found = take_inventory(folder, _now())
    if as_json:
        items = [asdict(item) | {"expires": item.expires.isoformat()} for item in found.items]
        print(json.dumps({"certificates": items, "faults": found.faults}, indent=2))
    else:
        print("\n".join(_table(found)))
    return 0 if found.is_sound else 1


def _table(found: Inventory) -> Iterator[str]:
    yield f"{'name':24} {'issue':>5}  {'valid until (UTC)':17} {'days left':>9}  state"
    for item in found.items:
        number = item.issue or ""
        yield f"{item.name:24} {number:>5}  {item.expires:%Y-%m-%d %H:%M}  {item.days_left:>9}  {item.state}"
    for fault in found.faults:
        yield f"to mend: {fault}"


def _named(names: Sequence[str]) -> list[str]:
    """Each name, ranges spelt out."""
    from protocol.errors import CredentialsError

    if not names:
        raise CredentialsError("say whose: drone-3, drone-1..8, operator-anna, router, ground or sim")
    spelt = []
    for name in names:
        span = re.fullmatch(r"drone-([0-9]{1,3})\.\.([0-9]{1,3})", name)
        if span is None:
            spelt.append(name)
            continue
        numbers = range(int(span[1]), int(span[2]) + 1)
        if not numbers:
            raise CredentialsError(f"{name}: goes backwards; drone-{span[2]}..{span[1]} is meant")
        spelt += [f"drone-{number}" for number in numbers]
    return spelt


def _tell(folder: Path, entries: Sequence[Entry], now: datetime) -> None:
    """What was made, and where it belongs: never the authority's key."""
    from deploy.pki.authority import GROUND_COMPUTER
    from protocol.certificates import days_left

    for entry in entries:
        days = days_left(entry.expires, now)
        print(f"{entry.common_name}: valid until {entry.expires:%Y-%m-%d %H:%M} UTC, {days} days")
    identities = [entry.identity for entry in entries]
    print("To copy, where it is another computer:")
    for identity in identities:
        if identity not in GROUND_COMPUTER:
            print(f"  {_copy(folder, ['ca.pem', *_pair(identity)], _place(identity))}")
    pairs = [name for identity in identities if identity in GROUND_COMPUTER for name in _pair(identity)]
    print(f"  {_copy(folder, ['ca.pem', 'register.json', *pairs] if pairs else ['register.json'], GROUND_PLACE)}")
    print(f"Then have the router read its register: {RELOAD}")


def _pair(identity: str) -> list[str]:
    return [f"{identity}.pem", f"{identity}.key"]


def _place(identity: str) -> str:
    """Where the files of a drone or an operator belong; the computer's name is to be filled in."""
    if identity.startswith("operator-"):
        return "LAPTOP:pki/"
    return GROUND_PLACE.replace("GROUND", identity.upper())


def _copy(folder: Path, names: Iterable[str], place: str) -> str:
    return f"{shlex.join(['scp', '-p', *(str(folder / name) for name in names)])} {place}"


def _option(folder: Path) -> str:
    return "" if folder == FOLDER else f" --folder {shlex.quote(str(folder))}"


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)  # certificates know no smaller unit
