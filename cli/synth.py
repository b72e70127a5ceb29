"""``masiv synth``: a synthetic multi-view scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SeedOption, SetOption


def synth(
    spec: Annotated[Path, typer.Argument(metavar="SPEC.yaml", help="What to simulate and film.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder of the new scene.", show_default=False)],
    config: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Simulate and film an object of known material: a scene in the PAC-NeRF layout, with its ground truth.

    Example: `masiv synth assets/sample.yaml --out scenes/sample`
    """
    from masiv import runtime
    from masiv.config import load_config
    from masiv.synth.spec import read_spec

    from .console import progress_bar

    settings = load_config(preset, config, assignments=assignments or (), seed=seed, arch=arch)
    request = read_spec(spec)
    if "seed" in settings.model_fields_set:
        request = request.model_copy(update={"seed": settings.seed})
    runtime.start(settings.arch)
    from masiv.synth.synthesise import synthesise

    with progress_bar() as progress:
        synthesise(request, out, progress=progress)
    return {"scene": str(out)}, f"{out}: masiv inspect {out} shows it"
