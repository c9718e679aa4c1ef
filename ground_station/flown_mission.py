"""The mission that a run's folder is of, for whoever reads one later."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from ground_station.results import MISSION_FILE
from protocol.errors import MissionError
from protocol.mission import Mission


def read_mission(folder: Path) -> Mission:
    """Raises `MissionError` if there is none that can be read."""
    path = folder / MISSION_FILE
    try:
        return Mission.model_validate_json(path.read_bytes())
    except OSError as error:
        raise MissionError([f"{path}: {error.strerror}; is this the folder of a run?"]) from error
    except ValidationError as error:
        raise MissionError([f"{path}: {fault['loc']}: {fault['msg']}" for fault in error.errors()]) from error
