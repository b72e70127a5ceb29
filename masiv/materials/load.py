"""Read any law back from its file."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import SafetensorError, safe_open

from masiv.errors import InputError
from masiv.materials.adapter import AdapterLaw
from masiv.materials.classical import ClassicalLaw
from masiv.materials.law import Law
from masiv.materials.neural import NeuralLaw


def load_law(path: Path) -> Law:
    """The law in ``path``. Raises InputError if it is missing or is not a law."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            state = {name: file.get_tensor(name) for name in file.keys()}
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
    except (SafetensorError, FileNotFoundError, KeyError, RuntimeError) as error:
        raise InputError(f"{path} is not a law written by masiv ({error}): run identify or pretrain again") from error
    return law
