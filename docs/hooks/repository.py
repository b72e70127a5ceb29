"""Pages of the repository outside of docs/ as pages of the site, and links between all of them."""

import os
import re
from pathlib import Path, PurePosixPath

from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File

log = get_plugin_logger("repository")
ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = {
    ROOT / "README.md": "index.md",
    ROOT / "CONTRIBUTING.md": "contributing.md",
    ROOT / "CHANGELOG.md": "changelog.md",
    **{path: f"benchmarks/{path.name}" for path in sorted(ROOT.glob("benchmarks/*")) if path.suffix in (".md", ".svg")},
}
"""Files outside of docs/ that are part of the site, and where they are in it."""
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")


def on_files(files, config):
    for source, uri in PAGES.items():
        files.append(File.generated(config, uri, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown, page, **_):
    """Links of a file of the repository, which are relative to it, as links of the site. What the site does not have
    (source code) is named without a link."""
    source = page.file.abs_src_path
    if source is None or page.file.inclusion.name == "EXCLUDED":
        return markdown

    def moved(found):
        picture, text, target = found.groups()
        if re.match(r"\w+:|#", target):
            return found[0]
        path, _, anchor = target.partition("#")
        there = (Path(source).parent / path).resolve()
        uri = uri_of(there)
        if uri is None:
            if not there.exists():
                log.warning(f"{source} links to {target}, which does not exist")
            return text
        relative = os.path.relpath(uri, PurePosixPath(page.file.src_uri).parent)
        return f"{picture}[{text}]({relative}{'#' if anchor else ''}{anchor})"

    return LINK.sub(moved, markdown)


def uri_of(path: Path) -> str | None:
    """Where a file of the repository is in the site; None if it is not."""
    if path in PAGES:
        return PAGES[path]
    if path.is_relative_to(DOCS) and path.suffix not in (
        "",
        ".py",
    ):  # it need not exist: some pages are made of the code
        return path.relative_to(DOCS).as_posix()
    return None
