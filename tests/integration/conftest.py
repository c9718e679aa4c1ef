"""A router's bus, a client's, and the place where they meet; files with mates of their own replace them."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from deploy.run_folder import socket_endpoint, socket_folder_parent
from protocol.bus import Bus, connect


@pytest.fixture
def endpoint() -> Iterator[str]:
    with tempfile.TemporaryDirectory(dir=socket_folder_parent()) as folder:
        yield socket_endpoint(Path(folder))


@pytest.fixture
async def ground(endpoint: str) -> AsyncIterator[Bus]:
    """The router's bus, lossless as in lockstep."""
    async with connect(endpoint, "m", router=True, lossless=True) as bus:
        bus.watch_lives()
        yield bus


@pytest.fixture
async def drone(endpoint: str, ground: Bus) -> AsyncIterator[Bus]:
    assert ground
    async with connect(endpoint, "m", lossless=True) as bus:
        bus.watch_lives()
        yield bus
