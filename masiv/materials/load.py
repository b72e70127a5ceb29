"""Read any law back from its file."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from masiv.errors import InputError
from masiv.files import read_safetensors
from masiv.materials.adapter import AdapterLaw
from masiv.materials.classical import ClassicalLaw
from masiv.materials.law import Law
from masiv.materials.neural import NeuralLaw
from masiv.strict import reason


def load_law(path: Path) -> Law:
    """The law in ``path``. Raises InputError if it is missing or is not a law."""
    try:
        arrays, metadata = read_safetensors(path)
        state = {name: torch.from_numpy(array) for name, array in arrays.items()}
        kind = metadata["kind"]
        law: Law
        if kind == NeuralLaw.kind:
            law = NeuralLaw(width=int(metadata["width"]))
        elif kind == AdapterLaw.kind:
            law = AdapterLaw.from_state(metadata, state)
        else:
            law = ClassicalLaw.from_state(kind, state)
        law.load_state_dict(state)
        estimated = law.base if isinstance(law, AdapterLaw) else law
        if isinstance(estimated, ClassicalLaw):
            estimated.stderr = json.loads(metadata.get("stderr", "{}"))
    except (InputError, KeyError, RuntimeError, ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} is not a law written by masiv ({reason(error, path)}): run identify or pretrain again"
        ) from error
    return law
