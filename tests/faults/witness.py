"""The simulator with a witness: every vehicle's true position at every tick, whoever is cut off from the bus.

Takes the simulator's arguments. The lines of the file are: tick, then x y z of each drone in the order of its id.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from protocol import topics
from protocol.bus import Bus
from protocol.geometry import Floats
from protocol.messages import Tick
from protocol.process import Arguments, run_process
from protocol.topics import Topic
from protocol.wire import Message
from sim_bridge.__main__ import main

WITNESS_FILE = "witness.txt"


async def witnessed(arguments: Arguments) -> None:
    put = Bus.put
    with (arguments.run / WITNESS_FILE).open("w", buffering=1) as file:

        def write_and_put(bus: Bus, topic: Topic[Any], message: Message, drone: int | str = "") -> None:
            if isinstance(message, Tick) and topic is topics.TICK:
                places = (f"{value!r}" for vehicle in message.vehicles for value in vehicle.pose[:3])
                print(message.tick, *places, file=file)
            put(bus, topic, message, drone)

        Bus.put = write_and_put  # type: ignore[method-assign, assignment]  # the simulator makes its own bus
        await main(arguments)


def true_positions(run: Path) -> Iterator[tuple[int, Floats]]:
    """Each tick with the positions (drones, 3) at its start, m."""
    for line in (run / WITNESS_FILE).read_text().splitlines():
        tick, *places = line.split()
        yield int(tick), np.array(places, dtype=float).reshape(-1, 3)


if __name__ == "__main__":
    sys.exit(run_process("sim_bridge", witnessed))
