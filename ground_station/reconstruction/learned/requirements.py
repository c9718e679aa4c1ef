"""What the network needs beside the rest, asked without loading it: torch takes seconds, most missions do without."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Final

from protocol.errors import ReconstructionError
from protocol.mission import Mission

EXTRA: Final = "learned"
"""Optional set of packages in pyproject.toml."""
MODULES: Final = ("torch", "safetensors")


def require_torch() -> None:
    """Raises `ReconstructionError`, naming the extra, where the network cannot run."""
    missing = [name for name in MODULES if find_spec(name) is None]
    if missing:
        raise ReconstructionError(
            f"the learned reconstructor needs {' and '.join(missing)}: run .venv/bin/pip install -e '.[{EXTRA}]'"
        )


def require_backend(mission: Mission) -> None:
    """Asked before a flight. Raises `ReconstructionError` if what the mission's method needs is not here."""
    if mission.reconstruction.backend != "learned":
        return
    require_torch()
    weights = mission.reconstruction.learned.weights
    if weights and not Path(weights).is_file():
        raise ReconstructionError(f"reconstruction.learned.weights: {weights} is not a file")
