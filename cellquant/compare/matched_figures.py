"""Figures of a comparison: experiments in one drawing, simulations in the other, same axes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cellquant.compare.figures import (
    Curve,
    Mark,
    Scale,
    common_limits,
    count_legend_rows,
    crossing,
    draw_curves,
)
from cellquant.compare.groups import Group
from cellquant.compare.page import Figure, Panel
from cellquant.compare.panels import join_curves, shape_limits
from cellquant.compare.sources import with_sources

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.compare.pictures import MaskFrame
    from cellquant.io import LabelStack

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
MAX_CURVES = 6
MAX_PICTURES = 3
MAX_PATH_POINTS = 2500
MAX_STEPS = 5  # moments of a layer to step through
ALL = 2**31  # frames, more than any recording has
SQUARE = 8.0  # mean diameters, edge of the enlarged part of the trajectories
Measure = Callable[[Group, int], list[Curve]]


def shape_figure(groups: Sequence[Group]) -> Figure | None:
    """P(p) of both sides."""

    def measure(group: Group, series: int) -> list[Curve]:
        curve = group.curve("shape_index", x="shape_index", series=series)
        return [] if curve is None else [curve]

    sides = _by_side(groups, measure)
    every = [curve for _, curves in sides for curve in curves]
    if not every:
        return None
    tops = [c.y if c.error is None else c.y + np.nan_to_num(c.error) for c in every]
    top = 1.06 * max(float(np.nanmax(y)) for y in tops)
    return _paired(
        sides,
        name="shape-index",
        title="Distribution of the shape index",
        caption="Bands are standard errors. The area under each curve is 1.",
        alt="Distributions of the shape index",
        x=Scale("shape index p = P/√A", limits=shape_limits(every)),
        y=Scale("P(p)", limits=(0.0, top)),
        column="shape_index",
    )


def scattering_figure(groups: Sequence[Group]) -> Figure | None:
    """F_s against t/tau_alpha."""
    sides = _by_side(groups, _scaled("self_intermediate_scattering", by_tau=True))
    every = [curve for _, curves in sides for curve in curves]
    if not every:
        return None
    lowest = min(float(np.nanmin(curve.y)) for curve in every)
    return _paired(
        sides,
        name="self-intermediate-scattering",
        title="Memory of places: self-intermediate scattering",
        caption="At q = 2π/d. The dotted line is 1/e. Where some of the recordings do not relax "
        "while they last, time is in units of that at which the mean curve falls to 1/e; where it "
        "does not fall so far either, the group is left out here.",
        alt="F_s against time in units of the relaxation time",
        x=Scale("t/τ_{α}", log=True, limits=common_limits([c.x for c in every], log=True)),
        y=Scale("F_{s}(q, t)", limits=(min(-0.08, lowest - 0.02), 1.08)),
        marks=(Mark(float(np.exp(-1)), "1/e", axis="y"),),
        column="lag_over_tau_alpha",
        own_time=groups,
    )


def displacement_figure(groups: Sequence[Group]) -> Figure | None:
    """MSD/d^2 against t/tau_alpha."""
    sides = _by_side(groups, _scaled("msd", by_tau=True, by_area=True))
    every = [curve for _, curves in sides for curve in curves]
    if not every:
        return None
    return _paired(
        sides,
        name="mean-square-displacement",
        title="Mean square displacement",
        caption="In units of the squared mean diameter.",
        alt="Mean square displacement against time, both logarithmic",
        x=Scale("t/τ_{α}", log=True, limits=common_limits([c.x for c in every], log=True)),
        y=Scale("MSD/d^{2}", log=True, limits=common_limits([c.y for c in every], log=True)),
        column="lag_over_tau_alpha",
        own_time=groups,
    )


def hove_figure(groups: Sequence[Group]) -> Figure | None:
    """Self van Hove function at tau_alpha, with the fits of core and tail."""

    def measure(group: Group, series: int) -> list[Curve]:
        curve = group.curve("van_hove", x="r", series=series)
        if curve is None:
            return []
        drawn = [replace(curve, y=np.where(curve.y > 0, curve.y, np.nan), kind="points")]
        data = group.members[0].tables["van_hove"]
        for fit in ("gaussian", "exponential"):
            if fit in data.columns:
                drawn.append(
                    Curve("", data["r"].to_numpy(np.float64), data[fit].to_numpy(np.float64), None,
                          series, "dashes" if fit == "gaussian" else "line")
                )  # fmt: skip
        return drawn

    sides = _by_side(groups, measure)
    every = [curve for _, curves in sides for curve in curves if curve.label]
    if not every:
        return None
    return _paired(
        sides,
        name="van-hove",
        title="Displacements after one relaxation time: van Hove function",
        caption="Probability per area of a displacement r at t = τ_{α}, r in units of d. Dashed: "
        "Gaussian fit of the core, exp(−r^{2}/σ^{2}) with σ^{2} the mean square displacement of "
        "the core; full line: exponential fit of the tail, exp(−r/ξ). Fits are those of the first "
        "trial; bars are standard errors.",
        alt="Van Hove functions with Gaussian core and exponential tail",
        x=Scale("r/d", limits=(0.0, max(float(np.nanmax(c.x)) for c in every))),
        y=Scale("G_{s}(r, τ_{α}) d^{2}", log=True,
                limits=common_limits([c.y for c in every], log=True)),
        column="r_over_d",
    )  # fmt: skip


def layer_figure(groups: Sequence[Group]) -> Figure | None:
    """Segmented frames of a movie beside snapshots of the model, to step through."""
    from cellquant.compare.pictures import STEP_PIXELS, contours_of, draw_contours, draw_masks

    panels = []
    for index, group in enumerate(with_pictures(groups)):
        result = group.members[0]
        name = f"layer-{index + 1}"
        if result.stack is not None:
            frames = _mask_frames(group, result.stack)
            calibration = result.stack.calibration
            svg = draw_masks(
                frames,
                shown=len(frames) - 1,
                pixel_size=calibration.pixel_size,
                units=calibration.units,
                step_pixels=STEP_PIXELS,
            )
            words = (
                f"Segmented cells of {group.name} in different colours at {frames[-1].title}, the "
                "last frame."
            )
        elif result.run is not None:
            run = result.run
            times = np.asarray(run.time, dtype=np.float64)
            interval = float(times[1] - times[0]) if times.size > 1 else 1.0
            titles = {
                frame: f"t = {times[frame] - times[0]:g} t₀"
                for frame in _steps(group, times.size, interval)
            }
            *others, last = titles
            svg = draw_contours(
                *contours_of(run),
                units=result.units,
                title=titles[last],
                earlier=[(titles[f], contours_of(run, frame=f, points=24)[0]) for f in others],
            )
            words = f"Contours of all cells of {group.name} at the end of the run."
        else:
            continue
        panels.append(Panel(name, svg, words, group.name))
    if not panels:
        return None
    return Figure(
        name="layer",
        title="The layer at work",
        caption="The first recording of each group at its end; step back through the two "
        "relaxation times before, or the whole recording where τ_{α} is not known or it is "
        "shorter. Movies: segmented cells. Simulations: contours of all cells; the layer continues "
        "periodically at its edges. A cell keeps its colour; grey ones are not followed.",
        panels=tuple(panels),
        wide=True,
    )


def _steps(group: Group, n_frames: int, interval: float) -> list[int]:
    """Up to `MAX_STEPS` frames, evenly over the last two relaxation times, the last included."""
    last = n_frames - 1
    first = max(0, last - _two_relaxations(group, interval)) if last else 0
    return sorted(set(np.linspace(first, last, MAX_STEPS).round().astype(int).tolist()))


def _mask_frames(group: Group, stack: "LabelStack") -> "list[MaskFrame]":
    from cellquant.compare.pictures import MaskFrame

    tracks = group.members[0].tracks
    frames = []
    for index in _steps(group, len(stack), stack.calibration.frame_interval):
        number = stack.frame_numbers[index]
        title, known = f"frame {number}", None
        if tracks is not None:
            here = tracks.table[tracks.table["frame"] == number]
            known = dict(zip(here["label"].tolist(), here["track_id"].tolist(), strict=True))
            if tracks.units.time != "frame":
                title = f"t = {number * tracks.frame_interval:g} {tracks.units.time}"
        frames.append(MaskFrame(stack[index], title, identities=known))
    return frames


def path_figures(groups: Sequence[Group]) -> list[Figure]:
    """Trajectories of the whole layer, and a window of the same size in cell diameters."""
    import pandas as pd

    from cellquant.compare.pictures import draw_paths, thin_paths
    from cellquant.tables import Units

    views: dict[str, list[Panel]] = {"whole": [], "close": []}
    data: dict[str, list[pd.DataFrame]] = {"whole": [], "close": []}
    for index, group in enumerate(with_pictures(groups)):
        tracks = group.members[0].tracks
        d = group.scalars().get("wave_number.mean_diameter")
        if tracks is None or d is None or tracks.table.empty:
            continue
        table = tracks.table[["track_id", "frame", "x", "y"]].copy()
        table[["x", "y"]] /= d.value
        recent, span = _recent(table, group, tracks.frame_interval)
        if tracks.box is None:
            low, high = table[["x", "y"]].min().to_numpy(), table[["x", "y"]].max().to_numpy()
        else:
            low, high = np.zeros(2), np.array(tracks.box) / d.value
            ends = recent.groupby("track_id")[["x", "y"]].transform("last")
            recent = recent.assign(**(recent[["x", "y"]] - np.floor(ends / high) * high))
        middle = 0.5 * (low + high)
        square = (middle[0] - SQUARE / 2, middle[0] + SQUARE / 2,
                  middle[1] - SQUARE / 2, middle[1] + SQUARE / 2)  # fmt: skip
        inside = recent["x"].between(*square[:2]) & recent["y"].between(*square[2:])
        near = recent[recent["track_id"].isin(recent.loc[inside, "track_id"].unique())]
        units = Units("d", tracks.units.time)
        for view, chosen, window in (
            ("whole", recent, (low[0], high[0], low[1], high[1])),
            ("close", near, square),
        ):
            paths = thin_paths(chosen, max_points=MAX_PATH_POINTS)
            if paths.empty:
                continue
            name = f"paths-{view}-{index + 1}"
            svg = draw_paths(paths, name, units=units, window=window,
                             frame=square if view == "whole" else None)  # fmt: skip
            shown = "in the marked square" if view == "close" else "in view"
            words = f"Paths of the cells of {group.name} {shown}, over {span}."
            views[view].append(Panel(name, svg, words, group.name))
            # Short rows: these are the longest tables of the page.
            data[view].append(paths.round({"x": 3, "y": 3}).assign(drawing=len(views[view])))
    captions = {
        "whole": (
            "Trajectories",
            "The last two relaxation times, or the whole recording where τ_{α} is not known or the "
            "recording is shorter. Dots mark where the paths end; lengths are in mean cell "
            "diameters d. Of a simulated layer, which is periodic, one period is shown. The marked "
            "square is enlarged below. In the CSV, drawing counts from 1.",
        ),
        "close": (
            "Trajectories, enlarged to the same scale",
            f"A square of {SQUARE:g} by {SQUARE:g} cell diameters on every side, so that paths can "
            "be compared by eye.",
        ),
    }
    return [
        Figure(f"paths-{view}", *captions[view], tuple(panels),
               pd.concat(data[view], ignore_index=True), wide=True)
        for view, panels in views.items() if panels
    ]  # fmt: skip


def _recent(
    table: "pd.DataFrame", group: Group, frame_interval: float
) -> "tuple[pd.DataFrame, str]":
    """The part of the trajectories that lies in the last two relaxation times."""
    span = _two_relaxations(group, frame_interval)
    known = span < ALL
    words = "the last two relaxation times" if known else "the whole recording"
    return table[table["frame"] > table["frame"].max() - span] if known else table, words


def _two_relaxations(group: Group, frame_interval: float) -> int:
    """Two relaxation times in frames; `ALL` where the relaxation time is not known."""
    tau = group.scalars().get("tau_alpha.value")
    if tau is None or not math.isfinite(tau.value):
        return ALL
    return max(2, round(2 * tau.value / frame_interval))


def add_sources(groups: Sequence[Group]) -> list[Group]:
    """Add trajectories, masks and runs to the groups whose pictures will be shown."""
    taken = {False: 0, True: 0}
    out = []
    for group in groups:
        taken[group.simulated] += 1
        if taken[group.simulated] > MAX_PICTURES:
            out.append(group)
            continue
        first, *rest = group.trials.items()
        head = (with_sources(first[1][0]), *first[1][1:])
        out.append(replace(group, trials={first[0]: head, **dict(rest)}))
    return out


def with_pictures(groups: Sequence[Group]) -> list[Group]:
    """The first few groups of each side that have something to show."""
    shown = []
    for simulated in (False, True):
        shown += [g for g in groups if g.simulated is simulated][:MAX_PICTURES]
    return [g for g in shown if g.members[0].tracks is not None]


def _by_side(groups: Sequence[Group], measure: Measure) -> list[tuple[str, list[Curve]]]:
    sides = []
    for title, simulated in (("Experiment", False), ("Simulation", True)):
        members = [(i, g) for i, g in enumerate(groups) if g.simulated is simulated]
        curves: list[Curve] = []
        for series, group in members[:MAX_CURVES]:
            curves += measure(group, series)
        if curves:
            if len(members) > MAX_CURVES:
                title = f"{title} ({MAX_CURVES} of {len(members)})"
            sides.append((title, curves))
    return sides


def _scaled(table: str, *, by_tau: bool, by_area: bool = False) -> Measure:
    def measure(group: Group, series: int) -> list[Curve]:
        curve = group.curve(table, series=series)
        tau, d = _time_unit(group), group.scalars().get("wave_number.mean_diameter")
        if curve is None or not math.isfinite(tau):
            return []
        if by_area and d is None:
            return []
        unit = d.value**2 if by_area and d is not None else 1.0
        error = None if curve.error is None else curve.error / unit
        return [replace(curve, x=curve.x / tau, y=curve.y / unit, error=error)]

    return measure


def _time_unit(group: Group) -> float:
    """tau_alpha; where a trial does not reach it, the time at which the mean F_s falls to 1/e."""
    tau = group.scalars().get("tau_alpha.value")
    if tau is None or math.isfinite(tau.value):
        return math.nan if tau is None else tau.value
    curve = group.curve("self_intermediate_scattering")
    return math.nan if curve is None else crossing(curve)


def _paired(
    sides: Sequence[tuple[str, Sequence[Curve]]],
    *,
    name: str,
    title: str,
    caption: str,
    alt: str,
    x: Scale,
    y: Scale,
    column: str,
    marks: Sequence[Mark] = (),
    own_time: Sequence[Group] = (),
) -> Figure:
    rows = max(count_legend_rows(curves) for _, curves in sides)
    panels = []
    for index, (side, curves) in enumerate(sides):
        single = [c.label for c in curves if c.label]
        panel_name = f"{name}-{index + 1}"
        svg = draw_curves(
            curves,
            panel_name,
            x=x,
            y=y,
            marks=marks,
            legend_rows=rows,
            top=_own_time(own_time, single[0]) if own_time and single else None,
        )
        named = len(single) == 1 and single[0].lower() != side.lower()
        label = f"{side}: {single[0]}" if named else side
        panels.append(Panel(panel_name, svg, f"{alt}; {side.lower()}.", label))
    every = {f"{side}: {c.label}": c for side, curves in sides for c in curves if c.label}
    return Figure(name, title, caption, tuple(panels), join_curves(every, column), wide=True)


def _own_time(groups: Sequence[Group], label: str) -> tuple[float, str] | None:
    for group in groups:
        tau = group.scalars().get("tau_alpha.value")
        unit = _time_unit(group)
        if group.name == label and tau is not None and math.isfinite(unit):
            return unit, f"t ({tau.unit}), {label}"
    return None
