"""Figures over many groups: relaxation against crowding, quantiles, maps of a sweep."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cellquant.compare.figures import (
    Curve,
    Mark,
    Scale,
    common_limits,
    count_legend_rows,
    crossing,
    draw_boxes,
    draw_curves,
    draw_map,
)
from cellquant.compare.groups import Group
from cellquant.compare.page import Figure, Panel
from cellquant.compare.panels import join_curves
from cellquant.compare.results import look_up, pretty_unit

if TYPE_CHECKING:
    from cellquant.compare.comparison import Comparison

MAX_CURVES = 6
MAX_BOXES = 12


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
    mean, spread = comparison.area
    return Figure(
        name="relaxation-times",
        title="Relaxation against crowding",
        caption="Each side in units of its own relaxation time at its lowest packing fraction; the "
        "numbers behind the figure hold the values in the side's own unit. For movies φ is "
        f"effective: density × {mean:.0f} ± {spread:.0f} µm^{{2}}; all of it may shift by "
        f"{100 * spread / mean:.0f}\N{NO-BREAK SPACE}%.",
        panels=tuple(panels),
        data=pd.concat(rows, ignore_index=True),
        wide=True,
    )


def crowding_figure(comparison: "Comparison") -> Figure | None:
    """F_s in the density bins of a movie, beside F_s at the packing fractions of a sweep."""
    sides = [
        side
        for side in (_by_density(comparison.experiments), _by_packing(comparison.simulations))
        if side is not None
    ]
    if not sides:
        return None
    every = [curve for _, curves in sides for curve in curves]
    x = Scale("t/τ_{α} at the lowest crowding", log=True,
              limits=common_limits([c.x for c in every], log=True))  # fmt: skip
    y = Scale("F_{s}(q, t)", limits=(min(-0.08, *(float(np.nanmin(c.y)) for c in every)), 1.08))
    legend = max(count_legend_rows(curves) for _, curves in sides)
    panels = []
    for index, (title, curves) in enumerate(sides):
        name = f"scattering-crowding-{index + 1}"
        svg = draw_curves(curves, name, x=x, y=y, legend_rows=legend,
                          marks=(Mark(math.exp(-1), "1/e", axis="y"),))  # fmt: skip
        panels.append(Panel(name, svg, f"F_s against time at several degrees of crowding; {title}.",
                            title))  # fmt: skip
    return Figure(
        name="scattering-crowding",
        title="Memory of places as the layer fills",
        caption="At q = 2π/d. Movies: analysis windows of each density bin (cells/mm^{2}), the "
        "mean over n trials. Simulations: scenes that differ in φ alone, the mean over n runs. "
        "Each side in units of its own τ_{α} where it is least crowded; bands are standard errors.",
        panels=tuple(panels),
        data=join_curves({f"{t}: {c.label}": c for t, cs in sides for c in cs},
                         "lag_over_tau_alpha"),
        wide=True,
    )  # fmt: skip


def _by_density(groups: Sequence[Group]) -> tuple[str, list[Curve]] | None:
    """F_s of every density bin of the first condition that has two or more."""
    import pandas as pd

    for group in groups:
        trials = []
        for trial, results in group.trials.items():
            tables = [r.tables.get("self_intermediate_scattering") for r in results]
            rows = [
                t for t in tables if t is not None and {"scope", "bin_centre"} <= set(t.columns)
            ]
            if rows:
                every = pd.concat(rows, ignore_index=True)
                every = every[(every["scope"] == "window") & every["bin_centre"].notna()]
                means = every.groupby(["bin_centre", "lag_time"])[["value", "std_error"]].mean()
                trials.append(means.reset_index().assign(trial=trial))
        if not trials:
            continue
        table = pd.concat(trials, ignore_index=True)
        bins = sorted(table["bin_centre"].unique())
        if len(bins) < 2:
            continue
        curves = []
        for series, centre in enumerate(bins[:MAX_CURVES]):
            here = table[table["bin_centre"] == centre]
            n = here["trial"].nunique()
            lags = here.groupby("lag_time")
            error = lags["value"].std() / np.sqrt(lags["value"].size()) if n > 1 else (
                lags["std_error"].mean()
            )  # fmt: skip
            curves.append(
                Curve(f"{centre:.0f} (n = {n})", np.array(error.index, dtype=np.float64),
                      lags["value"].mean().to_numpy(), error.to_numpy(), series)
            )  # fmt: skip
        unit = crossing(curves[0])
        if math.isfinite(unit):
            scaled = [replace(c, x=c.x / unit) for c in curves]
            return f"Experiment: {group.name}", scaled
    return None


def _by_packing(groups: Sequence[Group]) -> tuple[str, list[Curve]] | None:
    """F_s of the scenes that differ in phi alone, for the (v0, eta) with most of them."""
    series: dict[tuple[float, float], dict[float, Group]] = {}
    for group in groups:
        if len(group.scene) == 3:
            key = group.scene["v0"], group.scene["eta"]
            series.setdefault(key, {}).setdefault(group.scene["phi"], group)
    ranked = sorted(series.items(), key=lambda item: -len(item[1]))
    for (v0, eta), scenes in ranked:
        if len(scenes) < 2:
            break
        curves = []
        for number, phi in enumerate(sorted(scenes)[:MAX_CURVES]):
            curve = scenes[phi].curve("self_intermediate_scattering", series=number)
            if curve is not None:
                curves.append(replace(curve, label=f"φ = {phi:g} (n = {scenes[phi].n})"))
        unit = crossing(curves[0]) if curves else math.nan
        if len(curves) > 1 and math.isfinite(unit):
            scaled = [replace(c, x=c.x / unit) for c in curves]
            return f"Simulation: v₀ = {v0:g}, η = {eta:g}", scaled
    return None


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
        name = f"{group.name} (n = {group.n})"
        by_unit.setdefault(unit, []).append((name, series, five.tolist()))
    if not by_unit or max(len(boxes) for boxes in by_unit.values()) < 2:
        return None
    panels = []
    for index, (unit, boxes) in enumerate(by_unit.items()):
        name = f"{table.replace('_', '-')}-boxes-{index + 1}"
        text = f"{label} ({unit})" if unit else label
        svg = draw_boxes(boxes[:MAX_BOXES], name, label=text)
        shown = min(len(boxes), MAX_BOXES)
        title = f"In {unit}" if unit else ""
        title += f" ({shown} of {len(boxes)} groups)" if shown < len(boxes) else ""
        words = f"Quantiles of the {label} of {shown} groups."
        panels.append(Panel(name, svg, words, title.strip()))
    rows = [
        {"result": title, "unit": unit, "q05": q[0], "q25": q[1], "q50": q[2], "q75": q[3],
         "q95": q[4]}
        for unit, boxes in by_unit.items() for title, _, q in boxes
    ]  # fmt: skip
    return Figure(
        name=f"{table.replace('_', '-')}-boxes",
        title=f"{label[0].upper()}{label[1:]}, group by group",
        caption="Median, middle half and middle nine tenths of all cells. Quantiles are means over "
        "n trials or runs; their spread is that of cells, not an error.",
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
