"""The file under a recording. What it has taken is with the system: it outlives the process."""

from __future__ import annotations

from io import FileIO
from pathlib import Path
from typing import Final

from mcap.writer import Writer

CHUNK_BYTES: Final = 2**16
"""What is lost at once when a file is damaged; smaller chunks make it longer."""


class RecordingFile:
    """Unbuffered binary file of which a write takes everything."""

    def __init__(self, path: Path) -> None:
        """Create; raises OSError, also when there is one of this name."""
        self._file = FileIO(path, "x")
        self.size = 0
        """Bytes that were taken."""

    def write(self, content: bytes) -> int:
        rest = memoryview(content)
        while rest:
            rest = rest[self._file.write(rest) :]
        self.size += len(content)
        return len(content)

    def tell(self) -> int:
        return self.size

    def close(self) -> None:
        self._file.close()


class ChunkWriter(Writer):
    """The MCAP project's writer, whose compression lets other threads run: that of Foxglove's library holds them up
    for as long as it compresses a map, a tenth of a second."""

    def __init__(self, file: RecordingFile) -> None:
        super().__init__(file, chunk_size=CHUNK_BYTES)  # type: ignore[arg-type]  # it writes and tells, no more

    def flush(self) -> None:
        """End the chunk that is open."""
        self._Writer__finalize_chunk()  # type: ignore[attr-defined]  # the library has no other way
