"""The figures of the reports: what is drawn of a layer, and what each figure says in words."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.compare.figures import (
    Curve,
    Mark,
    Scale,
    common_limits,
    draw_curves,
)
from cellquant.compare.page import Figure, Panel, format_value
from cellquant.compare.pictures import MaskFrame, draw_masks, draw_paths, thin_paths
from cellquant.compare.results import Result, curve_of, look_up, pretty_unit, scale_of, unit_text

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.io import ImageStack, LabelStack
    from cellquant.tables import Cells, Tracks

MAX_STEPS = 9  # frames to step through


def masks_figure(
    stack: "LabelStack", tracks: "Tracks", *, raw: "ImageStack | None" = None
) -> Figure:
    """The segmented middle frame with a scale bar, and others to step through.

    Outlines on the recorded image when it is given.
    """
    middle = len(stack) // 2
    indices = {middle, *np.linspace(0, len(stack) - 1, MAX_STEPS).round().astype(int).tolist()}
    unit = tracks.units.time
    frames = []
    for index in sorted(indices):
        number = stack.frame_numbers[index]
        here = tracks.table[tracks.table["frame"] == number]
        frames.append(
            MaskFrame(
                stack[index],
                f"frame {number}" + _moment(number * tracks.frame_interval, unit),
                None if raw is None else raw[index],
                dict(zip(here["label"].tolist(), here["track_id"].tolist(), strict=True)),
            )
        )
    shown = sorted(indices).index(middle)
    calibration = stack.calibration
    svg = draw_masks(
        frames, shown=shown, pixel_size=calibration.pixel_size, units=calibration.units
    )
    number, count = stack.frame_numbers[middle], len(frames[shown].identities or {})
    here = tracks.table[tracks.table["frame"] == number]
    what = "Outlines of the cells on the recorded image" if raw is not None else "Label masks"
    colours = "A cell keeps its colour from frame to frame."
    return Figure(
        name="segmented-frame",
        title="Segmented frame",
        caption=f"{what} of {frames[shown].title}, {count} cells. {colours}",
        panels=(
            Panel(
                "segmented-frame",
                svg,
                f"Frame {number} with {count} segmented cells in different colours and a "
                "scale bar.",
            ),
        ),
        data=here[["frame", "label", "track_id", "x", "y", "area", "shape_index"]],
    )


def _moment(time: float, unit: str) -> str:
    return "" if unit == "frame" else f" (t = {time:g} {pretty_unit(unit)})"


def density_figure(tracks: "Tracks", cells: "Cells | None") -> Figure:
    """Number of cells and number density of every frame."""
    from cellquant.observables.windows import density_per_frame

    data = density_per_frame(tracks if cells is None else cells)
    scale, unit = scale_of((-2, 0), tracks.units)
    data["density"] *= scale
    data["count_per_area"] *= scale
    data.insert(1, "time", data["frame"] * tracks.frame_interval)
    time, density = (data[name].to_numpy(np.float64) for name in ("time", "density"))
    counts = data["n_cells"].to_numpy()
    svg = draw_curves(
        [Curve("", time, density)],
        "density",
        x=Scale(f"time ({pretty_unit(tracks.units.time)})"),
        y=Scale(f"density ({unit})"),
    )
    first, last = float(density[0]), float(density[-1])
    return Figure(
        name="density",
        title="Density while it was filmed",
        caption="Cells per area that cells can occupy, frame by frame; a cell cut by the border "
        f"counts one half. Between {int(counts.min())} and {int(counts.max())} cells in view.",
        panels=(
            Panel(
                "density",
                svg,
                f"Density against time, from {format_value(first)} to {format_value(last)} {unit}.",
            ),
        ),
        data=data,
    )


def shape_figure(results: Sequence[Result], *, name: str = "shape-index") -> Figure | None:
    """P(p) with mean, median and mode (for a single result)."""
    curves = [
        curve_of(r, "shape_index", x="shape_index", series=i,
                 kind="bars" if len(results) == 1 else "line")
        for i, r in enumerate(results)
    ]  # fmt: skip
    drawn = [c for c in curves if c is not None]
    if not drawn:
        return None
    marks = []
    if len(results) == 1:
        for key, word in (("mode", "mode"), ("median", "median"), ("mean", "mean")):
            value = look_up(results[0].summary, f"shape_index.{key}")
            if value is not None:
                marks.append(Mark(float(value), f"{word} {float(value):.3f}"))
    svg = draw_curves(
        drawn,
        name,
        x=Scale("shape index p = P/√A", limits=shape_limits(drawn)),
        y=Scale("P(p)", limits=(0.0, 1.12 * max(float(np.nanmax(c.y)) for c in drawn))),
        marks=sorted(marks, key=lambda mark: mark.value),
    )
    peak = float(drawn[0].x[np.nanargmax(drawn[0].y)])
    return Figure(
        name=name,
        title="Distribution of the shape index",
        caption="All cells away from the border, all frames pooled; the area under the curve is 1.",
        panels=(Panel(name, svg, f"Distribution of the shape index with its peak at {peak:.2f}."),),
        data=join_curves({c.label: c for c in drawn}, "shape_index"),
    )


def shape_limits(curves: Sequence[Curve]) -> tuple[float, float]:
    """Limits of p that show all but the last half per cent of every distribution."""
    lows, highs = [], []
    for curve in curves:
        weight = np.cumsum(np.nan_to_num(curve.y))
        if weight.size and weight[-1] > 0:
            fraction = weight / weight[-1]
            lows.append(curve.x[int(np.searchsorted(fraction, 0.0005))])
            highs.append(curve.x[min(int(np.searchsorted(fraction, 0.995)), curve.x.size - 1)])
    if not lows:
        return 3.4, 5.0
    low, high = float(min(lows)), float(max(highs))
    return low - 0.04 * (high - low), high + 0.04 * (high - low)


def scattering_figure(results: Sequence[Result]) -> Figure | None:
    """F_s(q, t) with the line 1/e and the relaxation time with its error."""
    name = "self-intermediate-scattering"
    drawn = _curves(results, "self_intermediate_scattering")
    if not drawn:
        return None
    marks = [Mark(float(np.exp(-1)), "1/e", axis="y")]
    words = "It does not fall to 1/e."
    if len(results) == 1:
        value = look_up(results[0].summary, "tau_alpha.value")
        error = look_up(results[0].summary, "tau_alpha.std_error")
        if value is not None:
            unit = pretty_unit(results[0].units.time)
            spread = None if error is None else float(error)
            text = f"τ_{{α}} = {format_value(float(value), spread)} {unit}"
            marks.append(Mark(float(value), text, error=spread))
            words = f"It crosses 1/e at {format_value(float(value))} {unit}."
    svg = draw_curves(
        drawn,
        name,
        x=Scale(f"lag time t ({pretty_unit(results[0].units.time)})", log=True),
        y=Scale("F_{s}(q, t)", limits=(-0.08, 1.08)),
        marks=marks,
    )
    return Figure(
        name=name,
        title="Memory of places: self-intermediate scattering",
        caption=f"F_{{s}}(q, t) at q = {_wave_number(results[0])}; the band is the standard error. "
        "Where the line 1/e is crossed, the layer has relaxed.",
        panels=(Panel(name, svg, f"F_s against lag time on a logarithmic axis. {words}"),),
        data=join_curves({c.label: c for c in drawn}, "lag_time"),
    )


def msd_figure(results: Sequence[Result]) -> Figure | None:
    """Mean square displacement, both axes logarithmic, with the slope of free diffusion."""
    name = "mean-square-displacement"
    drawn = _curves(results, "msd")
    if not drawn:
        return None
    unit = unit_text((2, 0), results[0].units)
    first = drawn[0]
    good = np.isfinite(first.y) & (first.y > 0) & (first.x > 0)
    guides: list[Curve] = []
    if len(drawn) == 1:
        drawn = [replace(first, label="measured")]
    if good.sum() > 3:
        lag, value = first.x[good], first.y[good]
        middle = len(lag) // 2
        span = np.geomspace(lag[middle], lag[-1], 20)
        guides.append(
            Curve(
                "slope 1: diffusion",
                span,
                0.55 * value[middle] * span / lag[middle],
                None,
                4,
                "dashes",
            )
        )
    svg = draw_curves(
        [*drawn, *guides],
        name,
        x=Scale(f"lag time t ({pretty_unit(results[0].units.time)})", log=True),
        y=Scale(f"MSD ({unit})", log=True, limits=common_limits([c.y for c in drawn], log=True)),
    )
    return Figure(
        name=name,
        title="Mean square displacement",
        caption="Relative to the drift of the whole layer. Parallel to the dashed line the cells "
        "diffuse; steeper, they go straight; flatter, they are caged.",
        panels=(Panel(name, svg, "Mean square displacement against lag time, both logarithmic."),),
        data=join_curves({c.label: c for c in drawn}, "lag_time"),
    )


def paths_figure(tracks: "Tracks") -> Figure | None:
    """All trajectories, and the middle of the picture enlarged."""
    paths = thin_paths(tracks.table)
    if paths.empty:
        return None
    table = tracks.table
    left, right = float(table["x"].min()), float(table["x"].max())
    low, high = float(table["y"].min()), float(table["y"].max())
    side = 0.22 * min(right - left, high - low)
    middle_x, middle_y = (left + right) / 2, (low + high) / 2
    zoom = (middle_x - side / 2, middle_x + side / 2, middle_y - side / 2, middle_y + side / 2)
    full = draw_paths(
        paths, "trajectories", units=tracks.units, window=(left, right, low, high), frame=zoom
    )
    inside = table["x"].between(*zoom[:2]) & table["y"].between(*zoom[2:])
    near = table[table["track_id"].isin(table.loc[inside, "track_id"].unique())]
    close = draw_paths(
        thin_paths(near, max_points=4000), "trajectories-zoom", units=tracks.units, window=zoom
    )
    shown = paths["track_id"].nunique()
    several = int((table["track_id"].value_counts() > 1).sum())
    part = "" if shown == several else f" {shown} of {several} tracks are drawn, the longest."
    return Figure(
        name="trajectories",
        title="Trajectories",
        caption="Paths of the cells as seen in the image, and the marked square enlarged; dots "
        f"mark where they end.{part}",
        panels=(
            Panel("trajectories", full, f"Paths of {shown} cells.", "All"),
            Panel("trajectories-zoom", close, "Paths in the marked square.", "Enlarged"),
        ),
        data=paths,
        wide=True,
    )


def linking_figure(tracks: "Tracks") -> Figure | None:
    """Displacements between frames beside the distances of nearest neighbours."""
    import pandas as pd

    steps, gaps = steps_and_gaps(tracks)
    if steps.size < 2 or gaps.size < 2:
        return None
    limit = float(max(np.quantile(steps, 0.995), np.quantile(gaps, 0.98)))
    edges = np.linspace(0, limit, 61)
    centres = (edges[1:] + edges[:-1]) / 2
    moved, apart = (np.histogram(v, edges)[0] / (v.size * edges[1]) for v in (steps, gaps))
    unit = unit_text((1, 0), tracks.units)
    marks = []
    reach = _search_range(tracks.provenance)
    if reach is not None and reach <= limit:
        marks.append(Mark(reach, "search range"))
    svg = draw_curves(
        [
            Curve("moved between frames", centres, moved, kind="bars"),
            Curve("to the nearest neighbour", centres, apart, series=1, kind="bars"),
        ],
        "linking",
        x=Scale(f"distance ({unit})", limits=(0.0, limit)),
        y=Scale(f"probability density ({unit_text((-1, 0), tracks.units)})"),
        marks=marks,
    )
    ratio = float(np.median(steps) / np.median(gaps))
    return Figure(
        name="linking",
        title="Steps and neighbours",
        caption=f"Median step {format_value(float(np.median(steps)))} {unit}, median distance to "
        f"the nearest neighbour {format_value(float(np.median(gaps)))} {unit}: a ratio of "
        f"{ratio:.2f}.",
        panels=(
            Panel(
                "linking",
                svg,
                f"Histograms of steps and of nearest-neighbour distances; the median step is "
                f"{ratio:.2f} of the median distance.",
            ),
        ),
        data=pd.DataFrame({"distance": centres, "step_density": moved, "neighbour_density": apart}),
    )


def steps_and_gaps(tracks: "Tracks") -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Displacements between consecutive frames, and distances to the nearest neighbour."""
    from scipy.spatial import cKDTree

    table = tracks.table.sort_values(["track_id", "frame"])
    x, y = table["x"].to_numpy(np.float64), table["y"].to_numpy(np.float64)
    follows = (np.diff(table["track_id"]) == 0) & (np.diff(table["frame"]) == 1)
    steps = np.hypot(np.diff(x), np.diff(y))[follows]
    gaps = []
    for _, rows in table.groupby("frame"):
        points = rows[["x", "y"]].to_numpy(np.float64)
        if tracks.box is not None:
            points = np.mod(points, tracks.box)
        if len(points) > 1:
            gaps.append(cKDTree(points, boxsize=tracks.box).query(points, k=2)[0][:, 1])
    return steps, np.concatenate(gaps) if gaps else np.zeros(0)


def _search_range(provenance: Mapping[str, Any]) -> float | None:
    for key in ("search_range", "max_distance"):
        value = provenance.get(key)
        if isinstance(value, int | float):
            return float(value)
    return None


def _wave_number(result: Result) -> str:
    q = look_up(result.summary, "wave_number.q")
    rule = look_up(result.summary, "wave_number.rule")
    words = {"2pi/d": "2π/d", "structure_factor_peak": "the first peak of S(q)"}
    text = words.get(str(rule), "")
    if q is None:
        return text or "the chosen wave number"
    number = f"{format_value(float(q))} {unit_text((-1, 0), result.units)}"
    return f"{text} = {number}" if text else number


def _curves(results: Sequence[Result], table: str) -> list[Curve]:
    found = [curve_of(r, table, series=i) for i, r in enumerate(results)]
    return [curve for curve in found if curve is not None]


def join_curves(curves: Mapping[str, Curve], x: str) -> "pd.DataFrame":
    """The points of several curves as one tidy table, its abscissa named `x`."""
    import pandas as pd

    parts = []
    for label, curve in curves.items():
        part = pd.DataFrame({x: curve.x, "value": curve.y})
        part["std_error"] = np.nan if curve.error is None else curve.error
        if len(curves) > 1:
            part.insert(0, "result", label)
        parts.append(part)
    return pd.concat(parts, ignore_index=True)
