"""Every error a caller may want to catch, in one tree.

    CovreconError
    |-- MissionError        a mission file or value that cannot be flown; carries every fault found
    |-- SceneError          a scene that is missing, unreadable or empty
    |-- MessageError        bytes from another process that are refused
    |   `-- VersionError    ... because they speak another major version
    |-- BusError            the transport could not be opened, or is closed
    |   `-- NoReply         a query that nobody answered in time
    |-- CredentialsError    a certificate or key that is missing, unsafe, foreign, expired or revoked
    |-- JournalError        a journal that cannot be written or read back
    |   `-- JournalDamaged  ... because what it holds is not what was written
    |-- StorageError        another file of the run that the disk refuses
    |-- RecordingError      a recording that cannot be read, or that lacks what is asked of it
    |-- ExportError         a run that lacks what is to be exported, or a place that cannot take it
    |-- CommandError        an operator's command that was refused, or that not everybody has acknowledged
    |-- VehicleError        a vehicle that cannot be connected, is not fit to fly, or refuses what it is told
    |-- ReconstructionError input that the reconstructor cannot work with
    |-- TrainingError       settings, rooms or weights of the learned reconstructor that do not fit
    `-- ProcessError        a process of the run that failed

Errors of zenoh, MAVSDK, OSQP, Open3D and the like are mapped to these at the edge where they arise. Outcomes of the
quadratic program are values, not errors (`agents.quadratic_program`).
"""

from __future__ import annotations

from collections.abc import Sequence


class CovreconError(Exception):
    """Root of all errors raised on purpose."""


class MissionError(CovreconError):
    """``faults`` holds one line for each thing wrong, as ``file:line: key: what is wrong``."""

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = tuple(faults)


class SceneError(CovreconError):
    pass


class MessageError(CovreconError):
    pass


class VersionError(MessageError):
    pass


class BusError(CovreconError):
    pass


class NoReply(BusError):
    pass


class CredentialsError(CovreconError):
    """A certificate or key that is missing, unsafe, foreign, expired or revoked."""


class JournalError(CovreconError):
    pass


class JournalDamaged(JournalError):
    pass


class StorageError(CovreconError):
    pass


class RecordingError(CovreconError):
    pass


class ExportError(CovreconError):
    pass


class CommandError(CovreconError):
    pass


class VehicleError(CovreconError):
    """A vehicle that cannot be connected, is not fit to fly, or refuses what it is told."""


class ReconstructionError(CovreconError):
    pass


class TrainingError(CovreconError):
    pass


class ProcessError(CovreconError):
    pass
