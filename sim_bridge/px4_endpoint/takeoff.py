"""The ground: how a vehicle leaves it after arming, and when it counts as landed."""

from __future__ import annotations

from sim_bridge.px4_endpoint.body import GRAVITY_MPS2
from sim_bridge.px4_endpoint.parameters import Parameters

CLIMB_MPS = 0.05
"""A slower wanted climb does not lift off."""
LANDED_S = 1.0
"""How long a vehicle presses on the ground until it counts as landed (LNDMC_TRIG_TIME)."""


class Ground:
    """``landed`` and ``airborne`` (the motors carry it, or try to), and the limit of the climb meanwhile."""

    def __init__(self, parameters: Parameters, spool_up_s: float) -> None:
        self._parameters = parameters
        self._spool_up_s = spool_up_s
        self.landed = True
        self.airborne = False
        self._lift_off_s = 0.0
        self._pressing_s = 0.0

    def step(self, now_s: float, dt: float, *, armed_s: float | None, on_ground: bool, wanted_down: float) -> float:
        """Largest climb rate now, m/s; ``armed_s`` is None while disarmed, ``wanted_down`` in m/s."""
        if armed_s is None:
            self.airborne = False
            self.landed = on_ground
            return 0.0
        if not self.airborne:
            if now_s - armed_s < self._spool_up_s or wanted_down > -CLIMB_MPS:
                return 0.0
            self.airborne, self._lift_off_s, self._pressing_s = True, now_s, 0.0
        if not on_ground:
            self.landed = False
        self._pressing_s = self._pressing_s + dt if on_ground and wanted_down > 0 else 0.0
        if self._pressing_s > LANDED_S:
            self.landed, self.airborne = True, False
        return self._ramp(now_s, -wanted_down)

    def _ramp(self, now_s: float, climb: float) -> float:
        """PX4's take-off ramp: from what gravity alone gives to the wanted climb within MPC_TKO_RAMP_T; only its part
        above zero lifts, and starts when the spool-up ends here."""
        ramp_s = self._parameters["MPC_TKO_RAMP_T"]
        if ramp_s <= 0:
            return max(climb, 0.0)
        slope = (max(climb, 0.0) + GRAVITY_MPS2 / self._parameters["MPC_Z_VEL_P_ACC"]) / ramp_s
        return slope * (now_s - self._lift_off_s)
