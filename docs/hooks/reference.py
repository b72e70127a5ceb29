"""Pages that are made of the code: every command, every setting, every effect."""

import inspect

import typer
from mkdocs.structure.files import File
from typer.cli import get_docs_for_click

from masiv.cli.main import app
from masiv.config import Config
from masiv.config_listing import as_yaml, listing
from masiv.effects.catalogue import effects
from masiv.effects.effect import KINDS


def on_files(files, config):
    pages = {"settings.md": settings_page(), "effects.md": effects_page(), **command_pages()}
    for uri, content in pages.items():
        files.append(File.generated(config, uri, content=content))
    return files


def command_pages() -> dict[str, str]:
    """A page for each command, as its --help has it, and one that lists them."""
    group = typer.main.get_command(app)
    above = typer.Context(group, info_name="masiv")
    pages, rows = {}, []
    for name, command in sorted(group.commands.items()):
        context = typer.Context(command, info_name=name, parent=above)
        pages[f"commands/{name}.md"] = get_docs_for_click(obj=command, ctx=context, name=name, call_prefix="masiv")
        rows.append(f"| [`masiv {name}`]({name}.md) | {command.get_short_help_str(200)} |")
    table = "\n".join(["| command | does |", "|---|---|", *rows])
    pages["commands/index.md"] = f"# Commands\n\nThese pages are what `masiv COMMAND --help` prints.\n\n{table}\n"
    return pages


def settings_page() -> str:
    return (
        "# Settings\n\nWhat `masiv config` prints: the preset `standard`, with units in square brackets and bounds in "
        "round ones. `--preset` chooses another preset, `--config FILE` reads a YAML file like this one, and "
        "`--set reconstruct.iterations=200` changes a single setting. What comes later counts: preset, `--config`, "
        f"`--set`, other options.\n\n```yaml\n{as_yaml(listing(Config()))}\n```\n"
    )


def effects_page() -> str:
    """The gallery: a clip, the equation and the parameters of each effect."""
    kinds = {kind: (inspect.getdoc(kind) or "").split("\n\n")[0] for kind in KINDS}
    text = [
        "# Effects",
        "What `masiv refine` can find and name. In each clip the same soft cube is simulated without the effect on the "
        "left and with it on the right. Effects are much stronger here than what is found in a recording. Vectors and "
        "places are in the simulation frame: y up, the ground at y = 0; "
        "$v$ is a velocity [m/s], $x$ a position [m], $t$ the time since frame 0 [s].",
    ]
    for name, effect in effects().items():
        acts = " ".join(kinds[kind] for kind in KINDS if isinstance(effect, kind))
        text += [f"## {name}", f"{effect.looks_like[:1].upper()}{effect.looks_like[1:]}."]
        if effect.hints.cause:
            text += [f"![A cube without and with {name}](gallery/{name}.webp)"]
        text += [inspect.getdoc(type(effect)) or "", f"How it acts: {acts}", _parameters(effect)]
    return "\n\n".join(text) + "\n"


def _parameters(effect) -> str:
    rows = ["| parameter | unit | bounds | |", "|---|---|---|---|"]
    shown = effect.parameters if len(effect.parameters) < 12 else (effect.parameters[0], effect.parameters[-1])
    for parameter in shown:
        role = "strength" if parameter in effect.parameters[: effect.strengths] else ""
        unit = parameter.unit.replace("^2", "²")
        rows.append(f"| `{parameter.name}` | {unit} | {parameter.lower:g} to {parameter.upper:g} | {role} |")
    if len(shown) < len(effect.parameters):
        rows.insert(3, f"| … {len(effect.parameters) - 2} more | | | |")
    return "\n".join(rows)
