"""The built site: nothing from the network, no link into nothing, every command, effect and name of the library."""

from __future__ import annotations

import functools
import html
import http.server
import importlib.util
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from browser import watched

import masiv
from masiv.cli.main import app
from masiv.effects.catalogue import effects

pytest.importorskip("mkdocs")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
COMMANDS = [command.name or command.callback.__name__ for command in app.registered_commands]
LOADED = {"script": "src", "img": "src", "source": "src", "iframe": "src", "video": "src"}


class References(HTMLParser):
    """What a page loads and links to, and the anchors that it has."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.loads: set[str] = set()
        self.links: set[str] = set()
        self.anchors: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag in LOADED and given.get(LOADED[tag]):
            self.loads.add(given[LOADED[tag]])
        if tag == "link" and "stylesheet" in given.get("rel", ""):
            self.loads.add(given["href"])
        if tag == "a" and given.get("href"):
            self.links.add(given["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site):
    return {page: References(page) for page in site.rglob("*.html") if page.name != "404.html"}


def local(references: set[str]) -> Iterator[tuple[str, str]]:
    """Path and anchor of those that are no address on the network."""
    for reference in references:
        if not re.match(r"\w+:", reference):
            path, _, anchor = reference.partition("#")
            yield path, anchor


def test_nothing_is_loaded_from_the_network(site, pages):
    for page, found in pages.items():
        assert not [reference for reference in found.loads if re.match(r"(\w+:)?//", reference)], page
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import\s+)['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def test_what_a_page_names_is_there(pages):
    for page, found in pages.items():
        for path, anchor in local(found.loads | found.links):
            there = (page.parent / path).resolve() if path else page
            assert there.exists(), f"{page.name}: {path}"
            if anchor and there in pages:
                assert anchor in pages[there].anchors, f"{page.name}: {path}#{anchor}"


def test_formulas_are_drawn(pages):
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    assert sum(text.count("<math") for text in texts.values()) > 150
    for page, text in texts.items():
        prose = re.sub(r"<(code|pre|script|style)\b.*?</\1>", "", text, flags=re.DOTALL)
        assert "arithmatex" not in prose, page
        left = re.findall(r"\$[^$<>\n]{1,60}\$", html.unescape(re.sub(r"<[^>]+>", "", prose)))
        assert not left, f"{page.name}: {left[:3]}"


def test_a_formula_that_cannot_be_drawn_is_an_error():
    from mkdocs.exceptions import PluginError

    specification = importlib.util.spec_from_file_location("mathml", ROOT / "docs/hooks/mathml.py")
    assert specification is not None
    assert specification.loader is not None
    hook = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(hook)
    assert "<mfrac>" in hook.mathml(r"\frac{a &lt; b}{c}", True, "page.md")
    with pytest.raises(PluginError, match=r"page.md.*nosuchcommand"):
        hook.mathml(r"a \nosuchcommand b", False, "page.md")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_page(site, name):
    text = (site / f"commands/{name}.html").read_text(encoding="utf-8")
    assert "--help" in text
    assert f"masiv {name}" in text


def test_every_effect_has_its_clip_and_parameters(site, pages):
    page = site / "effects.html"
    text = page.read_text(encoding="utf-8")
    for name, effect in effects().items():
        assert name in pages[page].anchors
        assert effect.parameters[0].name in text
        assert (f"gallery/{name}.webp" in pages[page].loads) == effect.hints.cause


def test_every_public_name_is_in_the_reference(site, pages):
    anchors = {anchor.rsplit(".", 1)[-1] for anchor in pages[site / "api.html"].anchors}
    assert set(masiv.__all__) <= anchors


def test_every_page_of_the_repository_is_in_the_site(site):
    for page in (ROOT / "docs").rglob("*.md"):
        assert (site / page.relative_to(ROOT / "docs").with_suffix(".html")).is_file(), page


@pytest.fixture(scope="module")
def address(site):
    """Of the site on a server of this machine: a browser does not let a page from a disk search."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *arguments: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize("width", [1400, 400])
@pytest.mark.parametrize("name", ["index", "effects", "theory/discovery", "api"])
def test_a_browser_shows_the_page(browser, address, name, width):
    with watched(browser, width=width) as seen:
        seen.page.goto(f"{address}/{name}.html")
        seen.page.wait_for_load_state("load")
        assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
        broken = "[...document.images].filter(i => i.complete && !i.naturalWidth).map(i => i.src)"
        assert seen.page.evaluate(broken) == []
        heights = seen.page.evaluate(
            "[...document.querySelectorAll('math')].map(m => m.getBoundingClientRect().height)"
        )
        assert all(height > 5 for height in heights)
        assert len(heights) > (20 if name in ("effects", "theory/discovery") else -1)
        assert (seen.errors, seen.requests) == ([], [])


def test_the_search_finds_an_effect(browser, address):
    with watched(browser) as seen:
        seen.page.goto(f"{address}/index.html")
        seen.page.locator("[data-md-component=search-query]").fill("hidden_obstacle")
        seen.page.locator(".md-search-result__link").first.wait_for(timeout=30_000)
        found = seen.page.locator(".md-search-result__link")
        assert any(
            re.search(r"effects\.html.*#hidden_obstacle$", link.get_attribute("href") or "") for link in found.all()
        )
        assert (seen.errors, seen.requests) == ([], [])
