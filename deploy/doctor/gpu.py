"""Whether there is a GPU; nothing needs one, so none is no fault."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Sequence

from deploy.doctor.finding import Finding

ANSWER_S = 60.0
"""What a driver or torch may take to answer."""
LIST_GPUS = ("nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader")
ASK_TORCH = ("-c", "import torch; print(torch.cuda.is_available(), torch.__version__)")

Ask = Callable[[Sequence[str]], str]
"""Output of a command; empty if it cannot be run or fails."""


def ask(command: Sequence[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ANSWER_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def check_gpu(answer: Ask = ask, *, has_torch: bool | None = None) -> Finding:
    """``has_torch``: None looks."""
    gpus = "; ".join(answer(LIST_GPUS).splitlines())
    if has_torch is None:
        has_torch = importlib.util.find_spec("torch") is not None
    if not has_torch:
        return Finding("gpu", "ok", f"{gpus or 'none found'}; not needed: maps are made on the processor")
    usable, _, version = answer((sys.executable, "-P", *ASK_TORCH)).partition(" ")
    if gpus and usable != "True":
        return Finding(
            "gpu",
            "warn",
            f"{gpus}, but torch {version or '(cannot be loaded)'} cannot use it",
            'install a torch that was built for the driver\'s CUDA version, or leave reconstruction.device at "cpu"',
        )
    return Finding("gpu", "ok", f"{gpus or 'none found'}; torch {version}")
