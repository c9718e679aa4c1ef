"""Where Prometheus reads one process's figures: HTTP on this computer alone, on a thread of its own.

The figures are a help, no part of the mission: a port that is taken costs a warning, never the flight.
"""

from __future__ import annotations

import logging
from contextlib import AbstractContextManager
from threading import Thread
from types import TracebackType
from typing import Literal
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, Info, ProcessCollector, start_http_server

from protocol.mission import Mission

log = logging.getLogger(__name__)

HOST = "127.0.0.1"

Kind = Literal["ground", "sim", "agent"]


def metrics_port(mission: Mission, kind: Kind, drone: int = 0) -> int:
    """Port of a process's endpoint; 0: it has none."""
    first = mission.metrics.port
    return first + {"ground": 0, "sim": 1, "agent": 1 + drone}[kind] if first else 0


class MetricsEndpoint(AbstractContextManager["MetricsEndpoint"]):
    """Serves ``registry`` at http://127.0.0.1:``port``/metrics until it is closed."""

    def __init__(self, mission: Mission, kind: Kind, drone: int = 0) -> None:
        """A mission that wants no metrics has a registry all the same: nobody who counts has to ask."""
        self.registry = CollectorRegistry()
        """Holds which process it is, and its processor time, memory and open files."""
        self.port = 0
        """Where it is served; 0 where it is not."""
        self._serving: tuple[WSGIServer, Thread] | None = None
        whose = {"mission": mission.name, "kind": kind} | ({"drone": str(drone)} if drone else {})
        Info("covrecon_process", "Which process this is.", registry=self.registry).info(whose)
        ProcessCollector(registry=self.registry)
        port = metrics_port(mission, kind, drone)
        if port:
            self._start(port)

    def _start(self, port: int) -> None:
        try:
            self._serving = start_http_server(port, HOST, self.registry)
        except (OSError, OverflowError) as error:  # the latter: drone 255's port may lie beyond the last
            log.warning(
                "no metrics of this process: cannot listen at %s:%d: %s; set metrics.port to a free range",
                HOST,
                port,
                getattr(error, "strerror", None) or error,
            )
            return
        self.port = port
        log.info("metrics: http://%s:%d/metrics", HOST, port)

    def close(self) -> None:
        """May be called again."""
        if self._serving is not None:
            server, thread = self._serving
            server.shutdown()
            server.server_close()
            thread.join()
            self._serving, self.port = None, 0

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
