"""Sends images of a given size and rate from a drone's computer, as its real camera would: without meaning."""

from __future__ import annotations

import argparse
import asyncio
import random
from pathlib import Path

from protocol import topics, traffic_samples
from protocol.bus import connect
from protocol.links import link_of
from protocol.mission_file import load_mission


async def send(mission_file: Path, endpoint: str, drone: int, rate_hz: float, jpeg_bytes: int) -> None:
    mission = load_mission(mission_file)
    dice, loop = random.Random(drone), asyncio.get_running_loop()
    async with connect(link_of(mission, f"drone-{drone}", endpoint=endpoint), mission.name) as bus:
        began_s, sent = loop.time(), 0
        while True:
            image = traffic_samples.keyframe(mission, drone, jpeg_bytes)
            bus.put(topics.KEYFRAME, image.model_copy(update={"jpeg": dice.randbytes(jpeg_bytes)}), drone)
            sent += 1
            await asyncio.sleep(began_s + sent / rate_hz - loop.time())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m faults.picture_sender", description=__doc__)
    parser.add_argument("--mission", type=Path, required=True)
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--drone", type=int, required=True)
    parser.add_argument("--rate-hz", type=float, required=True)
    parser.add_argument("--jpeg-bytes", type=int, required=True)
    told = parser.parse_args()
    asyncio.run(send(told.mission, told.endpoint, told.drone, told.rate_hz, told.jpeg_bytes))
