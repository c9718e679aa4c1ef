"""The MAVLink dialect PX4 speaks, in one place: pymavlink has no types, so all that it gives is `Any`."""

from __future__ import annotations

from typing import Any, TypeAlias

from pymavlink.dialects.v20 import common

mavlink: Any = common
Packet: TypeAlias = Any
"""A MAVLink message of pymavlink; its fields are attributes."""
