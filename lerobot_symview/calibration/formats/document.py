"""Calibration files as documents: text, and what YAML, JSON or NumPy read in them."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_symview.errors import CalibrationError

LARGEST = 16 * 2**20  # bytes; a calibration has a few kilobytes
FILE_STORAGE = ("%YAML:1.0", "opencv-matrix", "<opencv_storage>")  # marks of OpenCV's FileStorage


@dataclass(frozen=True)
class Document:
    """A file's text, empty for NumPy files, and its content as plain mappings, lists and scalars."""

    text: str = ""
    content: Any = None
    problem: str = ""
    """Why the text is neither YAML nor JSON; empty if it is."""

    def entries(self) -> dict[str, Any]:
        """Return the content if it is a mapping, without the wrapping of a ROS 2 parameter file; else nothing."""
        content = self.content
        while isinstance(content, dict) and len(content) == 1:
            (value,) = content.values()
            if "ros__parameters" not in content and not (isinstance(value, dict) and "ros__parameters" in value):
                break
            content = value
        return {str(key): value for key, value in content.items()} if isinstance(content, dict) else {}

    def cameras(self, has: Callable[[Mapping[str, Any]], bool]) -> dict[str, Mapping[str, Any]]:
        """Return name -> entries of the cameras for which `has` is true; the empty name for entries at the top."""
        entries = self.entries()
        if has(entries):
            return {"": entries}
        return {name: value for name, value in entries.items() if isinstance(value, Mapping) and has(value)}


def read_document(file: Path | str) -> Document:
    """Return the content of a calibration file of any format.

    Raises:
        CalibrationError: if the file cannot be read.
    """
    try:
        with Path(file).open("rb") as stream:
            data = stream.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise CalibrationError(f"has more than {LARGEST >> 20} MB, expected a calibration")
        if data.startswith((b"\x93NUMPY", b"PK\x03\x04")):
            return Document(content=_arrays(data))
        return parse_text(data.decode())
    except CalibrationError as error:
        raise CalibrationError(f"{file} {error}") from None
    except (OSError, ValueError) as error:
        raise CalibrationError(f"cannot read {file}: {error}") from None


def parse_text(text: str) -> Document:
    """Return the document with the content of JSON or YAML; without content if the text is neither.

    Raises:
        CalibrationError: if YAML has an alias.
    """
    import yaml

    if any(mark in text for mark in FILE_STORAGE):
        return Document(text)
    try:
        if text.lstrip().startswith(("{", "[")):  # YAML 1.1 reads JSON's 1e-5 as a string
            return Document(text, json.loads(text))
    except RecursionError:
        return Document(text, problem="it is nested too deeply")
    except ValueError:
        pass
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise CalibrationError("has an alias (*name): write out the value it refers to")
        return Document(text, yaml.safe_load(text))
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        if isinstance(error, CalibrationError):
            raise
        return Document(text, problem=str(error) or type(error).__name__)


def _arrays(data: bytes) -> Any:
    """Return the array of a .npy file as lists, or name -> array of a .npz file.

    Raises:
        ValueError: if the file is malformed.
    """
    try:
        if data.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                if sum(member.file_size for member in archive.infolist()) > LARGEST:
                    raise CalibrationError(f"has more than {LARGEST >> 20} MB, expected a calibration")
        loaded = np.load(io.BytesIO(data))
        if isinstance(loaded, np.ndarray):
            return loaded.tolist()
        return {name: loaded[name].tolist() for name in loaded.files}
    except (EOFError, MemoryError, zlib.error, zipfile.BadZipFile) as error:
        raise ValueError(str(error)) from None
    except RuntimeError as error:  # zipfile's for an encrypted archive and for a compression that Python lacks
        raise ValueError(f"{error}: save it with np.savez") from None
