"""A few cells of the fault matrix; `make faults` flies them all."""

from __future__ import annotations

from pathlib import Path

import pytest

from faults.matrix import FAULTS, fly_cell

STOP_BELOW = 0.25
"""Reached in a third of the time that `make faults` takes for a cell."""


@pytest.mark.processes
@pytest.mark.timeout(300)  # the flight has its own bounds, which add up to more than other tests may take
@pytest.mark.parametrize(
    "name",
    [
        "ground station killed and started again",
        "black hole around an agent for 3 s",
        "router killed and started again",
    ],
)
async def test_a_flight_survives(name: str, tmp_path: Path) -> None:
    (fault,) = (fault for fault in FAULTS if fault.name == name)

    result = await fly_cell(fault, 1, tmp_path, stop_below=STOP_BELOW)

    assert result.held, result.figures
