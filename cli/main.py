"""``masiv``: the list of commands. Each stands in its own file and imports what is heavy when it runs."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

import masiv

from . import console
from .batch import batch
from .config import config
from .evaluate import evaluate
from .export import export
from .identify import identify
from .import_ import import_footage
from .inspect import inspect
from .pretrain import pretrain
from .reconstruct import reconstruct
from .refine import refine
from .simulate import simulate
from .synth import synth
from .trajectory import trajectory
from .view import view

app = typer.Typer(
    name="masiv",
    help="From multi-view video of a deforming object to a digital twin: geometry, motion, constitutive law.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
_JOBS = identify, inspect, reconstruct, trajectory, refine, simulate, evaluate
for function in (*_JOBS, batch, view, export, pretrain, synth, config):
    app.command()(console.command(function))
app.command("import")(console.command(import_footage))


def _print_version(asked: bool) -> None:
    if asked:
        print(f"masiv {masiv.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """The options of ``masiv`` itself, which stand before the command."""


def run() -> None:
    """Run the command line in this process; ``supervisor.run`` is what users start. A wrong option is bad input: one
    sentence, exit code 2."""
    try:
        code = app(standalone_mode=False)
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()  # type: ignore[attr-defined]
            sys.exit(console.BAD_INPUT)
        message = error.format_message()  # type: ignore[attr-defined]
        print(f"error: {message} (see masiv --help)", file=sys.stderr)
        if "--json" in sys.argv:
            import json

            print(json.dumps({"error": message}))
        code = console.BAD_INPUT
    sys.exit(code if isinstance(code, int) else 0)


if __name__ == "__main__":
    from .supervisor import run as supervised

    supervised()
