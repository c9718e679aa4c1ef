"""Whether this computer's clock is synchronised, as the kernel says.

Mission time is counted in ticks and needs no clock; the times of logs and recordings of several computers do.
"""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass

from deploy.doctor.finding import Finding

STATUS_UNSYNCHRONISED, STATUS_NANOSECONDS = 0x0040, 0x2000
"""STA_UNSYNC and STA_NANO of <sys/timex.h>."""
ERROR_MAX_S = 0.1
"""Between the log lines of two computers, a tenth of a second still shows what came first."""


class _Timex(ctypes.Structure):
    """``struct timex`` of Linux on 64 bits."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("constant", ctypes.c_long),
        ("precision", ctypes.c_long),
        ("tolerance", ctypes.c_long),
        ("seconds", ctypes.c_long),
        ("fraction", ctypes.c_long),
        ("tick", ctypes.c_long),
        ("pulse", ctypes.c_long * 3),
        ("shift", ctypes.c_int),
        ("counts", ctypes.c_long * 5),
        ("tai", ctypes.c_int),
        ("reserved", ctypes.c_int * 11),
    )


@dataclass(frozen=True, slots=True)
class ClockState:
    synchronised: bool
    offset_s: float
    """What the kernel is still correcting."""
    error_max_s: float
    """How far off it may be."""
    time_s: float
    """What the clock shows, seconds since 1970 UTC."""


def read_clock() -> ClockState:
    """Ask the kernel, changing nothing. Raises `OSError` where it may not be asked."""
    state = _Timex(modes=0)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.adjtimex(ctypes.byref(state)) < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    unit_s = 1e-9 if state.status & STATUS_NANOSECONDS else 1e-6
    return ClockState(
        synchronised=not state.status & STATUS_UNSYNCHRONISED,
        offset_s=state.offset * unit_s,
        error_max_s=state.maxerror * 1e-6,
        time_s=state.seconds + state.fraction * unit_s,
    )


def check_clock(state: ClockState | OSError) -> Finding:
    """``state``: or why it is not known."""
    advice = "run: sudo timedatectl set-ntp true (or install chrony); a single computer flies without"
    if isinstance(state, OSError):
        return Finding("clock", "warn", f"the kernel does not say ({state.strerror})", advice)
    if not state.synchronised:
        return Finding("clock", "warn", "not synchronised: times in logs and recordings will not compare", advice)
    text = f"synchronised, off by {state.offset_s * 1e3:+.3f} ms, at most {state.error_max_s * 1e3:.0f} ms"
    if max(abs(state.offset_s), state.error_max_s) > ERROR_MAX_S:
        return Finding("clock", "warn", text, "wait until it has settled, or choose a nearer time server")
    return Finding("clock", "ok", text)
