"""Random missions with random faults, each from one seed."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Literal, TypeAlias

from protocol.map_settings import Feedback, Reconstruction
from protocol.mission import Controller, Drone, Flight, Mission, Replication, Simulation, Target
from protocol.transport_settings import Transport

FAULTY_S = 36.0
"""All faults have ended by then ..."""
FLIGHT_S = 62.0
"""... and at this time all must be well."""
TELLING_S = 5.0
"""So much longer the mission lasts, in which all is compared."""
FIRST_S = 2.0
"""Begin of the first fault: everybody has started."""
LONGEST_S = 15.0
"""Of one fault."""

Kind: TypeAlias = Literal[
    "loss",
    "delay",
    "reorder",
    "duplicate",
    "garble",
    "narrow",
    "black hole",
    "reset",
    "freeze",
    "kill",
    "kill at jump",
    "late join",
    "skew",
    "noise",
    "disk full",
]
LINK: tuple[Kind, ...] = ("loss", "delay", "reorder", "duplicate", "garble", "narrow")
"""What may come over anybody's links, several at once."""
LIFE: tuple[Kind, ...] = ("black hole", "freeze", "kill", "reset")
"""What befalls one process at a time."""
SIMULATOR_S = 1.0
"""The simulator is cut off or frozen for less than a lease: the vehicles it carries would be gone otherwise."""
SKEWS = (1, 2, 3, 5, 60)
"""Ticks that a drone's clock is ahead; with the last one nobody believes it."""

SLOTS = ((-1.5, -1.5), (1.5, -1.5), (-1.5, 1.5), (1.5, 1.5), (0.0, 0.0))
"""Where drones start, x and y in metres."""


@dataclass(frozen=True, slots=True)
class Event:
    """One fault from ``begin_s`` to ``end_s``; what ``strength`` means depends on its kind."""

    begin_s: float
    end_s: float
    kind: Kind
    role: str
    strength: float = 0.0

    def __str__(self) -> str:
        strength = f" {self.strength:.3g}" if self.strength else ""
        return f"{self.begin_s:.2f}-{self.end_s:.2f} s {self.role} {self.kind}{strength}"

    def overlaps(self, other: Event) -> bool:
        return self.begin_s < other.end_s and other.begin_s < self.end_s


@dataclass(frozen=True, slots=True)
class Schedule:
    seed: int
    mission: Mission
    events: tuple[Event, ...]

    def __str__(self) -> str:
        drones = ", ".join(str(drone.id) for drone in self.mission.drones)
        states = "" if self.mission.transport.aggregate_above else ", states gathered"
        return "\n  ".join([f"seed {self.seed}, drones {drones}{states}", *map(str, self.events)])


def schedule(seed: int) -> Schedule:
    """The same seed, the same schedule."""
    dice = random.Random(seed)
    ids = sorted(dice.sample(range(2, 256), dice.randint(1, 5)))
    drones = [f"drone/{number}" for number in ids]
    events = _Events()
    if len(ids) > 1 and dice.random() < 0.3:  # without any drone no flight begins
        events.add(Event(0.0, dice.uniform(FIRST_S, FAULTY_S), "late join", dice.choice(drones)))
    if dice.random() < 0.3:
        events.add(_window(dice, LONGEST_S, "kill at jump", "ground"))
    if dice.random() < 0.3:
        events.add(_window(dice, LONGEST_S, "skew", dice.choice(drones), dice.choice(SKEWS)))
    if dice.random() < 0.3:
        events.add(_window(dice, LONGEST_S, "noise", "stranger"))
    if dice.random() < 0.3:
        events.add(_window(dice, LONGEST_S, "disk full", "the disk"))
    for _ in range(dice.randint(2, 6)):
        role = dice.choice([*drones, "ground", "ground", "sim"])
        if role == "sim":
            events.add(_window(dice, SIMULATOR_S, dice.choice(("black hole", "freeze")), role))
        else:
            events.add(_window(dice, LONGEST_S, dice.choice(LIFE), role))
    for _ in range(dice.randint(3, 8)):
        role = dice.choice([*drones, *drones, "ground", "sim"])
        kind = dice.choice(LINK)
        events.add(_window(dice, LONGEST_S, kind, role, _strength(dice, kind)))
    return Schedule(seed, _mission(dice, seed, ids), tuple(sorted(events.chosen, key=lambda event: event.begin_s)))


class _Events:
    """Those that can happen together."""

    def __init__(self) -> None:
        self.chosen: list[Event] = []

    def add(self, event: Event) -> None:
        if not any(self._exclude(event, other) for other in self.chosen):
            self.chosen.append(event)

    def _exclude(self, one: Event, other: Event) -> bool:
        """One process bears one fault of each kind at a time, and nothing while it is dead, cut off or frozen."""
        if one.role != other.role or not one.overlaps(other):
            return False
        return one.kind == other.kind or not (one.kind in LINK and other.kind in LINK)


def _window(dice: random.Random, longest_s: float, kind: Kind, role: str, strength: float = 0.0) -> Event:
    lasts_s = dice.uniform(0.1, 1.0) * longest_s
    begin_s = dice.uniform(FIRST_S, FAULTY_S - lasts_s)
    return Event(begin_s, begin_s + lasts_s, kind, role, strength)


def _strength(dice: random.Random, kind: Kind) -> float:
    """A probability, or seconds, or bytes a second."""
    match kind:
        case "loss" | "duplicate":
            return dice.uniform(0.02, 0.3)
        case "garble":
            return dice.uniform(0.02, 0.2)
        case "delay" | "reorder":
            return dice.uniform(0.02, 0.3)
        case "narrow":  # of the about 10 kB/s that a drone says, and 50 kB/s that it hears
            return dice.uniform(4e3, 4e4)
        case _:
            return 0.0


def _mission(dice: random.Random, seed: int, ids: list[int]) -> Mission:
    """A small and coarse field, so that a minute's flight costs seconds, in which quick drones are close to each other;
    its top layer lies above all of them."""
    slots = dice.sample(SLOTS, len(ids))
    return Mission(
        name="faults",
        seed=seed,
        duration_s=FLIGHT_S + TELLING_S,
        target=Target(lower_m=(-2.0, -2.0, 0.0), upper_m=(2.0, 2.0, 2.0), cell_m=0.5, cell_rad=0.6),
        flight=Flight(
            lower_m=(-2.5, -2.5, 0.5),
            upper_m=(2.5, 2.5, 1.7),
            speed_max_mps=1.0,
            turn_rate_max_radps=1.0,
            acceleration_max_mps2=8.0,
        ),
        controller=Controller(),
        feedback=Feedback(threshold=1.0),
        reconstruction=Reconstruction(backend="none"),
        replication=Replication(checkpoint_period_s=5.0, journal_limit_mb=0.01),  # of some ten jumps
        simulation=Simulation(scene="", start_patience_s=1.0),
        drones=tuple(
            Drone(id=number, start=(*slot, 1.2, dice.uniform(-3.0, 3.0), 1.3))
            for number, slot in zip(ids, slots, strict=True)
        ),
        transport=Transport(aggregate_above=dice.choice((0, 8))),  # gathered states, or each drone's own
    )
