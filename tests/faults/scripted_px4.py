"""What telemetry says of a PX4 vehicle, told step by step to the logic that follows it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from agents.vehicles.px4.authority import AuthorityLogic, Observation, Step

GROUND = Observation("HOLD", 0.0, armed=False, on_ground=True, height_m=0.0, heard_s=0.0)
AIR = replace(GROUND, armed=True, on_ground=False, height_m=1.5)


@dataclass
class Flight:
    """A logic with a clock of its own, told every tenth of a second what telemetry says."""

    logic: AuthorityLogic = field(default_factory=lambda: AuthorityLogic(1.5, 3.0))
    now_s: float = 100.0
    seen: Observation = GROUND

    def see(
        self, seconds: float = 0.1, *, answers: bool = True, sends: bool = False, silent: bool = False, **change: object
    ) -> list[Step]:
        """For so long; the commands that were given. ``answers``: each is acknowledged at once."""
        self.seen = replace(self.seen, **change)  # type: ignore[arg-type]
        given: list[Step] = []
        for _ in range(max(1, round(seconds / 0.1))):
            self.now_s += 0.1
            if not silent:
                self.seen = replace(self.seen, heard_s=self.now_s - 0.01, mode_at_s=self.now_s - 0.01)
            step = self.logic.observe(self.seen, self.now_s)
            if step != "wait":
                given.append(step)
                if answers:
                    self.logic.answered(step, self.now_s)
            if sends:
                self.logic.sent(self.now_s)
        return given

    @property
    def authority(self) -> str:
        return self.logic.authority


def on_ground() -> Flight:
    """Ready to take off."""
    flight = Flight()
    flight.see()
    return flight


def in_our_hands() -> Flight:
    """In the air, with a control task that sends."""
    flight = Flight(seen=AIR)
    flight.see()
    flight.logic.take_off(flight.now_s)
    flight.see(1.0)
    flight.see(mode="OFFBOARD")
    assert flight.authority == "ours"
    flight.see(10.0, sends=True)
    return flight
