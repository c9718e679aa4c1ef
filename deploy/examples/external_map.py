"""A map made outside the ground station, the shortest one that is of use: our own plane sweep in a process of its own.

covrecon run missions/demo.toml --mapper "python -m deploy.examples.external_map"

To wrap another method, put it in the place of `PlaneSweepMap`: docs/external-reconstructor.md.
"""

from __future__ import annotations

import sys

from ground_station.mapper import read_keyframe
from ground_station.reconstruction.backends import make_reconstructor
from protocol.external_map import Map, run_map_process
from protocol.messages import Keyframe
from protocol.mission import Mission


class PlaneSweepMap:
    """Implements `protocol.external_map.MapMaker`."""

    def __init__(self, mission: Mission) -> None:
        settings = mission.reconstruction.model_copy(update={"backend": "plane_sweep"})
        self._reconstructor = make_reconstructor(mission.model_copy(update={"reconstruction": settings}))

    def add(self, keyframe: Keyframe) -> None:
        self._reconstructor.add([read_keyframe(keyframe)])

    def mesh(self) -> Map:
        mesh = self._reconstructor.mesh()
        return Map(mesh.vertices, mesh.faces, mesh.colors)


if __name__ == "__main__":
    sys.exit(run_map_process(PlaneSweepMap))
