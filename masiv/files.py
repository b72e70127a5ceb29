"""Files that are written completely or not at all: under a temporary name in the same folder, which is then renamed.

A writer that fails leaves the target as it was and no temporary file. All functions that write create missing folders.
Readers raise InputError for whatever is not what the writer wrote.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.errors import InputError

if TYPE_CHECKING:
    import torch

DIGEST = "masiv_sha256"
"""Key of the digest in the metadata of a safetensors file, which has no check sum of its own."""


def require_file(path: Path) -> Path:
    """``path``. Raises InputError if it is missing, or no regular file: reading a pipe or a device may never end."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "is not a regular file" if path.exists() else "is missing"
        raise InputError(f"{path} {what}: give the path of a file")
    return path


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary name to write to, with the suffix of ``path``. It becomes ``path`` when the block ends without error.

    Example:
        with atomic(folder / "plot.png") as temporary:
            figure.savefig(temporary)
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        _remove(temporary)
        if isinstance(error, OSError):
            error.filename = str(path)  # not the temporary name, or none at all
        raise


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A temporary folder to write to. It becomes ``path`` when the block ends without error. Raises InputError if
    ``path`` exists and is no empty folder."""
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path} exists already: give another folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        yield temporary
        if path.exists():
            path.rmdir()
        os.replace(temporary, path)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise


def remove_temporary(folder: Path) -> None:
    """Delete what ``atomic`` and ``atomic_folder`` left in ``folder`` and below when their process was killed."""
    for path in list(folder.rglob("*.tmp*")):
        if re.search(r"\.\d+\.tmp(\.\w+)?$", path.name):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # the error that follows says why
        pass


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data``."""
    with atomic(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` as strict JSON; see ``plain`` for what is converted."""
    write_text(path, json.dumps(plain(data), indent=1, allow_nan=False, ensure_ascii=False))


def write_yaml(path: Path, data: Any) -> None:
    """Write ``data``, of plain Python types, as YAML with its keys in the order given."""
    import yaml

    write_text(path, yaml.safe_dump(data, sort_keys=False, allow_unicode=True))


def write_npz(path: Path, /, *, compressed: bool = True, **arrays: Any) -> None:
    """Write ``arrays`` under their names as a NumPy archive."""
    with atomic(path) as temporary:
        (np.savez_compressed if compressed else np.savez)(temporary, **arrays)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a NumPy archive by name. Raises InputError for a file that is damaged or something else."""
    try:
        with np.load(require_file(path), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except InputError:
        raise
    except Exception as error:  # zip, zlib and NumPy raise what they like for damaged data
        raise InputError(f"{path} is damaged or no NumPy archive ({' '.join(str(error).split())[:160]})") from error


def read_npy(path: Path) -> np.ndarray:
    """The array of real numbers in a .npy file. Raises InputError for a file that is damaged or something else."""
    try:
        array = np.load(require_file(path), allow_pickle=False)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "uif":
            raise ValueError(f"it holds {getattr(array, 'dtype', 'several arrays')}")
    except InputError:
        raise
    except Exception as error:  # also SyntaxError and MemoryError, of a header that says anything
        raise InputError(f"{path} is not an array of numbers ({' '.join(str(error).split())[:160]})") from error
    return array


def check_motion(positions: np.ndarray, times: np.ndarray) -> None:
    """Raises ValueError unless ``positions`` (T, Q, 3) of T ≥ 1 frames and ``times`` (T,) are finite numbers, and the
    times ascend."""
    if positions.ndim != 3 or positions.shape[2] != 3 or 0 in positions.shape or times.shape != positions.shape[:1]:
        raise ValueError(f"positions have shape {positions.shape}, times {times.shape}")
    if {positions.dtype.kind, times.dtype.kind} != {"f"}:
        raise ValueError(f"positions are {positions.dtype}, times {times.dtype}")
    if not (np.isfinite(positions).all() and np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise ValueError("a position or a time is not finite, or times do not ascend")


def write_safetensors(
    path: Path, tensors: Mapping[str, torch.Tensor | np.ndarray], metadata: dict[str, str] | None = None
) -> None:
    """Write ``tensors`` as safetensors, with text ``metadata`` and a digest in the header."""
    from safetensors.numpy import save

    arrays = {
        name: np.ascontiguousarray(value if isinstance(value, np.ndarray) else value.detach().cpu().numpy())
        for name, value in tensors.items()
    }
    given = metadata or {}
    write_bytes(path, save(arrays, {**given, DIGEST: _digest(arrays, given)}))


def read_safetensors(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Tensors by name, and the metadata. Raises InputError if the file is damaged, which its digest tells, or has a
    number that is not finite."""
    from safetensors import safe_open

    try:
        with safe_open(require_file(path), framework="np") as file:
            metadata = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path} is damaged or no safetensors file ({' '.join(str(error).split())[:160]})") from error
    if metadata.pop(DIGEST, None) not in (None, _digest(arrays, metadata)):
        raise InputError(f"{path} is damaged: its numbers are not those that were written")
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{path}: '{name}' has a number that is not finite")
    return arrays, metadata


def _digest(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape} ".encode() + array.tobytes())
    return digest.hexdigest()


def plain(value: Any) -> Any:
    """``value`` as JSON can hold it: arrays to lists, paths to text, numbers that are not finite to null."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (str, int, bool, type(None))) else str(value)
