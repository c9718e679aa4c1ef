"""Where built scenes and their truth are kept between runs; deleting the folder costs only time."""

from __future__ import annotations

import os
from pathlib import Path


def scene_cache() -> Path:
    """``$XDG_CACHE_HOME/covrecon/scenes``, created when missing."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "covrecon" / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
