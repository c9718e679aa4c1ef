"""How people watch, command and keep a mission: ``[console]``, ``[recording]`` and ``[metrics]`` of a mission file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from protocol.settings import Positive, Settings

Port = Annotated[int, Field(ge=0, le=65535)]
FirstPort = Annotated[int, Field(ge=0, le=65535 - 256)]
"""Of as many as a mission may have processes."""


CONSOLE_FILE = "console.json"
"""In the run's folder, while the console serves: its address with the token, for its owner's eyes alone."""


class Console(Settings):
    """The page in the browser (`covrecon run --console`)."""

    host: str = "127.0.0.1"
    """Address that it listens at. Whoever reaches another one than this computer's and has the token commands the
    drones; put TLS in front of it."""
    port: Port = 8080
    """0: any that is free."""


class Recording(Settings):
    """What a run leaves for people: one MCAP file, which Foxglove opens, and a report."""

    enabled: bool = True
    report: bool = True
    """Whether the report is written at the end; some ten seconds of processor time, and `covrecon report` makes it at
    any later time."""
    mesh_period_s: Positive = 10.0
    """Mission time between two recorded meshes and pictures of phi."""
    queue: Annotated[int, Field(ge=16, le=1_000_000)] = 2000
    """Messages that may wait for the disk; in real time, more are dropped and counted."""
    foxglove_port: Port = 0
    """Where Foxglove may watch live, on this computer alone; 0: nowhere."""


class Metrics(Settings):
    """Prometheus endpoints on this computer alone."""

    port: FirstPort = 0
    """Of the ground station; the simulator has the next, drone i the one after it plus i. 0: none."""
