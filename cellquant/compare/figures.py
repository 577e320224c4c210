"""Drawings of curves, histograms and maps, in the style of the page."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.compare.page import MINUS, format_value
from cellquant.compare.svg import canvas, colour, series_colour, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
_WIDE = 2.2  # decades of a logarithmic axis from which numbers stand at powers of ten only
_LEGEND_WIDTH = 62  # characters in a row of the legend


@dataclass(frozen=True)
class Curve:
    """One line of a drawing.

    Attributes
    ----------
    label
        Its name in the legend.
    x, y
        (n,) points; those that are not finite are left out.
    error
        (n,) standard errors of y, drawn as a band; None where they are unknown.
    series
        Number of its colour.
    kind
        ``line``, ``points`` (with error bars), ``bars`` (x: centres of equal bins) or ``dashes``.
    """

    label: str
    x: FloatArray
    y: FloatArray
    error: FloatArray | None = None
    series: int = 0
    kind: str = "line"


@dataclass(frozen=True)
class Scale:
    """An axis: its label, whether it is logarithmic, and its limits, from the data when None."""

    label: str
    log: bool = False
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Mark:
    """A line to read a value off, across the drawing, with its name."""

    value: float
    label: str
    axis: str = "x"
    series: int | None = None
    error: float | None = field(default=None)


def draw_curves(
    curves: Sequence[Curve],
    name: str,
    *,
    x: Scale,
    y: Scale,
    marks: Sequence[Mark] = (),
    legend_rows: int | None = None,
    top: tuple[float, str] | None = None,
) -> str:
    """Draw curves in one pair of axes, as an ``<svg>`` element.

    Parameters
    ----------
    curves
        What to draw, in the order of the legend.
    name
        Name of the drawing on its page.
    x, y
        The axes.
    marks
        Lines at values worth reading off.
    legend_rows
        Height kept for the legend, so that drawings beside each other match; from the curves
        when None.
    top
        A second scale of x above the axes: factor from x to it, and its label.
    """
    rows = count_legend_rows(curves) if legend_rows is None else legend_rows
    above = 0.2 * rows + (0.42 if top is not None else 0.0)
    with canvas(height=3.3 + above) as (figure, axes):
        place = axes.get_position()
        height = figure.get_figheight()
        share = (height - 0.16 - above) / height
        axes.set_position((place.x0, place.y0, place.width, share - place.y0))
        for curve in curves:
            _draw(axes, curve)
        _set_scales(axes, x, y)
        for mark in marks:
            _draw_mark(axes, mark)
        if top is not None:
            _draw_top_scale(axes, *top, log=x.log)
        if count_legend_rows(curves):
            axes.legend(
                loc="lower left",
                bbox_to_anchor=(
                    -0.02,
                    1.0 if top is None else 1.0 + 0.42 / (share * height - 0.56),
                ),
                ncols=_legend_columns(curves),
                borderaxespad=0.2,
                handletextpad=0.5,
                columnspacing=1.4,
                labelspacing=0.3,
            )
        return to_svg(figure, name)


def crossing(curve: Curve) -> float:
    """Lag at which a curve first falls to 1/e, by linear interpolation; NaN where it does not."""
    level = math.exp(-1)
    below = np.flatnonzero(curve.y <= level)
    if below.size == 0 or below[0] == 0:
        return math.nan
    i = int(below[0])
    (x0, x1), (y0, y1) = curve.x[i - 1 : i + 1], curve.y[i - 1 : i + 1]
    return float(x0 + (y0 - level) / (y0 - y1) * (x1 - x0))


def count_legend_rows(curves: Sequence[Curve]) -> int:
    """Rows that the legend of these curves takes; none for a single curve."""
    named = [c for c in curves if c.label]
    return math.ceil(len(named) / _legend_columns(curves)) if len(named) > 1 else 0


def _legend_columns(curves: Sequence[Curve]) -> int:
    named = [c for c in curves if c.label]
    longest = max((len(c.label.replace("_{", "").replace("}", "")) for c in named), default=1)
    return max(1, min(len(named), 4, _LEGEND_WIDTH // (longest + 6)))


def common_limits(
    values: Sequence[FloatArray], *, log: bool = False, margin: float = 0.04
) -> tuple[float, float] | None:
    """Limits that hold all finite values (all positive ones on a logarithmic axis)."""
    joined = np.concatenate([np.zeros(0), *(np.asarray(v, dtype=np.float64) for v in values)])
    joined = joined[np.isfinite(joined) & ((joined > 0) | (not log))]
    if joined.size == 0:
        return None
    low, high = float(joined.min()), float(joined.max())
    if log:
        factor = (high / low) ** margin if high > low else 2.0
        return low / factor, high * factor
    pad = margin * (high - low) or abs(high) * 0.1 or 1.0
    return low - pad, high + pad


def draw_map(
    values: FloatArray,
    name: str,
    *,
    x: tuple[str, Sequence[float]],
    y: tuple[str, Sequence[float]],
    limits: tuple[float, float],
    errors: FloatArray,
) -> str:
    """Draw a table of numbers as coloured fields with the numbers written in them.

    Parameters
    ----------
    values
        (len(y values), len(x values)); NaN fields stay empty and are marked with a dash.
    x, y
        Label and values of columns and rows.
    limits
        Values of the first and last colour, the same for maps that stand beside each other.
    errors
        Same shape, standard errors, written below the numbers.
    """
    import matplotlib as mpl

    columns, rows = len(x[1]), len(y[1])
    shades = mpl.colormaps["cividis"]
    span = (limits[1] - limits[0]) or 1.0
    with canvas(height=max(2.2, 0.62 * rows + 1.1)) as (figure, axes):
        for row in range(rows):
            for column in range(columns):
                value = values[row, column]
                if not np.isfinite(value):
                    axes.text(column, row, "–", ha="center", va="center", color=colour("muted"))
                    continue
                shade = shades((value - limits[0]) / span)
                axes.add_patch(
                    mpl.patches.Rectangle(
                        (column - 0.49, row - 0.48), 0.98, 0.96, facecolor=shade, linewidth=0
                    )
                )
                channel = np.array(shade[:3])
                linear = np.where(
                    channel <= 0.04045, channel / 12.92, ((channel + 0.055) / 1.055) ** 2.4
                )
                luminance = float(linear @ (0.2126, 0.7152, 0.0722))
                text = format_value(float(value), float(errors[row, column]))
                axes.text(
                    column,
                    row,
                    text.replace(" ± ", "\n± "),
                    ha="center",
                    va="center",
                    fontsize=9,
                    color="#000000" if luminance > 0.179 else "#ffffff",
                )
        axes.set_xlim(-0.5, columns - 0.5)
        axes.set_ylim(-0.5, rows - 0.5)
        axes.set_xticks(range(columns), [f"{v:g}" for v in x[1]])
        axes.set_yticks(range(rows), [f"{v:g}" for v in y[1]])
        axes.set_xlabel(x[0])
        axes.set_ylabel(y[0])
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        return to_svg(figure, name)


def _draw(axes: "Axes", curve: Curve) -> None:
    finite = np.isfinite(curve.x) & np.isfinite(curve.y)
    x, y = curve.x[finite], curve.y[finite]
    shade = series_colour(curve.series)
    if curve.kind == "bars":
        width = float(np.min(np.diff(x))) if x.size > 1 else 1.0
        axes.stairs(
            y,
            np.append(x - width / 2, x[-1:] + width / 2),
            fill=True,
            facecolor=shade,
            alpha=0.28,
            label=curve.label,
        )
        axes.stairs(y, np.append(x - width / 2, x[-1:] + width / 2), color=shade, linewidth=1.2)
        return
    error = None if curve.error is None else curve.error[finite]
    if curve.kind == "points":
        bars = None if error is None else np.nan_to_num(error)
        axes.errorbar(
            x, y, bars, color=shade, label=curve.label, fmt="o", markersize=4.5, elinewidth=1.1
        )
        return
    dashes: dict[str, Any] = (
        {"linestyle": (0, (4, 2.5)), "linewidth": 1.3} if curve.kind == "dashes" else {}
    )
    axes.plot(x, y, color=shade, label=curve.label, **dashes)
    if error is not None and np.isfinite(error).any():
        spread = np.nan_to_num(error)
        axes.fill_between(x, y - spread, y + spread, color=shade, alpha=0.2, linewidth=0)


def _draw_mark(axes: "Axes", mark: Mark) -> None:
    shade = colour("muted") if mark.series is None else series_colour(mark.series)
    if mark.axis == "y":
        axes.axhline(mark.value, color=shade, linewidth=1, linestyle=(0, (2, 2)))
        axes.annotate(
            mark.label,
            (1.0, mark.value),
            xycoords=("axes fraction", "data"),
            xytext=(-2, 3),
            textcoords="offset points",
            ha="right",
            fontsize=9,
            color=shade,
        )
        return
    if mark.error is not None and np.isfinite(mark.error) and mark.error > 0:
        axes.axvspan(
            mark.value - mark.error, mark.value + mark.error, color=shade, alpha=0.16, lw=0
        )
    axes.axvline(mark.value, color=shade, linewidth=1, linestyle=(0, (2, 2)))
    low, high = axes.get_xlim()
    if axes.get_xscale() == "log":
        fraction = math.log(mark.value / low) / math.log(high / low)
    else:
        fraction = (mark.value - low) / (high - low)
    right = fraction > 0.72
    # Marks close to each other step down, so that their names stay apart.
    step = sum(1 for text in axes.texts if text.get_gid() == "mark")
    text = axes.annotate(
        mark.label,
        (mark.value, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(-4 if right else 4, -9 - 12 * step),
        textcoords="offset points",
        ha="right" if right else "left",
        fontsize=9,
        color=shade,
        bbox={"facecolor": colour("ground"), "edgecolor": "none", "alpha": 0.8, "pad": 0.6},
    )
    text.set_gid("mark")


def _set_scales(axes: "Axes", x: Scale, y: Scale) -> None:
    from matplotlib.ticker import (
        FuncFormatter,
        LogLocator,
        MaxNLocator,
        NullFormatter,
        NullLocator,
    )

    for scale, axis, set_scale, set_limits in (
        (x, axes.xaxis, axes.set_xscale, axes.set_xlim),
        (y, axes.yaxis, axes.set_yscale, axes.set_ylim),
    ):
        axis.set_label_text(scale.label)
        if axis is axes.yaxis:
            # At a fixed distance from the edge, whatever the width of the numbers.
            figure = axes.get_figure(root=True)
            assert figure is not None
            place = axes.get_position()
            centre = place.y0 + place.height / 2
            axis.set_label_coords(0.2 / figure.get_figwidth(), centre, transform=figure.transFigure)
        if scale.log:
            set_scale("log")
        if scale.limits is not None:
            set_limits(*scale.limits)
        if not scale.log:
            axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
            continue
        low, high = axis.get_view_interval()
        decades = math.log10(high / low) if low > 0 else 1.0
        if decades < 0.9:
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
            axis.set_major_formatter(FuncFormatter(_log_tick))
            axis.set_minor_locator(NullLocator())
            continue
        wide = decades > _WIDE
        axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(_log_tick))
        # A tick costs a millisecond: over many decades two in each are enough.
        axis.set_minor_locator(
            LogLocator(subs=(2.0, 5.0) if wide else (3.0, 4.0, 6.0, 7.0, 8.0, 9.0))
        )
        axis.set_minor_formatter(NullFormatter())
        axis.set_tick_params(which="minor", length=2)


def _draw_top_scale(axes: "Axes", factor: float, label: str, *, log: bool) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    def there(value: Any) -> Any:
        return np.asarray(value) * factor

    def back(value: Any) -> Any:
        return np.asarray(value) / factor

    second = axes.secondary_xaxis("top", functions=(there, back))
    second.set_xlabel(label, color=colour("muted"), fontsize=9)
    second.tick_params(labelsize=8, labelcolor=colour("muted"), length=2.5)
    if log:
        low, high = axes.get_xlim()
        wide = math.log10(high / low) > _WIDE
        second.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
        second.xaxis.set_major_formatter(FuncFormatter(_log_tick))
        second.xaxis.set_minor_locator(NullLocator())


def draw_boxes(boxes: Sequence[tuple[str, int, Sequence[float]]], name: str, *, label: str) -> str:
    """Draw distributions as lying boxes: quantiles 0.05, 0.25, 0.5, 0.75 and 0.95.

    Parameters
    ----------
    boxes
        (name, number of the colour, the five quantiles) of each, from top to bottom.
    label
        Label of the axis.
    """
    from matplotlib.ticker import MaxNLocator

    with canvas(height=0.85 + 0.52 * len(boxes)) as (figure, axes):
        place = axes.get_position()
        axes.set_position((0.02, place.y0, 0.95, 0.98 - place.y0))
        for row, (title, series, quantiles) in enumerate(boxes):
            low, first, middle, third, high = quantiles
            shade = series_colour(series)
            axes.plot([low, high], [row, row], color=shade, linewidth=1.2)
            axes.barh(row, third - first, 0.36, first, color=shade, alpha=0.35)
            axes.plot([middle, middle], [row - 0.18, row + 0.18], color=shade, linewidth=2.2)
            axes.annotate(title, (0, row), (0, 10), xycoords=("axes fraction", "data"),
                          textcoords="offset points", fontsize=9)  # fmt: skip
        axes.set_ylim(len(boxes) - 0.4, -0.75)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
        axes.set_xlabel(label)
        return to_svg(figure, name)


def _log_tick(value: float, _position: int | None) -> str:
    if value <= 0:
        return ""
    if 1e-3 < value < 1e5:
        return f"{value:g}"
    exponent = math.floor(math.log10(value) + 1e-9)
    mantissa = value / 10.0**exponent
    power = f"10^{{{str(exponent).replace('-', MINUS)}}}"
    return power if abs(mantissa - 1) < 1e-6 else f"{mantissa:g}·{power}"
