"""Folders that exports are written into: never over something that the user did not mean to lose."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ground_station.export.georeference import Georeference
from protocol.errors import CovreconError, StorageError

GEOREFERENCE_FILE = "georeference.json"


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export came to."""

    folder: Path
    content: str
    """What was written, in words."""
    notes: tuple[str, ...] = ()
    """What the user should know of it."""


@contextmanager
def output_folder(folder: Path, *, force: bool) -> Iterator[Path]:
    """An empty folder to write into, made if need be. With ``force`` it may hold something: what has the same name as
    a new file is replaced, and nothing else is touched.

    Raises:
        CovreconError: it is not empty, or not a folder.
        StorageError: the disk refuses something inside the block.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not force and any(folder.iterdir()):
            raise CovreconError(f"{folder}: is not empty; give another one with --out, or --force to write into it")
        yield folder
    except FileExistsError as error:
        raise CovreconError(f"{folder}: is a file") from error
    except OSError as error:
        raise StorageError(f"{error.filename or folder}: {error.strerror}") from error


def write_georeference(folder: Path, georeference: Georeference | None) -> None:
    """georeference.json, if there is something to say. Raises OSError."""
    if georeference is not None:
        text = json.dumps(georeference.as_json(), indent=2) + "\n"
        (folder / GEOREFERENCE_FILE).write_text(text, encoding="utf-8")
