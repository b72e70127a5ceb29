"""Pickle files of data sets that contain numpy arrays. Nothing else is loaded from them, and no code is run."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

from masiv.errors import InputError
from masiv.files import require_file
from masiv.strict import shortened

_MODULES = ("multiarray", "numeric")
ALLOWED = frozenset(
    {
        ("numpy", "ndarray"),
        ("numpy", "dtype"),
        ("_codecs", "encode"),
        *((f"numpy.{core}.{module}", name)
          for core in ("core", "_core")
          for module in _MODULES
          for name in ("_reconstruct", "_frombuffer", "scalar")),
    }
)  # fmt: skip
"""What an array is made of, in all versions of numpy and of the protocol. None of them runs code of the file."""


class _Arrays(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"it contains {module}.{name}, only numpy arrays are read")
        return super().find_class(module, name)


def load_arrays(path: Path) -> Any:
    """The lists, dictionaries, numbers and numpy arrays in ``path``. Raises InputError for anything else in it."""
    try:
        with require_file(path).open("rb") as file:
            return _Arrays(file).load()
    except InputError:
        raise
    except Exception as error:  # a pickle of something else, or a damaged one, raises what it likes
        raise InputError(f"{path} is not a pickle file of numpy arrays ({shortened(error)})") from error
