"""The slow half of the recorder: entries to bytes, to a file and to whoever watches. Used by one thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import foxglove
from foxglove.websocket import WebSocketServer

from ground_station.mesh_files import ply
from ground_station.reconstruction.reconstructor import Mesh
from ground_station.recording.channels import Channels, Kind, channels_of
from ground_station.recording.file import ChunkWriter, RecordingFile
from protocol.errors import StorageError
from protocol.mission import Mission

log = logging.getLogger(__name__)

HOST: Final = "127.0.0.1"
"""The live server checks neither who asks nor from where: nobody else's computer may."""
MESH_ATTACHMENT: Final = "mesh.ply"
LOSSES_METADATA: Final = "covrecon.losses"


class RecordingWriter:
    def __init__(self, path: Path | None, mission: Mission, foxglove_port: int | None) -> None:
        """Create the file ``path``, None for none, and listen at ``foxglove_port``: 0 for any free one, None for none.

        Raises:
            StorageError: the file cannot be made.
        """
        import trimesh  # noqa: F401  # the first map would wait for it, and the flight with it

        self._path = path
        try:
            self._file = RecordingFile(path) if path is not None else None
            self._mcap = ChunkWriter(self._file) if self._file is not None else None
            if self._mcap is not None:
                self._mcap.start()
        except OSError as error:
            raise StorageError(f"{path}: {error.strerror}") from error
        context = foxglove.Context()
        self._server = _serve(context, foxglove_port)
        self._channels = Channels(mission, self._mcap, context if self._server is not None else None)
        self.written = dict.fromkeys(self._channels.names, 0)
        """Messages of each channel that went out."""
        self.lost = dict.fromkeys(self._channels.names, 0)
        """Messages of each channel that came after the recording's end."""
        self.failed = ""
        """Why the recording ended before the flight."""

    @property
    def listens(self) -> bool:
        """Whether anything comes of what is written."""
        return self._file is not None or self._server is not None

    @property
    def size_bytes(self) -> int:
        return self._file.size if self._file is not None else 0

    @property
    def foxglove_port(self) -> int | None:
        return self._server.port if self._server is not None else None

    def write(self, kind: Kind, drone: int, content: object, time_ns: int) -> None:
        """``drone``: 0 for kinds that belong to none."""
        self._guarded(lambda: self._channels.write(kind, content, time_ns))
        counts = self.lost if self.failed else self.written
        for name in channels_of(kind, drone):
            counts[name] += 1

    def flush(self) -> None:
        """Give the system all that was written: it outlives this process."""
        if self._mcap is not None:
            self._guarded(self._mcap.flush)

    def complete(self, mesh: Mesh | None, time_ns: int, losses: Mapping[str, int]) -> None:
        """Attach the last map, and note how many messages each channel lacks; then close."""
        mcap = self._mcap
        if mcap is not None:
            self._guarded(lambda: _end(mcap, mesh, time_ns, losses))
        if self._file is not None:
            self._file.close()
        if self._server is not None:
            self._server.stop()

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do ``work`` unless something failed before; the flight goes on whatever comes of it."""
        if self.failed:
            return
        try:
            work()
        except OSError as error:
            self.failed = f"{self._path}: {error.strerror}"
            log.error("%s; the flight goes on unrecorded", self.failed)  # noqa: TRY400  # the disk's fault, not ours
        except Exception:
            self.failed = "internal error"
            log.exception("the recording has failed; the flight goes on unrecorded")


def _end(mcap: ChunkWriter, mesh: Mesh | None, time_ns: int, losses: Mapping[str, int]) -> None:
    if mesh is not None:
        content = ply(mesh.vertices, mesh.faces, mesh.colors)
        mcap.flush()
        mcap.add_attachment(time_ns, time_ns, MESH_ATTACHMENT, "model/ply", content)
    mcap.flush()
    mcap.add_metadata(LOSSES_METADATA, {name: str(count) for name, count in losses.items() if count})
    mcap.finish()  # type: ignore[no-untyped-call]  # the library leaves it so


def _serve(context: foxglove.Context, port: int | None) -> WebSocketServer | None:
    if port is None:
        return None
    try:
        server = foxglove.start_server(name="covrecon", host=HOST, port=port, context=context)
    except RuntimeError as error:
        log.warning("Foxglove cannot watch at port %d: %s", port, error)
        return None
    log.info("Foxglove may watch at ws://%s:%d", HOST, server.port)
    return server
