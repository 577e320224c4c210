"""One self-contained HTML page: what it is made of, and how it is written."""

import functools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from cellquant import __version__
from cellquant.compare.svg import FONT_STACK, THEME
from cellquant.storage import atomic_path

if TYPE_CHECKING:
    import pandas as pd

MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Panel:
    """One drawing of a figure: its name, the ``<svg>`` element, and what it shows in words."""

    name: str
    svg: str
    alt: str
    title: str = ""


@dataclass(frozen=True)
class Figure:
    """One figure: drawings beside each other, a caption, and the numbers behind them."""

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    data: "pd.DataFrame | None" = None
    wide: bool = False


@dataclass(frozen=True)
class Row:
    """One row of a table; the tone colours its verdict: good, bad, none or empty."""

    cells: tuple[str, ...]
    tone: str = ""


@dataclass(frozen=True)
class Table:
    """A table of ready-made text; the classes of its columns are number, note, verdict or empty."""

    name: str
    caption: str
    columns: tuple[str, ...]
    classes: tuple[str, ...]
    rows: tuple[Row, ...]
    data: "pd.DataFrame | None" = None


@dataclass(frozen=True)
class Settings:
    """Names and values, shown as a list."""

    title: str
    entries: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Section:
    """A part of the page with an entry in the contents list."""

    name: str
    title: str
    text: tuple[str, ...] = ()
    points: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    settings: tuple[Settings, ...] = ()
    commands: str = ""


@dataclass(frozen=True)
class Headline:
    """A number worth reading first."""

    label: str
    value: str
    unit: str = ""


@dataclass(frozen=True)
class Page:
    """A whole report. In every text ``a_{b}`` and ``a^{b}`` are sub- and superscripts."""

    title: str
    lede: str
    sections: tuple[Section, ...]
    glance: tuple[Headline, ...] = field(default=())


def render_page(page: Page) -> str:
    """The page as HTML; equal pages give equal text."""
    return str(_template().render(page=page, theme=THEME, font=FONT_STACK, version=__version__))


@functools.cache
def _template() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("cellquant", "compare"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(marked=_marked, bare=_bare, csv_uri=_csv_uri, inline=_inline)
    return environment.get_template("report.html.j2")


def write_page(page: Page, path: str | Path) -> None:
    """Write the page as one HTML file that loads nothing from anywhere; whole or not at all.

    Parameters
    ----------
    page
        What to write.
    path
        The HTML file; its folder is made when it does not exist.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    text = render_page(page)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def format_value(value: float | None, std_error: float | None = None) -> str:
    """A number with its standard error, both to two digits of the error: ``3.912 ± 0.013``.

    Without an error the number keeps four significant digits at most; without a number it is a
    dash.
    """
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    # An error at the level of round-off is none: every part of the sample gave the same number.
    if std_error is None or not math.isfinite(std_error) or std_error <= 1e-12 * abs(value):
        return _without_zeros(_plain(value, 3 - _magnitude(value)))
    digits = 1 - _magnitude(float(f"{std_error:.1e}"))
    return f"{_plain(value, digits)} ± {_plain(std_error, digits)}"


def _magnitude(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else 0


def _plain(value: float, digits: int) -> str:
    if not -7 < digits < 9 or abs(value) >= 1e7:
        mantissa, exponent = f"{value:.2e}".split("e")
        power = str(int(exponent)).replace("-", MINUS)
        return f"{mantissa} × 10^{{{power}}}".replace("-", MINUS)
    rounded = round(value, digits) + 0.0  # no minus before a zero
    text = f"{rounded:.{max(digits, 0)}f}"
    whole, dot, rest = text.partition(".")
    if len(whole.lstrip("-")) > 4:
        whole = f"{int(whole):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return (whole + dot + rest).replace("-", MINUS)


def _without_zeros(text: str) -> str:
    """Drop zeros after the point, where no error says how many digits count."""
    return text.rstrip("0").rstrip(".") if "." in text and "×" not in text else text


def flatten(settings: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Nested settings as (dotted name, text) in the order given."""
    entries: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            entries += [(f"{key}.{name}", text) for name, text in flatten(value)]
        elif isinstance(value, str):
            entries.append((str(key), value or "\N{EN DASH}"))
        elif value is None:
            entries.append((str(key), "not set"))
        elif isinstance(value, bool):
            entries.append((str(key), "yes" if value else "no"))
        elif isinstance(value, Sequence) and not any(isinstance(v, Mapping) for v in value):
            entries.append((str(key), ", ".join(_digits(v) for v in value) or "none"))
        elif isinstance(value, Sequence):
            for number, item in enumerate(value, start=1):
                inner = item if isinstance(item, Mapping) else {"": item}
                entries += [(f"{key} {number}.{n}".rstrip("."), t) for n, t in flatten(inner)]
        else:
            entries.append((str(key), _digits(value)))
    return tuple(entries)


def _digits(value: Any) -> str:
    """A number as it was given, or to six digits where it was computed."""
    return f"{value:.6g}" if isinstance(value, float) and len(repr(value)) > 9 else str(value)


def _marked(text: str) -> Any:
    """Escape, then turn ``a_{b}`` and ``a^{b}`` into sub- and superscripts."""
    from markupsafe import Markup, escape

    safe = str(escape(text))
    safe = re.sub(r"_\{([^{}]*)\}", r"<sub>\1</sub>", safe)
    return Markup(re.sub(r"\^\{([^{}]*)\}", r"<sup>\1</sup>", safe))


def _bare(text: str) -> str:
    """Drop the marks of sub- and superscripts, where only plain text can stand."""
    return re.sub(r"[_^]\{([^{}]*)\}", r"\1", text)


def _inline(svg: str, alt: str) -> Any:
    """The drawing as an image with its description; everything in it was escaped when drawn."""
    from markupsafe import Markup, escape

    return Markup(svg.replace("<svg ", f'<svg role="img" aria-label="{escape(alt)}" ', 1))


def _csv_uri(data: "pd.DataFrame") -> str:
    """A table as a data: address that the browser saves without asking any network."""
    text = data.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    return "data:text/csv;charset=utf-8," + quote(text, safe=",:;/()*!~'$@=+")
