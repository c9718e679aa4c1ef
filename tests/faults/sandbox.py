"""A command under the filter of system calls that a systemd unit asks for, without systemd: what the unit forbids fails
here in the same way. ``python -m faults.sandbox UNIT COMMAND ...``
"""

from __future__ import annotations

import ctypes
import ctypes.util
import errno
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ALLOW, FAIL = 0x7FFF0000, 0x00050000 | errno.EPERM
"""SCMP_ACT_ALLOW, and SCMP_ACT_ERRNO of what SystemCallErrorNumber= names."""
EQUAL = 4
"""SCMP_CMP_EQ."""


class _Comparison(ctypes.Structure):
    """``struct scmp_arg_cmp``."""

    _fields_ = (("arg", ctypes.c_uint), ("op", ctypes.c_int), ("a", ctypes.c_uint64), ("b", ctypes.c_uint64))


def settings_of(unit: Path, name: str) -> list[str]:
    """Every value of a setting, in order."""
    return re.findall(rf"^{name}=(.*)$", unit.read_text(), re.MULTILINE)


def calls_of(unit: Path) -> set[str]:
    """System calls that a unit leaves to its process."""
    calls: set[str] = set()
    for value in settings_of(unit, "SystemCallFilter"):
        named = {call for group in value.removeprefix("~").split() for call in _expand(group)}
        calls = calls - named if value.startswith("~") else calls | named
    return calls


def _expand(group: str) -> Iterator[str]:
    if not group.startswith("@"):
        yield group
        return
    command = [shutil.which("systemd-analyze") or "systemd-analyze", "syscall-filter", group]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    for line in told.stdout.splitlines()[1:]:
        name = line.strip()
        if name and not name.startswith("#"):
            yield from _expand(name)


def families_of(unit: Path) -> list[int]:
    (families,) = settings_of(unit, "RestrictAddressFamilies")
    return [int(getattr(socket, family)) for family in families.split()]


def confine(unit: Path) -> None:
    """From here on this process and all that it starts make no other calls."""
    library = ctypes.CDLL(ctypes.util.find_library("seccomp") or "libseccomp.so.2")
    library.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.seccomp_init(FAIL))
    for call in calls_of(unit):
        number = library.seccomp_syscall_resolve_name(call.encode())
        if number < 0:
            continue  # of another processor
        if call == "socket":
            for family in families_of(unit):
                allowed = _Comparison(0, EQUAL, family, 0)
                _require(library.seccomp_rule_add_array(context, ALLOW, number, 1, ctypes.byref(allowed)))
        else:
            _require(library.seccomp_rule_add_array(context, ALLOW, number, 0, None))
    _require(library.seccomp_load(context))


def _require(result: int) -> None:
    if result != 0:
        raise OSError(-result, os.strerror(-result))


if __name__ == "__main__":
    confine(Path(sys.argv[1]))
    os.execvp(sys.argv[2], sys.argv[2:])  # noqa: S606  # the arguments are the caller's own
