"""Figures of a comparison: experiments in one drawing, simulations in the other, same axes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

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

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
MAX_CURVES = 6
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
