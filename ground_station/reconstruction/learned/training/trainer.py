"""One step after another: draw a lesson, compare, correct; now and then measure on rooms that are never learnt from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor
from torch.nn import functional

from ground_station.durable import replace_file
from ground_station.reconstruction.learned.fragment import COARSE, REACH_M
from ground_station.reconstruction.learned.network import ARCHITECTURE, Coarse, Network
from ground_station.reconstruction.learned.training.lessons import Lesson, Room, draw_lesson, to_coarse
from ground_station.reconstruction.learned.training.settings import TrainingSettings
from protocol.errors import TrainingError

VIEWS_SEEN: Final = 2
"""Views that must see a voxel for its answer to count: one alone says nothing of depth."""
GRADIENT_MAX: Final = 1.0
"""Norm at which a step's gradient is cut."""
MEASURED_DRAWS: Final = 2**31
"""Draws from here on are for measuring, so that no lesson learnt from is drawn as they are."""


@dataclass(frozen=True, slots=True)
class Loss:
    total: Tensor
    distance_mm: float
    """Mean error of the distance, of fine voxels near surfaces."""
    occupancy: float
    """F-score of the fine level's occupancy."""


@dataclass(frozen=True, slots=True)
class Point:
    """One point of the curve."""

    step: int
    loss: float
    held_out_loss: float
    held_out_mm: float
    held_out_occupancy: float


class Trainer:
    """Every lesson hangs on the seed and its step's number alone, so a training that is resumed learns the same."""

    def __init__(self, settings: TrainingSettings, rooms: list[Room], held_out: list[Room]) -> None:
        torch.set_num_threads(1)  # sums hang on the number of threads
        torch.use_deterministic_algorithms(True)
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.step = 0
        self.curve: list[Point] = []
        self.network = Network()
        self.network.image_net.to(memory_format=torch.channels_last)
        self.network.volume_net.to(memory_format=torch.channels_last_3d)
        self._rooms, self._held_out = rooms, held_out
        self._recent: list[float] = []
        self._optimiser = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )

    def learn(self, steps: int) -> None:
        """One step of a training of ``steps``."""
        lesson = draw_lesson(self._rooms, self.settings, self.step)
        for group in self._optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * rate(self.settings, self.step, steps)
        self.network.train()
        self._optimiser.zero_grad()
        generator = torch.Generator().manual_seed(self.settings.seed * 2**32 + self.step)
        loss = self._loss(lesson, generator)
        loss.total.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_MAX)
        self._optimiser.step()
        self._recent.append(float(loss.total.detach()))
        self.step += 1

    def measure(self) -> Point:
        """The next point of the curve: on held-out rooms, with the lessons of every point the same."""
        self.network.eval()
        losses = []
        with torch.no_grad():
            for number in range(self.settings.measured_lessons):
                lesson = draw_lesson(self._held_out, self.settings, MEASURED_DRAWS + number, varied=False)
                losses.append(self._loss(lesson, torch.Generator().manual_seed(number)))
        point = Point(
            self.step,
            _mean(self._recent),
            _mean([float(loss.total) for loss in losses]),
            _mean([loss.distance_mm for loss in losses]),
            _mean([loss.occupancy for loss in losses]),
        )
        self._recent.clear()
        self.curve.append(point)
        return point

    def _loss(self, lesson: Lesson, generator: torch.Generator) -> Loss:
        images = torch.from_numpy(lesson.images).contiguous(memory_format=torch.channels_last)
        projections, corner = torch.from_numpy(lesson.projections), torch.zeros(3)
        distance, occupied = torch.from_numpy(lesson.distance), torch.from_numpy(lesson.occupied)
        coarse_distance, coarse_occupied = map(torch.from_numpy, to_coarse(lesson.distance, lesson.occupied))
        x, y, z = coarse_distance.shape
        with torch.autocast("cpu", torch.bfloat16, enabled=self.settings.bfloat16):
            features = self.network.image_net(images)
            coarse = self.network.coarse(features, projections, corner, (x, y, z))
            voxels = self._refined(coarse, coarse_occupied, generator)
            refined = self.network.refine(features, projections, corner, coarse, voxels)
        right = distance[tuple(voxels.T)], occupied[tuple(voxels.T)]
        weight = self.settings.distance_weight
        total = _error(coarse.distance, coarse.occupied, coarse_distance, coarse_occupied, coarse.seen, weight)
        total = total + _error(refined.distance, refined.occupied, *right, refined.seen, weight)
        return Loss(total, *_quality(refined.distance.detach(), refined.occupied.detach(), *right, refined.seen))

    def _refined(self, coarse: Coarse, occupied: Tensor, generator: torch.Generator) -> Tensor:
        """Some of the fine voxels (P, 3) in coarse ones that hold a surface, or that the network takes for such."""
        wanted = (occupied | (coarse.occupied.detach() > 0)) & (coarse.seen >= VIEWS_SEEN)
        parents = wanted.nonzero()
        within = torch.cartesian_prod(*[torch.arange(COARSE)] * 3)
        voxels = (COARSE * parents[:, None] + within).reshape(-1, 3)
        chosen = torch.randperm(len(voxels), generator=generator)[: self.settings.refined]
        return voxels[chosen]

    def state(self) -> dict[str, Any]:
        return {
            "architecture": ARCHITECTURE,
            "settings": self.settings.model_dump_json(),
            "step": self.step,
            "network": self.network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "recent": self._recent,
            "curve": [tuple(getattr(point, name) for name in Point.__slots__) for point in self.curve],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on where ``state`` was taken. Raises `TrainingError` if it is another training's."""
        if state["architecture"] != ARCHITECTURE:
            raise TrainingError(
                f"the checkpoint is of architecture {state['architecture']}, this release has {ARCHITECTURE}"
            )
        before = TrainingSettings.model_validate_json(state["settings"])
        if not self.settings.goes_on(before):
            raise TrainingError("the checkpoint is of a training with other settings")
        self.network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self.step, self._recent = state["step"], state["recent"]
        self.curve = [Point(*values) for values in state["curve"]]


def rate(settings: TrainingSettings, step: int, steps: int) -> float:
    """Share of the learning rate at a step: a rise, a plateau that does not hang on ``steps``, and a cosine down."""
    falling = settings.decay_share * steps
    left = min(1.0, (steps - step) / falling) if falling else 1.0
    return min(1.0, (step + 1) / settings.warm_up) * 0.5 * (1 - math.cos(math.pi * left))


def save_checkpoint(path: Path, trainer: Trainer) -> None:
    import io

    buffer = io.BytesIO()
    torch.save(trainer.state(), buffer)
    replace_file(path, [buffer.getbuffer()])


def load_checkpoint(path: Path, trainer: Trainer) -> None:
    """Raises `TrainingError`, naming the file."""
    try:
        state = torch.load(path, weights_only=True)
        trainer.restore(state)
    except TrainingError as error:
        raise TrainingError(f"{path}: {error}") from error
    except Exception as error:  # what a damaged pickle raises has no common type
        raise TrainingError(f"{path}: cannot be read: {error}") from error


def _error(
    distance: Tensor, occupied: Tensor, right_distance: Tensor, right_occupied: Tensor, seen: Tensor, weight: float
) -> Tensor:
    """NeuralRecon's: cross entropy of the occupancy, L1 of the distance's logarithm; empty space does not drown it."""
    counts = seen >= VIEWS_SEEN
    if not counts.any():
        return distance.sum() * 0
    right = right_occupied[counts].float()
    entropy = functional.binary_cross_entropy_with_logits(occupied[counts], right)
    difference = (_logarithm(distance[counts]) - _logarithm(right_distance[counts])).abs()
    near = (difference * right).sum() / right.sum().clamp_min(1)
    far = (difference * (1 - right)).sum() / (1 - right).sum().clamp_min(1)
    return entropy + weight * (near + 0.5 * far)


def _logarithm(distance: Tensor) -> Tensor:
    return distance.sign() * torch.log1p(distance.abs())


def _quality(
    distance: Tensor, occupied: Tensor, right_distance: Tensor, right_occupied: Tensor, seen: Tensor
) -> tuple[float, float]:
    counts = seen >= VIEWS_SEEN
    near = counts & right_occupied
    found = (occupied > 0) & counts
    error = (distance - right_distance)[near].abs().mean() if near.any() else torch.tensor(0.0)
    both = float((found & right_occupied).sum())
    total = float(found.sum() + near.sum())
    return float(error) * REACH_M * 1000, 2 * both / total if total else 0.0


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan
