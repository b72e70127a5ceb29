"""Files that are written completely or not at all: under a temporary name in the same folder, which is then renamed.

A writer that fails leaves the target as it was and no temporary file. All functions create missing folders.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch


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
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def remove_temporary(folder: Path) -> None:
    """Delete what ``atomic`` left in ``folder`` and in the folders below when its process was killed."""
    for path in folder.rglob("*.tmp*"):
        if re.search(r"\.\d+\.tmp(\.\w+)?$", path.name):
            path.unlink(missing_ok=True)


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


def write_safetensors(path: Path, tensors: Mapping[str, torch.Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write ``tensors`` as safetensors, with text ``metadata`` in the header."""
    from safetensors.torch import save_file

    with atomic(path) as temporary:
        save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, temporary, metadata)


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
