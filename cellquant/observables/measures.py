"""One function per observable: from the shared context to summary entries and tables."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables.blocks import Blocks
from cellquant.observables.context import Context
from cellquant.observables.shape import BORDER_RULE, describe, pooled
from cellquant.observables.windows import DENSITY_RULE, mean_of_series
from cellquant.rows import Piece


@dataclass
class Results:
    """What has been measured so far."""

    summary: dict[str, Any] = field(default_factory=dict)
    tables: dict[str, pd.DataFrame] = field(default_factory=dict)


Measure = Callable[[Context, Results], None]


def _lag_columns() -> pd.DataFrame:
    columns = {name: np.empty(0) for name in ("lag_time", "value", "std_error")}
    return pd.DataFrame({**columns, "n_pairs": np.empty(0, dtype=np.int64)})


def density(context: Context, out: Results) -> None:
    frames = context.per_frame
    mean, error, method = mean_of_series(
        frames["density"].to_numpy(), min(context.window_points, 24)
    )
    unit = context.head.units.length
    out.summary["density"] = {
        "mean": mean,
        "std_error": error,
        "unit": f"1/{unit}^2",
        "count_per_area": float(frames["count_per_area"].mean()),
        "rule": DENSITY_RULE,
        "n_frames": len(frames),
        "std_error_method": method,
    }
    if not np.isfinite(error):
        out.summary["density"]["reason"] = (
            "the movie is too short for two stretches of frames, so the error is not measurable"
        )


def _distribution(context: Context, out: Results, name: str) -> None:
    first, points = context.frame_range[0], context.window_points
    numbers = [np.empty(0, dtype=np.int64)]

    def of_piece(piece: Piece) -> Any:
        used = ~piece["touches_border"] & np.isfinite(piece["shape_index"])
        used &= np.isfinite(piece[name])
        if not context.no_bin:
            numbers.append(((piece["frame"][used] - first) // points).astype(np.int32))
        return used, piece[name][used]

    columns = ("frame", "shape_index", name, "touches_border")
    values, blocks = pooled(context.source, columns, of_piece)
    found = describe(values, blocks)
    out.summary[name] = {**found.summary, "border_rule": BORDER_RULE}
    if not found.summary["n"]:
        out.summary[name]["reason"] = "no cell away from the border has a measured contour"
    out.tables[name] = found.table.rename(columns={"value": name, "density": "value"})
    if context.no_bin:
        out.summary[name].update(by_bin=[], by_bin_reason=context.no_bin)
    else:
        entries, table = _by_bin(context, name, values, blocks, np.concatenate(numbers))
        out.summary[name]["by_bin"] = entries
        out.tables[f"{name}_by_bin"] = table


def _by_bin(
    context: Context, name: str, values: Any, blocks: Blocks, window: Any
) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    """The distribution in the windows of each density bin."""
    entries, tables = [], []
    bins = context.window_bins
    for centre in sorted({c for c in bins if c is not None}):
        members = [number for number, c in enumerate(bins) if c == centre]
        used = np.isin(window, members)
        found = describe(values[used], Blocks(blocks.index[used], blocks.n, blocks.method))
        density = float(np.mean([context.window_densities[number] for number in members]))
        entry = {"bin_centre": centre, "density": density, "density_unit": "1/mm^2"}
        entries.append({**entry, "n_windows": len(members), **found.summary})
        table = found.table.rename(columns={"value": name, "density": "value"})
        table.insert(0, "bin_centre", centre)
        tables.append(table)
    return entries, pd.concat(tables, ignore_index=True)


def shape_index(context: Context, out: Results) -> None:
    _distribution(context, out, "shape_index")


def aspect_ratio(context: Context, out: Results) -> None:
    _distribution(context, out, "aspect_ratio")


def wave_number(context: Context, out: Results) -> None:
    out.summary["wave_number"] = dict(context.wave_number)


def speed(context: Context, out: Results) -> None:
    from cellquant.observables.motion import speeds

    if context.no_motion:
        found = describe(np.empty(0), Blocks(np.empty(0, dtype=np.int64), 0, "none"))
        out.summary["speed"] = {**found.summary, "reason": context.no_motion}
    else:
        values, blocks = speeds(context.paths)
        found = describe(values, blocks)
        out.summary["speed"] = dict(found.summary)
        if values.size == 0:
            out.summary["speed"]["reason"] = "no track has a position in two consecutive frames"
    out.summary["speed"]["dt"] = context.tracks.frame_interval
    out.tables["speed"] = found.table.rename(columns={"value": "speed", "density": "value"})


def msd(context: Context, out: Results) -> None:
    if context.no_motion:
        out.summary["msd"] = {"exponent": None, "reason": context.no_motion}
        out.tables["msd"] = _lag_columns()
        return
    from cellquant.observables.motion import growth_exponent

    second, _ = context.moments
    out.tables["msd"] = second.table()
    out.summary["msd"] = {
        **growth_exponent(second),
        "n_pairs": int(second.counts.sum()),
        "std_error_method": second.method,
    }


def _peak(table: pd.DataFrame, method: str, *, first: float = 0.0) -> dict[str, Any]:
    """Largest value of a curve from a lag on, and whether it lies inside the measured range."""
    value = table["value"].to_numpy()
    known = np.flatnonzero(np.isfinite(value) & (table["lag_time"].to_numpy() >= first))
    if known.size == 0:
        return {
            "value": None, "lag_time": None, "std_error": None,
            "reason": "not measurable at any lag",
        }  # fmt: skip
    k = known[int(np.argmax(value[known]))]
    at_edge = bool(k in (known[0], known[-1]))
    found: dict[str, Any] = {
        "value": value[k],
        "lag_time": table["lag_time"].to_numpy()[k],
        "std_error": table["std_error"].to_numpy()[k],
        "n_pairs": int(table["n_pairs"].to_numpy()[k]),
        "at_edge": at_edge,
        "std_error_method": method,
    }
    if not np.isfinite(found["std_error"]):
        found["std_error_reason"] = "the error needs at least two replicate blocks"
    if at_edge:
        found["note"] = "the largest value is at an end of the measured lags: perhaps not a peak"
    return found


def alpha2(context: Context, out: Results) -> None:
    from cellquant.observables.dynamics import alpha2_table

    if context.no_motion:
        out.summary["alpha2_peak"] = {"value": None, "reason": context.no_motion}
        out.tables["alpha2"] = _lag_columns()
        return
    table = alpha2_table(*context.moments)
    out.tables["alpha2"] = table
    # A moving average shrinks towards the ends of a track: over shorter lags the displacements
    # there are larger than the others, which alone makes alpha_2 positive.
    first = (context.smoothed_over - 0.5) * context.tracks.frame_interval
    peak = _peak(table, context.moments[0].method, first=first if context.smoothed_over > 1 else 0)
    out.summary["alpha2_peak"] = {**peak, "shortest_lag": context.smoothed_over}


def _overlap_cutoff(context: Context) -> float | None:
    given, d = context.settings.overlap_cutoff, context.diameter["mean_diameter"]
    return given if given is not None else (None if d is None else 0.3 * d)


def _overlap(context: Context, out: Results, table: str, key: str) -> None:
    cutoff = _overlap_cutoff(context)
    reason = context.no_motion
    if reason is None and cutoff is None:
        reason = "no cell away from the border has an area; give overlap_cutoff"
    if reason is not None or cutoff is None:
        out.summary[key] = {"value": None, "reason": reason}
        out.tables[table] = _lag_columns()
        return
    from cellquant.observables.dynamics import overlap

    found = overlap(context.paths, cutoff, lags=context.lags)
    if "overlap" in context.wanted:
        out.tables["overlap"] = found.overlap
        out.summary["overlap"] = {"cutoff": cutoff, "cutoff_rule": _cutoff_rule(context)}
    if "chi4" in context.wanted:
        out.tables["chi4"] = found.susceptibility
        peak = _peak(found.susceptibility, "jackknife over stretches of time origins")
        if peak["value"] is not None and not np.isfinite(peak["std_error"]):
            peak["std_error_reason"] = (
                "fewer than four stretches of time origins, each twice this lag, fit into the movie"
            )
        out.summary["chi4_peak"] = {**peak, "cutoff": cutoff}


def _cutoff_rule(context: Context) -> str:
    return "given" if context.settings.overlap_cutoff is not None else "0.3 mean diameters"


def overlap(context: Context, out: Results) -> None:
    if "overlap" not in out.tables:
        _overlap(context, out, "overlap", "overlap")


def chi4(context: Context, out: Results) -> None:
    if "chi4" not in out.tables:
        _overlap(context, out, "chi4", "chi4_peak")
