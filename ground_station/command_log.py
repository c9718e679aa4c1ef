"""Commands on disk before anybody obeys them: a ground station that is started again knows what was commanded."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path
from typing import Self

from ground_station.commands import Command
from ground_station.durable import DiskFaults
from ground_station.record_file import GrowingFile, lay_out, record
from protocol.errors import StorageError

log = logging.getLogger(__name__)

COMMANDS_FILE = "commands"


class CommandLog:
    """One JSON record for each command."""

    def __init__(self, path: Path) -> None:
        """Open or create; damage is told and left where it is.

        Raises:
            StorageError: it cannot be opened.
        """
        self._faults = DiskFaults(str(path))
        self.earlier: list[Command] = []
        """What it held, oldest first."""
        try:
            self._file = GrowingFile(path)
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from error
        with self._file.contents() as data:
            layout = lay_out(data)
            contents = [data[span.first : span.last] for span in layout.contents]
        self._file.end = layout.end
        for damaged in layout.damaged:
            log.error("%s: damaged from byte %d to %d: commands are lost", path, damaged.first, damaged.last)
        for content in contents:
            try:
                fields = json.loads(content)
                self.earlier.append(Command(**{**fields, "drones": tuple(fields["drones"])}))
            except (ValueError, TypeError, KeyError) as error:
                log.error("%s: a command cannot be read: %s", path, error)  # noqa: TRY400  # the file is wrong

    @property
    def unwritten(self) -> int:
        """Commands that the disk refused."""
        return self._faults.count

    def append(self, command: Command) -> bool:
        """Put it on disk; False if the disk refuses."""
        try:
            self._file.append(record(json.dumps(asdict(command)).encode()), synced=True)
        except OSError as error:
            self._faults.refused(error)
            return False
        self._faults.took()
        return True

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
