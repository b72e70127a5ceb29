"""One self-contained HTML page: no file, script or font from elsewhere."""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from masiv.files import write_text
from masiv.report.charts import Chart

LONG = 30
"""Letters from which on a cell of a table is a text of several lines."""
NO_SCRIPT = "<noscript><p>Plots and the 3D view need JavaScript. All of it is in this file.</p></noscript>"


@dataclass(frozen=True)
class Share:
    """A part of a whole, 0 to 1, that a table shows as a bar."""

    value: float


@dataclass(frozen=True)
class Card:
    """A question, its answer in a few words, and lines that say more. open: the answer is not known, or not good."""

    question: str
    answer: str
    lines: Sequence[str] = ()
    open: bool = False


@dataclass
class Page:
    """Collects sections, then ``write``. Text is escaped; pictures and scripts are embedded."""

    title: str
    parts: list[str] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)

    def heading(self, text: str) -> None:
        self.parts.append(f"<h2>{html.escape(text)}</h2>")

    def subheading(self, text: str) -> None:
        self.parts.append(f"<h3>{html.escape(text)}</h3>")

    def text(self, text: str) -> None:
        self.parts.append(f"<p>{html.escape(text)}</p>")

    def note(self, text: str) -> None:
        self.parts.append(f'<p class="note">{html.escape(text)}</p>')

    def cards(self, cards: Sequence[Card]) -> None:
        shown = []
        for card in cards:
            lines = "".join(f"<p>{html.escape(line)}</p>" for line in card.lines)
            kind = "card open" if card.open else "card"
            shown.append(
                f'<section class="{kind}"><h2>{html.escape(card.question)}</h2>'
                f"<strong>{html.escape(card.answer)}</strong>{lines}</section>"
            )
        self.parts.append(f'<div class="cards">{"".join(shown)}</div>')

    def table(self, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Numbers are right-aligned and shown with four significant digits; None is a dash."""
        numeric = [bool(rows) and all(_is_number(row[k]) or row[k] is None for row in rows) for k in range(len(header))]
        head = "".join(
            f"<th{_NUMERIC if right else ''}>{html.escape(name)}</th>"
            for name, right in zip(header, numeric, strict=True)
        )
        body = "".join("<tr>" + "".join(_cell(value) for value in row) + "</tr>" for row in rows)
        self.parts.append(f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>')

    def links(self, links: Sequence[tuple[str, str]]) -> None:
        """A list of texts with their addresses."""
        shown = "".join(f'<li><a href="{html.escape(address)}">{html.escape(text)}</a></li>' for text, address in links)
        self.parts.append(f"<ul>{shown}</ul>")

    def picture(self, png: bytes, alt: str) -> None:
        self.pictures([(png, alt)])

    def pictures(self, pictures: Sequence[tuple[bytes, str]]) -> None:
        """PNG files of one size with what they show, as many in a row as fit."""
        shown = "".join(
            f'<figure><img alt="{html.escape(alt)}" src="data:image/png;base64,{encoded(png)}"></figure>'
            for png, alt in pictures
        )
        self.parts.append(f'<div class="grid">{shown}</div>')

    def charts(self, charts: Sequence[Chart]) -> None:
        """Charts of one size, as many in a row as fit."""
        shown = "".join(self.chart_figure(chart) for chart in charts)
        self.parts.append(f'<div class="grid">{shown}</div>')

    def chart_figure(self, chart: Chart) -> str:
        """The markup of one, to be put somewhere; its data is in the page."""
        known = self.data.setdefault("charts", [])
        known.append(chart.data())
        marks = "".join(
            f'<li><i class="{kind}" style="--mark:{colour}"></i>{html.escape(name)}</li>'
            for kind, colour, name in chart.legend
        )
        legend = f'<ul class="legend">{marks}</ul>' if marks else ""
        note = f"<figcaption>{html.escape(chart.note)}</figcaption>" if chart.note else ""
        title = html.escape(chart.title)
        return (
            f'<figure><h4>{title}</h4><div class="chart" data-chart="{len(known) - 1}" role="img" aria-label="{title}">'
            f"</div>{legend}{note}</figure>"
        )

    def script(self, markup: str, **data: Any) -> None:
        """Add ``markup`` (HTML, not escaped) and the ``data`` that report.js fills it with."""
        self.parts.append(markup)
        self.data |= data

    @contextmanager
    def folded(self, title: str) -> Iterator[None]:
        """What is added meanwhile is closed at first."""
        self.parts.append(f"<details><summary>{html.escape(title)}</summary>")
        yield
        self.parts.append("</details>")

    def write(self, path: Path) -> None:
        """Write the page, completely or not at all."""
        title = html.escape(self.title)
        text = (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1"><link rel="icon" href="data:,">'
            f"<title>{title}</title><style>{_web('report.css')}</style></head><body><h1>{title}</h1>"
            f"{''.join(self.parts)}{self._scripts()}</body></html>"
        )
        write_text(path, text)

    def _scripts(self) -> str:
        """Nothing for a page without charts."""
        if not self.data:
            return ""
        from masiv.report.plotly_script import packed_script

        return (
            f'{NO_SCRIPT}<script type="application/json" id="data">{as_json(self.data)}</script>'
            f'<script type="text/plain" id="library">{packed_script()}</script><script>{_web("report.js")}</script>'
        )


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


def encoded(data: bytes) -> str:
    """base64."""
    return base64.b64encode(data).decode("ascii")


def as_json(data: Mapping[str, Any]) -> str:
    """JSON that can stand in a page: no markup; numbers that are not finite are null."""
    return json.dumps(_finite(data), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


_NUMERIC = ' class="n"'


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(value: Any) -> str:
    if isinstance(value, Share):
        width = 6 * min(max(value.value, 0.0), 1.0)
        return f'<td class="bar"><i style="width:{width:.2f}rem"></i>{100 * value.value:.0f} %</td>'
    text = number(value)
    kind = _NUMERIC if _is_number(value) else ' class="long"' if len(text) > LONG else ""
    return f"<td{kind}>{html.escape(text)}</td>"


def _web(name: str) -> str:
    return (resources.files("masiv.report") / "web" / name).read_text(encoding="utf-8")
