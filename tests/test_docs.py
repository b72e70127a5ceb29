"""The pages say what is there: links, commands, options, settings, modules and layers exist."""

import configparser
import re
import shlex
from pathlib import Path

import pytest
import typer
import yaml

import masiv
from masiv.cli.main import app
from masiv.config import RENAMED_KEYS, Config

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")])
TODAY = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Pages of the code as it is; the changelog also has names of former versions."""
MAX_BYTES = 20_000

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def code_blocks(text: str) -> str:
    """Lines of fenced and indented code."""
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return "\n".join([*fenced, *re.findall(r"^ {4,}(\S.*)$", text, re.MULTILINE)])


def inline_code(text: str) -> list[str]:
    """What stands between single backticks, outside of fenced code."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))


def slug(heading: str) -> str:
    """The anchor that GitHub makes of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def made_of_the_code(path: Path) -> bool:
    """Whether the site has this page, which docs/hooks/reference.py makes."""
    name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
    commands = {f"docs/commands/{command}.md" for command in ("index", *COMMANDS)}
    return name in {"docs/effects.md", "docs/settings.md", *commands}


def command_lines(text: str) -> list[str]:
    """Lines that start ``masiv`` in blocks of code, without what follows a > of the shell."""
    lines = (line.strip().partition(" > ")[0] for line in code_blocks(text).splitlines())
    return [line for line in lines if line.startswith("masiv ")]


def parse(line: str) -> None:
    """With the options of the command. Raises if one is not known or has a wrong value."""
    _, name, *arguments = shlex.split(line, comments=True)
    if name != "--version":
        COMMANDS[name].make_context(name, arguments)


def test_there_are_pages():
    assert {"README.md", "docs/architecture.md", "docs/glossary.md", "benchmarks/refine.md"} <= set(map(of, PAGES))


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_links_within_the_repository_resolve(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"\w+://", target):
            continue
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        if made_of_the_code(there):
            continue
        assert there.exists(), f"{of(page)} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", there.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in map(slug, headings), f"{of(page)} links to {target}"


@pytest.mark.parametrize("page", TODAY, ids=of)
def test_pages_are_short(page):
    assert page.stat().st_size < MAX_BYTES


@pytest.mark.parametrize("page", PAGES, ids=of)
def test_no_merge_was_left_half_done(page):
    assert not re.search(r"^(<{7}|={7}|>{7})( |$)", page.read_text(encoding="utf-8"), re.MULTILINE)


def test_command_lines_parse():
    lines = {line: of(page) for page in TODAY for line in command_lines(page.read_text(encoding="utf-8"))}
    assert len(lines) > 20
    for line, page in lines.items():
        try:
            parse(line)
        except Exception as error:
            raise AssertionError(f"{page}: {line}: {error}") from error


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_of_the_help_parse(name):
    examples = [code for code in inline_code(COMMANDS[name].help) if code.startswith("masiv ")]
    assert any(example.split()[1] == name for example in examples)
    for example in examples:
        parse(example.partition(" > ")[0])


@pytest.mark.parametrize("page", TODAY, ids=of)
def test_commands_and_options_in_the_text_exist(page):
    for code in inline_code(page.read_text(encoding="utf-8")):
        if not code.startswith("masiv "):
            continue
        name, *arguments = code.split()[1:]
        known = {o for p in COMMANDS[name].params for o in p.opts} if name in COMMANDS else {"--version", "--help"}
        assert name in COMMANDS or name in known, f"{of(page)}: {code}"
        for argument in arguments:
            assert not argument.startswith("--") or argument.split("=")[0] in known, f"{of(page)}: {code}"


@pytest.mark.parametrize("page", TODAY, ids=of)
def test_paths_in_the_text_exist(page):
    for code in inline_code(page.read_text(encoding="utf-8")):
        if re.fullmatch(r"(masiv|cli|assets|benchmarks|docs|examples|tests)/[\w./-]*", code):
            assert (ROOT / code).exists(), f"{of(page)}: {code}"


def test_glossary_says_where_each_term_lives():
    rows = [line for line in (ROOT / "docs/glossary.md").read_text(encoding="utf-8").splitlines() if line[:2] == "| "]
    terms = [row for row in rows if not row.startswith("| term ")]
    assert len(terms) > 60
    assert all(re.search(r"\| `(masiv|benchmarks)/[\w./-]+` \|$", row) for row in terms)


@pytest.mark.parametrize("page", TODAY, ids=of)
def test_settings_in_the_text_exist(page):
    sections = {name: field.annotation for name, field in Config.model_fields.items()}
    for code in inline_code(page.read_text(encoding="utf-8")):
        setting = re.fullmatch(r"(reconstruct|trajectory|simulator|identify|refine|tracks)\.(\w+)(?:[:=].*)?", code)
        if setting and setting[2] not in ("json", "md", "npz"):
            assert setting[2] in sections[setting[1]].model_fields, f"{of(page)}: {code}"


def test_settings_of_the_acceptance_rule_exist():
    text = (ROOT / "docs/theory/discovery.md").read_text(encoding="utf-8")
    named = {code for code in inline_code(text) if re.fullmatch(r"(min|max)_\w+", code)}
    assert {"max_null_probability", "min_predictive_p"} <= named
    assert named <= set(Config.model_fields["refine"].annotation.model_fields)


def test_the_library_has_what_the_readme_uses():
    names = set(re.findall(r"\bmasiv\.([a-zA-Z]\w+)\(", code_blocks((ROOT / "README.md").read_text(encoding="utf-8"))))
    assert {"read_scene", "identify", "simulate"} <= names
    assert all(hasattr(masiv, name) for name in names)


def test_architecture_has_the_layers_that_are_checked():
    contracts = configparser.ConfigParser()
    contracts.read(ROOT / ".importlinter")
    layers = re.findall(r"\w+", contracts["importlinter:contract:layers"]["layers"])
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    table = re.findall(r"`(\w+)`", text.partition("## Layers")[2].partition("\n## ")[0])
    assert len(layers) > 20
    assert set(layers) <= set(table)


def test_version_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == masiv.__version__
    assert f"\n## {masiv.__version__} " in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_changelog_has_the_settings_that_were_renamed():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    named = set(inline_code(text))
    assert RENAMED_KEYS
    assert {old.partition(".")[2] for old in RENAMED_KEYS} | set(RENAMED_KEYS.values()) <= named
