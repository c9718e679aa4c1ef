"""Which kind of map feedback a mission asks for."""

from __future__ import annotations

from ground_station.m3c2_change import M3C2MeshChange
from ground_station.mesh_change import GridMeshChange, MeshChange
from protocol.field import VirtualField
from protocol.mission import Mission


def make_mesh_change(mission: Mission, field: VirtualField) -> MeshChange:
    """A new one, before the first mesh."""
    axes = (field.xs, field.ys, field.zs)
    if mission.feedback.method == "m3c2":
        return M3C2MeshChange(mission.target, mission.feedback, axes)
    return GridMeshChange(mission.target, mission.feedback, axes)  # for "none" as well: nobody asks what it found
