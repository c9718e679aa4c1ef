"""Collects what the benchmarks measured into a table and ``benchmarks.json``.

Machines are shared and noisy, so figures are compared within one run and nothing is asserted: a benchmark that is
slower than it should be is read in the table, not reported as a broken test.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[2] / "benchmarks.json"
ROWS = pytest.StashKey[list[dict[str, object]]]()

Record = Callable[..., None]


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Record:
    """``record(name, value, unit, against, ratio)``: ``ratio`` says how many times better than ``against``."""
    rows = request.config.stash.setdefault(ROWS, [])

    def add(name: str, value: float, unit: str, against: str, ratio: float) -> None:
        rows.append({"name": name, "value": value, "unit": unit, "against": against, "ratio": round(ratio, 2)})

    return add


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash.get(ROWS, [])
    if not rows:
        return
    RESULTS.write_text(json.dumps(rows, indent=2) + "\n")
    terminalreporter.section(f"benchmarks, also in {RESULTS.name}")
    for row in rows:
        terminalreporter.write_line(
            f"{row['name']:24} {row['value']:12.4g} {row['unit']:22} {row['ratio']:10.2f} x {row['against']}"
        )
