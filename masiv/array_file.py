"""Arrays that are kept in a file until they are needed, so that long recordings do not fill the memory."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass

import numpy as np

from masiv.errors import MasivError


@dataclass(frozen=True)
class StoredArray:
    """Where an array is in an ``ArrayFile``: offset [bytes], shape, type."""

    offset: int
    shape: tuple[int, ...]
    dtype: np.dtype


class ArrayFile:
    """Arrays in a temporary file without a name: the system removes it when the process ends, also if it is killed.

    The system keeps what is read often in memory that it can take back.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="masiv")

    def append(self, array: np.ndarray) -> StoredArray:
        """Write ``array``. Raises MasivError if there is no space."""
        try:
            offset = self._file.seek(0, 2)
            self._file.write(np.ascontiguousarray(array).data)
            self._file.flush()
        except OSError as error:
            raise MasivError(
                f"cannot write a temporary file in {tempfile.gettempdir()} ({error.strerror}): set TMPDIR to a folder "
                "with space"
            ) from error
        return StoredArray(offset, array.shape, array.dtype)

    def read(self, stored: StoredArray) -> np.ndarray:
        """The array, as it was written; a copy in memory. Raises MasivError if the file cannot be read."""
        array = np.empty(stored.shape, stored.dtype)
        try:
            self._file.seek(stored.offset)
            count = self._file.readinto(array.reshape(-1).view(np.uint8).data)  # type: ignore[attr-defined]
        except OSError as error:
            raise MasivError(f"cannot read a temporary file in {tempfile.gettempdir()}: {error.strerror}") from error
        if count != array.nbytes:
            raise MasivError(f"a temporary file in {tempfile.gettempdir()} is shorter than what was written")
        return array
