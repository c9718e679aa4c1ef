"""What a training hangs on: the same settings give the same weights on the same kind of processor."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from ground_station.reconstruction.learned.fragment import HALVED
from protocol.errors import TrainingError
from protocol.settings import NonNegative, Positive, Settings, Share

Count = Annotated[int, Field(ge=1)]


class TrainingSettings(Settings):
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Of the first weights and of every draw."""
    rooms: Count = 36
    """Random rooms that are learnt from ..."""
    held_out: Count = 3
    """... and rooms that only the curve's held-out part is measured on."""
    first_room: Annotated[int, Field(ge=0)] = 100_000
    """Seed of the first room; those learnt from come first. Far from the seeds that people fly in."""
    steps: Count = 10_000
    """Fragments that are learnt from, one a step; `covrecon train` may be given others."""
    learning_rate: Positive = 2e-3
    """Of AdamW."""
    warm_up: Count = 100
    """Steps in which the rate rises from nothing."""
    decay_share: Share = 0.3
    """Of the steps, the last ones, in which the rate falls to nothing along a cosine. Before, it does not hang on the
    number of steps, so that a training can go on with another one."""
    weight_decay: NonNegative = 1e-2
    window: tuple[Count, Count, Count] = (24, 24, 28)
    """Coarse voxels learnt from at a time, multiples of 4: smaller than a fragment's, for more different ones."""
    refined: Count = 8192
    """Fine voxels learnt from at a time."""
    distance_weight: Positive = 3.0
    """Of the error of the distance against that of the occupancy."""
    pose_noise_m: NonNegative = 0.01
    """Largest standard deviation of the error that each coordinate of a pose is given ..."""
    pose_noise_rad: NonNegative = 0.005
    """... and of each angle, 0.3 degrees."""
    bfloat16: bool = True
    """Whether convolutions compute in bfloat16: 2.7 times as fast where the processor can (AVX-512 BF16)."""
    measured_every: Count = 250
    """Steps between two points of the curve, each with a checkpoint."""
    measured_lessons: Count = 24
    """Fragments of held-out rooms that each point is measured on."""

    @model_validator(mode="after")
    def _windows_halve_twice(self) -> Self:
        if any(size % HALVED for size in self.window):
            raise ValueError(f"window {self.window} must be multiples of {HALVED}")
        return self

    def goes_on(self, before: TrainingSettings) -> bool:
        """Whether a training with the settings ``before`` may go on with these: with another number of steps it may."""
        return self.model_copy(update={"steps": before.steps}) == before

    @property
    def room_seeds(self) -> list[int]:
        return list(range(self.first_room, self.first_room + self.rooms))

    @property
    def held_out_seeds(self) -> list[int]:
        return [self.first_room + self.rooms + number for number in range(self.held_out)]


def load_settings(path: Path) -> TrainingSettings:
    """From a TOML file; what it does not set is as by default. Raises `TrainingError` that names every fault."""
    try:
        return TrainingSettings.model_validate(tomllib.loads(path.read_text()))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise TrainingError(f"{path}: {error}") from error
    except ValidationError as error:
        faults = [f"{path}: {'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()]
        raise TrainingError("\n".join(faults)) from error
