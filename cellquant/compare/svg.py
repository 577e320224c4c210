"""From a matplotlib figure to a small SVG that follows the page: its colours, its fonts, its ids.

The same figure gives the same bytes every time: no dates, salted ids, rounded coordinates. Colours
of the theme become ``var(--name, #hex)``, so that one drawing serves light, dark and print, and a
saved copy keeps the light colours.
"""

import contextlib
import io
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Role -> (on light, on dark). Every series colour has a contrast of at least 3:1 on its ground,
# every text colour at least 4.5:1.
THEME = {
    "ink": ("#1f2328", "#e8e6e1"),
    "muted": ("#5c636b", "#a9adb3"),
    "rule": ("#d9d7d1", "#3c4046"),
    "ground": ("#fdfcfa", "#191b1e"),
    "series-0": ("#1f6fb4", "#6cb2f0"),
    "series-1": ("#c2541b", "#f2935a"),
    "series-2": ("#12806a", "#4cc7ab"),
    "series-3": ("#7a4fb5", "#b795ee"),
    "series-4": ("#a8842c", "#dcb95c"),
    "series-5": ("#b03a5b", "#f0849f"),
}
N_SERIES = 6
FONT_STACK = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Liberation Sans', sans-serif"
_PLAIN_NUMBER = re.compile(r"-?\d+\.\d+")


def colour(role: str) -> str:
    """The colour of a role of `THEME` on light ground, as matplotlib and a saved copy use it."""
    return THEME[role][0]


def series_colour(index: int) -> str:
    """Colour of the series with this number; they repeat after `N_SERIES`."""
    return colour(f"series-{index % N_SERIES}")


@contextlib.contextmanager
def canvas(*, width: float = 4.8, height: float = 3.4) -> Iterator[tuple["Figure", "Axes"]]:
    """Give a figure with one pair of axes in the style of the page, for `to_svg`.

    The axes stand at the same place in every figure of the same size, so that figures beside each
    other can be compared by eye.

    Parameters
    ----------
    width, height
        Size in inch at a font of 10 pt; the page scales the drawing.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    style: Any = {
        "svg.fonttype": "none",
        "svg.hashsalt": "cellquant",
        "font.family": ["DejaVu Sans"],
        "font.size": 10,
        "axes.labelsize": 10,
        "xtick.labelsize": 9,
        "ytick.labelsize": 9,
        "legend.fontsize": 9,
        "legend.frameon": False,
        "legend.handlelength": 1.4,
        "text.color": colour("ink"),
        "axes.labelcolor": colour("ink"),
        "axes.edgecolor": colour("muted"),
        "axes.facecolor": "none",
        "figure.facecolor": "none",
        "savefig.facecolor": "none",
        "savefig.transparent": True,
        "xtick.color": colour("muted"),
        "ytick.color": colour("muted"),
        "xtick.labelcolor": colour("ink"),
        "ytick.labelcolor": colour("ink"),
        "axes.linewidth": 0.8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.unicode_minus": True,
        "axes.formatter.use_mathtext": False,
        "lines.linewidth": 1.8,
        "path.simplify": True,
        "path.simplify_threshold": 0.1,
        "timezone": "UTC",
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(width, height))
        left, right, bottom, top = 0.68, 0.2, 0.56, 0.36
        axes = figure.add_axes(
            (
                left / width,
                bottom / height,
                (width - left - right) / width,
                (height - bottom - top) / height,
            )
        )
        yield figure, axes


def to_svg(figure: "Figure", name: str) -> str:
    """Draw a figure as an ``<svg>`` element for inlining; call it inside `canvas`.

    Parameters
    ----------
    figure
        The figure, drawn in colours of `THEME`.
    name
        Name of the figure on its page; ids inside the drawing begin with it.

    Returns
    -------
    str
        The element, without XML declaration; text stays text. ``a_{b}`` and ``a^{b}`` in labels
        have become sub- and superscripts.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].strip()
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S)
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>\s*", "", text, flags=re.S)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.S)
    text = re.sub(r"(<svg[^>]*?) width=\"[^\"]*\"", r"\1", text, count=1)
    text = re.sub(r"(<svg[^>]*?) height=\"[^\"]*\"", r"\1", text, count=1)
    text = text.replace("<svg ", '<svg stroke-linejoin="round" ', 1)
    text = re.sub(r' d="([^"]*)"', lambda m: f' d="{compact_path(m[1])}"', text)
    text = re.sub(r' (x|y)="([^"]*)"', lambda m: f' {m[1]}="{_short(m[2])}"', text)
    text = re.sub(
        r' transform="([^"]*)"',
        lambda m: f' transform="{_PLAIN_NUMBER.sub(lambda n: _short(n[0]), m[1])}"',
        text,
    )
    text = re.sub(r">([^<>]+)</text>", lambda m: f">{_raise_and_lower(m[1])}</text>", text)
    text = text.replace("'DejaVu Sans'", FONT_STACK)
    return follow_theme(_own_ids(re.sub(r">\s+<", "><", text), name))


def follow_theme(svg: str) -> str:
    """Replace the light colours of the theme by ``var(--role, #colour)`` in style attributes."""
    for role, (light, _) in THEME.items():
        svg = re.sub(rf"(?<!, ){light}", f"var(--{role}, {light})", svg)
    return svg


def compact_path(data: str) -> str:
    """Rewrite SVG path data in relative coordinates, to a tenth of a unit.

    Differences are taken between rounded absolute positions, so errors do not add up.
    """
    out: list[str] = []
    last = (0, 0)
    start = (0, 0)
    for command, arguments in re.findall(r"([MLQCzZ])([^MLQCzZ]*)", data):
        if command in "zZ":
            out.append("z")
            last = start
            continue
        numbers = [round(float(value) * 10) for value in arguments.split()]
        points = list(zip(numbers[::2], numbers[1::2], strict=True))
        if command == "L" and points[-1] == last:
            continue
        moves = [_tenth(x - last[0]) + _tenth(y - last[1], glue=True) for x, y in points]
        if command == "M":
            out.append(f"M{_tenth(points[0][0])}{_tenth(points[0][1], glue=True)}")
            start = points[-1]
        else:
            out.append(command.lower() + " ".join(moves))
        last = points[-1]
    return "".join(out)


def _tenth(value: int, *, glue: bool = False) -> str:
    text = f"{value / 10:g}" if value % 10 else str(value // 10)
    text = text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text
    return text if not glue or text.startswith("-") else f" {text}"


def _short(number: str) -> str:
    try:
        return f"{round(float(number), 2):g}"
    except ValueError:
        return number


def _raise_and_lower(text: str) -> str:
    """Turn ``a_{b}`` and ``a^{b}`` into shifted spans; all browsers know ``dy``."""

    def span(match: re.Match[str]) -> str:
        shift = 0.22 if match[1] == "_" else -0.38
        size = 0.74
        return (
            f'<tspan dy="{shift / size:.2f}em" font-size="{size}em">{match[2]}</tspan>'
            f'<tspan dy="{-shift:.2f}em">&#8203;{match[3]}</tspan>'
        )

    return re.sub(r"([_^])\{([^}]*)\}([^_^]*)", span, text)


def _own_ids(svg: str, name: str) -> str:
    used = set(re.findall(r"(?:url\(#|href=\"#)([^\")]+)", svg))

    def rename(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in used else ""

    svg = re.sub(r' id="([^"]*)"', rename, svg)
    return re.sub(r"(url\(#|href=\"#)", rf"\g<1>{name}-", svg)
