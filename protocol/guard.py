"""Refuses to run foreign packages under our names.

The packages are imported by their literal names (`agents`, `protocol`, ...), which other distributions use too.
Flying with somebody else's module would fail late and strangely, so every process asks here first.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from protocol.errors import ProcessError

PACKAGES = ("agents", "deploy", "ground_station", "protocol", "sim_bridge")
ROOT = Path(__file__).resolve().parent.parent


def require_own_packages() -> None:
    """Raise `ProcessError` if one of our names would import a package that does not lie beside this one.

    A package that is not there at all is fine: a drone's image has no ground station.
    """
    for name in PACKAGES:
        spec = importlib.util.find_spec(name)
        if spec is None:
            continue
        found = Path(spec.origin).resolve().parent if spec.origin else None
        if found != ROOT / name:
            raise ProcessError(
                f"package {name!r} would come from {found}, not from {ROOT / name}: "
                f"uninstall the distribution that brought it, or set PYTHONPATH={ROOT}"
            )
