"""Figures over many groups: relaxation against crowding, quantiles, maps of a sweep."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cellquant.compare.figures import (
    Curve,
    Scale,
    common_limits,
    count_legend_rows,
    draw_boxes,
    draw_curves,
    draw_map,
)
from cellquant.compare.groups import Group
from cellquant.compare.page import Figure, Panel
from cellquant.compare.results import look_up, pretty_unit

if TYPE_CHECKING:
    from cellquant.compare.comparison import Comparison

MAX_CURVES = 6


def relaxation_figure(comparison: "Comparison") -> Figure | None:
    """tau_alpha against density, beside tau_alpha against packing fraction."""
    import pandas as pd

    area = comparison.area[0] * 1e-6
    sides: list[tuple[str, list[Curve]]] = []
    movies = [
        c for i, g in enumerate(comparison.experiments) if (c := _against_density(g, i, area))
    ]
    models = _against_packing(comparison.simulations)
    for title, curves in (("Experiment", movies), ("Simulation", models)):
        if curves:
            sides.append((title, curves[:MAX_CURVES]))
    every = [curve for _, curves in sides for curve in curves]
    if not any(curve.x.size > 1 for curve in every):
        return None
    rows = []
    scaled = []
    for title, curves in sides:
        # Each side in units of its own value where it is least crowded.
        order = min(curves, key=lambda c: float(c.x[0]))
        unit = float(order.y[0])
        parts = [
            replace(c, y=c.y / unit, error=None if c.error is None else c.error / unit)
            for c in curves
        ]
        scaled.append((title, parts))
        rows += [
            pd.DataFrame({"result": c.label, "packing_fraction": c.x, "tau_alpha": c.y,
                          "tau_alpha_scaled": c.y / unit}) for c in curves
        ]  # fmt: skip
    limits = common_limits([c.x for _, cs in scaled for c in cs])
    heights = common_limits([c.y for _, cs in scaled for c in cs], log=True)
    density_at = f"density of cells of {comparison.area[0]:.0f} µm^{{2}} (1/mm^{{2}})"
    legend = max(count_legend_rows(curves) for _, curves in scaled)
    panels = []
    for index, (title, curves) in enumerate(scaled):
        movie = title == "Experiment"
        panels.append(
            Panel(
                f"relaxation-times-{index + 1}",
                draw_curves(
                    curves,
                    f"relaxation-times-{index + 1}",
                    x=Scale("effective packing fraction φ" if movie else "packing fraction φ",
                            limits=limits),
                    y=Scale("τ_{α}/τ_{α} at the lowest φ", log=True, limits=heights),
                    legend_rows=legend,
                    top=(1 / area, "density (1/mm^{2})" if movie else density_at),
                ),
                f"Relaxation time against packing fraction, {title.lower()}.",
                title,
            )
        )  # fmt: skip
    return Figure(
        name="relaxation-times",
        title="Relaxation against crowding",
        caption="Each side in units of its own relaxation time at its lowest packing fraction; "
        "the numbers behind the figure hold the values in the side's own unit. For movies φ is "
        f"effective: density × {comparison.area[0]:.0f} µm^{{2}}.",
        panels=tuple(panels),
        data=pd.concat(rows, ignore_index=True),
        wide=True,
    )


def boxes_figure(groups: Sequence[Group], table: str, label: str) -> Figure | None:
    """Quantiles of a distribution, group by group; one drawing per unit."""
    import pandas as pd

    by_unit: dict[str, list[tuple[str, int, list[float]]]] = {}
    for series, group in enumerate(groups):
        found = [
            list(quantiles.values())
            for result in group.members
            if (quantiles := look_up(result.summary, f"{table}.quantiles"))
        ]
        if not found:
            continue
        units = group.members[0].units
        unit = f"{pretty_unit(units.length)}/{pretty_unit(units.time)}" if table == "speed" else ""
        five = np.mean(np.array(found, dtype=np.float64), axis=0)
        by_unit.setdefault(unit, []).append((group.name, series, five.tolist()))
    if not by_unit or max(len(boxes) for boxes in by_unit.values()) < 2:
        return None
    panels = []
    for index, (unit, boxes) in enumerate(by_unit.items()):
        name = f"{table.replace('_', '-')}-boxes-{index + 1}"
        text = f"{label} ({unit})" if unit else label
        svg = draw_boxes(boxes[:12], name, label=text)
        panels.append(Panel(name, svg, f"Quantiles of the {label} of {len(boxes)} groups.", unit))
    rows = [
        {"result": title, "unit": unit, "q05": q[0], "q25": q[1], "q50": q[2], "q75": q[3],
         "q95": q[4]}
        for unit, boxes in by_unit.items() for title, _, q in boxes
    ]  # fmt: skip
    return Figure(
        name=f"{table.replace('_', '-')}-boxes",
        title=f"{label[0].upper()}{label[1:]}, group by group",
        caption="Median, middle half and middle nine tenths of all cells; quantiles are means "
        "over the trials.",
        panels=tuple(panels),
        data=pd.DataFrame(rows),
        wide=len(panels) > 1,
    )


def map_figures(groups: Sequence[Group]) -> list[Figure]:
    """Maps of mean shape index and relaxation time over (v0, eta), one per packing fraction."""
    import pandas as pd

    scenes = [g for g in groups if g.simulated and len(g.scene) == 3]
    speeds = sorted({g.scene["v0"] for g in scenes})
    tensions = sorted({g.scene["eta"] for g in scenes})
    if len(speeds) < 2 and len(tensions) < 2:
        return []
    figures = []
    for key, slug, title in (
        ("shape_index.mean", "mean-shape-index", "Mean shape index ⟨p⟩"),
        ("tau_alpha.value", "relaxation-time", "Relaxation time τ_{α} (t_{0})"),
    ):
        known = [(g, g.scalars()[key]) for g in scenes if key in g.scalars()]
        values = np.array([s.value for _, s in known])
        if not np.isfinite(values).any():
            continue
        limits = (float(np.nanmin(values)), float(np.nanmax(values)))
        panels = []
        for index, phi in enumerate(sorted({g.scene["phi"] for g, _ in known})):
            field = np.full((len(tensions), len(speeds)), np.nan)
            errors = field.copy()
            for group, scalar in known:
                if group.scene["phi"] == phi:
                    place = tensions.index(group.scene["eta"]), speeds.index(group.scene["v0"])
                    field[place], errors[place] = scalar.value, scalar.std_error
            name = f"map-{slug}-{index + 1}"
            svg = draw_map(field, name, x=("v₀", speeds), y=("η", tensions), limits=limits,
                           errors=errors)  # fmt: skip
            panels.append(
                Panel(name, svg, f"{title} over v0 and eta at phi {phi:g}.", f"φ = {phi:g}")
            )
        data = pd.DataFrame(
            {**{k: [g.scene[k] for g, _ in known] for k in ("phi", "v0", "eta")},
             "value": values, "std_error": [s.std_error for _, s in known],
             "censored_at": [s.censored_at for _, s in known]}
        )  # fmt: skip
        figures.append(
            Figure(
                name=f"map-{slug}",
                title=title,
                caption="A dash marks scenes that were not run, or where F_{s} does not fall to "
                "1/e in the run." if slug == "relaxation-time" else "A dash marks scenes that "
                "were not run.",
                panels=tuple(panels),
                data=data,
                wide=True,
            )
        )  # fmt: skip
    return figures


def _against_density(group: Group, series: int, area: float) -> Curve | None:
    """tau_alpha of each density bin: mean over trials, error from their spread."""
    bins: dict[float, list[tuple[float, float, float]]] = {}
    for results in group.trials.values():
        for result in results:
            table = result.tables.get("relaxation_times")
            if table is None:
                continue
            for centre, density, tau, error in zip(
                table["bin_centre"],
                table["density"],
                table["tau_alpha"],
                table["std_error"],
                strict=True,
            ):
                if math.isfinite(tau) and math.isfinite(centre):
                    bins.setdefault(float(centre), []).append((density, tau, error))
    if not bins:
        return None
    x, y, spread = [], [], []
    for centre in sorted(bins):
        density, tau, inner = (np.array(v) for v in zip(*bins[centre], strict=True))
        x.append(float(density.mean()) * area)
        y.append(float(tau.mean()))
        spread.append(
            float(tau.std(ddof=1) / math.sqrt(tau.size)) if tau.size > 1 else float(inner[0])
        )
    return Curve(group.name, np.array(x), np.array(y), np.array(spread), series, "points")


def _against_packing(groups: Sequence[Group]) -> list[Curve]:
    """tau_alpha against phi, one curve for each (v0, eta)."""
    lines: dict[tuple[float, float], list[tuple[float, float, float]]] = {}
    for group in groups:
        tau = group.scalars().get("tau_alpha.value")
        if len(group.scene) == 3 and tau is not None and math.isfinite(tau.value):
            key = group.scene["v0"], group.scene["eta"]
            lines.setdefault(key, []).append((group.scene["phi"], tau.value, tau.std_error))
    curves = []
    for series, (key, points) in enumerate(sorted(lines.items())):
        x, y, error = (np.array(v) for v in zip(*sorted(points), strict=True))
        label = f"v₀ = {key[0]:g}, η = {key[1]:g}"
        curves.append(Curve(label, x, y, error, series, "points"))
    return curves
