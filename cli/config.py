"""``masiv config``: every setting."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

import typer

from .options import ArchOption, ConfigOption, JsonOption, PresetOption, SeedOption, SetOption


def config(
    section: Annotated[
        str | None,
        typer.Argument(metavar="SECTION", help="Print this section or key alone, for example reconstruct."),
    ] = None,
    file: ConfigOption = None,
    assignments: SetOption = None,
    preset: PresetOption = None,
    arch: ArchOption = None,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> tuple[dict[str, Any], str]:
    """Print every setting with its value, unit, bounds and description, as YAML that --config reads.

    The order is preset, --config, --set, other options: what comes later replaces what comes earlier.

    Example: `masiv config --preset quick > settings.yaml`

    One section, with a setting changed: `masiv config identify --set identify.iterations=200`
    """
    from masiv.config import load_config
    from masiv.config_listing import as_yaml, listing

    settings = listing(load_config(preset, file, assignments=assignments or (), seed=seed, arch=arch), section)
    return {"settings": [asdict(setting) for setting in settings]}, as_yaml(settings)
