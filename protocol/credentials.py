"""Who a process is: its certificate, its key, and the authority by which it knows the others.

A folder that `covrecon pki` filled holds ``ca.pem`` and, for each identity that lives there, ``<identity>.pem`` and
``<identity>.key``. Identities are ``router``, ``ground``, ``sim``, ``drone-<id>`` and ``operator-<name>``. The common
name of a certificate is identity and issue, ``drone-3.2``, so that a stolen one can be told from its successor.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

AUTHORITY_FILE, REGISTER_FILE = "ca.pem", "register.json"
ROUTER, GROUND, SIM = "router", "ground", "sim"


@dataclass(frozen=True, slots=True)
class Credentials:
    """What one process shows, and by what it judges the router; of a router also whom it lets in."""

    folder: Path
    identity: str
    common_name: str
    expires: datetime

    @property
    def authority(self) -> Path:
        return self.folder / AUTHORITY_FILE

    @property
    def certificate(self) -> Path:
        return self.folder / f"{self.identity}.pem"

    @property
    def key(self) -> Path:
        return self.folder / f"{self.identity}.key"
