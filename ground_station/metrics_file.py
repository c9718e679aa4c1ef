"""The metrics of a run as CSV: every row can be read at once, and after a crash the file goes on where it was."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from ground_station.durable import DiskFaults
from ground_station.record_file import GrowingFile


class MetricsFile:
    """Rows that the disk refuses are kept and written with the next."""

    def __init__(self, path: Path, columns: Sequence[str], faults: DiskFaults) -> None:
        """Open or create; a row that a crash tore is written over.

        Raises:
            ValueError: it holds something else.
            OSError: the disk refuses it.
        """
        self._columns, self._faults = columns, faults
        self._file = GrowingFile(path)
        with self._file.contents() as data:
            found = data[:]
        header = _line(columns)
        if not (found.startswith(header) or header.startswith(found)):
            self._file.close()
            raise ValueError("does not begin with the columns that belong there")
        self._file.end = found.rfind(b"\n") + 1
        self._found = found[len(header) : self._file.end]
        self._pending = b"" if self._file.end else header
        try:
            self.flush()
        except OSError:
            self._file.close()
            raise

    def rows(self) -> list[dict[str, float]]:
        """What it held when it was opened, without empty cells; rows that cannot be read are left out."""
        rows = []
        for cells in csv.reader(self._found.decode(errors="replace").splitlines()):
            try:
                rows.append({name: float(cell) for name, cell in zip(self._columns, cells, strict=True) if cell})
            except ValueError:
                continue
        return rows

    def append(self, row: Sequence[object]) -> None:
        self._pending += _line(row)
        try:
            self.flush()
        except OSError as error:
            self._faults.refused(error)
        else:
            self._faults.took()

    def flush(self) -> None:
        """Write what the disk refused so far. Raises OSError."""
        if self._pending:
            self._file.append(self._pending)
            self._pending = b""

    def close(self) -> None:
        self._file.close()


def _line(cells: Sequence[object]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue().encode()
