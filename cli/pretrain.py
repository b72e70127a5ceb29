"""``masiv pretrain``: the initial laws."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SeedOption, SetOption


def pretrain(
    material: Annotated[
        str, typer.Argument(metavar="MATERIAL", help="jelly, plasticine, sand or water.", show_default=False)
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Where to write the law. [default: MATERIAL.safetensors]")
    ] = None,
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Teach the neural law one material from full-state simulation: where `identify` starts from.

    Example: `masiv pretrain jelly --out jelly.safetensors`
    """
    from masiv import runtime
    from masiv.config import load_config

    from .console import progress_bar

    settings = load_config(preset, config, assignments=assignments or (), seed=seed, arch=arch)
    target = out or Path(f"{material}.safetensors")
    runtime.start(settings.arch)
    from masiv.pretraining.pretrain import pretrain as teach

    with progress_bar() as progress:
        law, quality = teach(material, seed=settings.seed, progress=progress)
    target.parent.mkdir(parents=True, exist_ok=True)
    law.save(target)
    numbers = "\n".join(f"  {name} {value:.4g}" for name, value in quality.items())
    return {"material": material, "law": str(target), **quality}, f"{target}\n{numbers}"
