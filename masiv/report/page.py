"""One self-contained HTML page: no file, script or font from elsewhere."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from masiv.files import write_text

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:1100px;margin:2rem auto;padding:0 1rem;color:#1c2430;background:#fff}
h1{font-size:1.6rem;margin-bottom:.2rem}h2{font-size:1.15rem;margin:2rem 0 .6rem;border-bottom:1px solid #d8dde4}
table{border-collapse:collapse;margin:.5rem 0}th,td{padding:.3rem .9rem .3rem 0;text-align:left;vertical-align:top}
th{font-weight:600;border-bottom:1px solid #9aa4b1}td{border-bottom:1px solid #e6e9ee}
td.n{text-align:right;font-variant-numeric:tabular-nums}
td.bar{min-width:9rem;white-space:nowrap}td.bar i{display:inline-block;height:.7em;margin-right:.5em;background:#2563a8}
h3{font-size:1rem;margin:1.4rem 0 .2rem}img,video{max-width:100%;height:auto}.note{color:#5b6675;font-size:.9rem}
"""


@dataclass(frozen=True)
class Share:
    """A part of a whole, 0 to 1, that a table shows as a bar."""

    value: float


@dataclass
class Page:
    """Collects sections, then ``write``. Text is escaped; pictures and videos are embedded."""

    title: str
    parts: list[str] = field(default_factory=list)

    def heading(self, text: str) -> None:
        self.parts.append(f"<h2>{html.escape(text)}</h2>")

    def subheading(self, text: str) -> None:
        self.parts.append(f"<h3>{html.escape(text)}</h3>")

    def note(self, text: str) -> None:
        self.parts.append(f'<p class="note">{html.escape(text)}</p>')

    def table(self, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Numbers are right-aligned and shown with four significant digits; None is a dash."""
        head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
        body = "".join("<tr>" + "".join(_cell(value) for value in row) + "</tr>" for row in rows)
        self.parts.append(f"<table><tr>{head}</tr>{body}</table>")

    def picture(self, png: bytes, alt: str) -> None:
        self.parts.append(f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{_encoded(png)}">')

    def video(self, mp4: bytes, caption: str) -> None:
        source = f"data:video/mp4;base64,{_encoded(mp4)}"
        self.parts.append(f'<video controls autoplay loop muted playsinline src="{source}"></video>')
        self.note(caption)

    def write(self, path: Path) -> None:
        """Write the page, completely or not at all."""
        title = html.escape(self.title)
        text = (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>{''.join(self.parts)}</body></html>"
        )
        write_text(path, text)


def number(value: Any) -> str:
    """Four significant digits; a dash for None; lists in brackets."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(number(item) for item in value) + ")"
    if isinstance(value, float):
        return "∞" if math.isinf(value) else f"{value:.4g}"
    return str(value)


def _cell(value: Any) -> str:
    if isinstance(value, Share):
        width = 6 * min(max(value.value, 0.0), 1.0)
        return f'<td class="bar"><i style="width:{width:.2f}rem"></i>{100 * value.value:.0f} %</td>'
    kind = ' class="n"' if isinstance(value, (int, float)) and not isinstance(value, bool) else ""
    return f"<td{kind}>{html.escape(number(value))}</td>"


def _encoded(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
