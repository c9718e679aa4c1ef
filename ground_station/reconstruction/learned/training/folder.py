"""What lies where in a training's folder, and whether a training may begin or go on in it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from pydantic import ValidationError

from ground_station.durable import replace_file
from ground_station.reconstruction.learned.training.settings import TrainingSettings
from protocol.errors import TrainingError

SETTINGS_FILE: Final = "settings.json"
ROOMS_FOLDER: Final = "rooms"
CHECKPOINT_FILE: Final = "checkpoint.pt"
CURVE_FILE: Final = "curve.csv"
PICTURE_FILE: Final = "curve.png"
WEIGHTS_FILE: Final = "weights.safetensors"


def room_path(folder: Path, seed: int) -> Path:
    return folder / ROOMS_FOLDER / f"room-{seed}.npz"


def missing_rooms(folder: Path, settings: TrainingSettings) -> list[int]:
    """Seeds."""
    return [seed for seed in (*settings.room_seeds, *settings.held_out_seeds) if not room_path(folder, seed).exists()]


def begin(folder: Path, settings: TrainingSettings, *, resume: bool) -> None:
    """Make the folder, or see that it is this training's. Raises `TrainingError`."""
    if (folder / CHECKPOINT_FILE).exists():
        if not resume:
            raise TrainingError(
                f"{folder} holds a training: go on with it by --resume, or name another folder by --out"
            )
        if not settings.goes_on(read_settings(folder)):
            raise TrainingError(f"{folder} holds a training with other settings: {folder / SETTINGS_FILE}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / SETTINGS_FILE, [settings.model_dump_json(indent=2).encode()])
    except OSError as error:
        raise TrainingError(f"{folder}: {error.strerror}") from error


def read_settings(folder: Path) -> TrainingSettings:
    """Raises `TrainingError`, naming the file."""
    path = folder / SETTINGS_FILE
    try:
        return TrainingSettings.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise TrainingError(f"{path}: {error}") from error
