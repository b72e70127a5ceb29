"""``masiv synth``: a synthetic multi-view scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from masiv.cli.options import ArchOption, ConfigOption, JsonOption, PresetOption, SeedOption


def synth(
    spec: Annotated[Path, typer.Argument(metavar="SPEC.yaml", help="What to simulate and film.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder of the new scene.", show_default=False)],
    config: ConfigOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Simulate and film an object of known material: a scene in the PAC-NeRF layout, with its ground truth.

    Example: `masiv synth assets/sample.yaml --out scenes/sample`
    """
    import shutil

    from masiv import runtime
    from masiv.cli.console import progress_bar
    from masiv.config import load_config
    from masiv.errors import InputError
    from masiv.strict import read_yaml, validated
    from masiv.synth.config import SynthSpec

    settings = load_config(preset, config, seed=seed, arch=arch)
    overrides = {} if seed is None else {"seed": seed}
    request = validated(SynthSpec, {**read_yaml(spec), **overrides}, str(spec))
    if out.exists():
        raise InputError(f"{out} exists: give a new folder with --out")
    runtime.start(settings.arch)
    from masiv.synth.make import synthesise

    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_name(out.name + ".unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with progress_bar() as progress:
            synthesise(request, unfinished, progress=progress)
        unfinished.rename(out)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return {"scene": str(out)}, f"{out}: masiv inspect {out} shows it"
