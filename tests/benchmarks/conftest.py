"""Collects what the benchmarks measured into a table and ``benchmarks.json``.

Machines are shared and noisy, so figures are compared within one run and nothing is asserted: a benchmark that is
slower than it should be is read in the table, not reported as a broken test.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[2] / "benchmarks.json"
ROWS = pytest.StashKey[list[dict[str, object]]]()

Record = Callable[..., None]


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Record:
    """``record(name, value, unit, against, ratio)``: ``ratio`` says how many times better than ``against``. ``curve``:
    points (x, y) of what it grows with, if that is what was measured."""
    rows = request.config.stash.setdefault(ROWS, [])
    where = {"machine": machine(), "day": datetime.now(UTC).date().isoformat()}

    def add(
        name: str, value: float, unit: str, against: str, ratio: float, curve: Sequence[tuple[float, float]] = ()
    ) -> None:
        row = {"name": name, "value": float(value), "unit": unit, "against": against, "ratio": round(float(ratio), 2)}
        rows.append(row | ({"curve": [[float(x), float(y)] for x, y in curve]} if curve else {}) | where)

    return add


def machine() -> str:
    """Cores, processor and Python, in words."""
    try:
        told = Path("/proc/cpuinfo").read_text()
    except OSError:
        told = ""
    model = next((line.partition(":")[2].strip() for line in told.splitlines() if line.startswith("model name")), "")
    cores = len(os.sched_getaffinity(0))
    return f"{cores} cores, {model or platform.machine()}, Python {platform.python_version()}"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Rows that this run did not measure stay in the file as they were."""
    rows = config.stash.get(ROWS, [])
    if not rows:
        return
    measured = {row["name"] for row in rows}
    earlier = json.loads(RESULTS.read_text()) if RESULTS.exists() else []
    kept = [row for row in earlier if row["name"] not in measured]
    RESULTS.write_text(json.dumps([*kept, *rows], indent=2) + "\n")
    terminalreporter.section(f"benchmarks, also in {RESULTS.name}")
    for row in rows:
        terminalreporter.write_line(
            f"{row['name']:24} {row['value']:12.4g} {row['unit']:22} {row['ratio']:10.2f} x {row['against']}"
        )
