"""Scattering, relaxation times and windows: the measures of the study's central figure."""

from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables.context import Context
from cellquant.observables.measures import Results
from cellquant.observables.windows import density_scale

_SCATTERING_COLUMNS = (
    "lag_time", "value", "std_error", "n_pairs", "scope", "window", "bin_centre", "q",
)  # fmt: skip


def _tagged(
    table: pd.DataFrame, q: float, *, scope: str, window: int | None, centre: float | None
) -> pd.DataFrame:
    return table.assign(
        scope=scope,
        window=pd.array([window] * len(table), dtype="Int64"),
        bin_centre=np.nan if centre is None else centre,
        q=q,
    )[list(_SCATTERING_COLUMNS)]


def _no_scattering() -> pd.DataFrame:
    table = pd.DataFrame({name: np.empty(0) for name in ("lag_time", "value", "std_error")})
    table = table.assign(n_pairs=np.empty(0, dtype=np.int64))
    return _tagged(table, 0.0, scope="all", window=None, centre=None)


def _why_not(context: Context) -> str | None:
    if context.no_motion:
        return context.no_motion
    reason: str | None = context.wave_number.get("reason")
    return reason


def self_intermediate_scattering(context: Context, out: Results) -> None:
    out.summary["wave_number"] = dict(context.wave_number)
    reason = _why_not(context)
    out.summary["self_intermediate_scattering"] = {
        "method": context.settings.scattering,
        "threshold": "1/e",
        **({"reason": reason} if reason else {}),
    }
    if reason:
        out.tables["self_intermediate_scattering"] = _no_scattering()
        return
    whole = context.whole_scattering
    out.summary["self_intermediate_scattering"]["std_error_method"] = whole.method
    table = _tagged(whole.table(), context.wave_number["q"], scope="all", window=None, centre=None)
    earlier = out.tables.get("self_intermediate_scattering")
    out.tables["self_intermediate_scattering"] = (
        table if earlier is None else pd.concat([table, earlier], ignore_index=True)
    )


def tau_alpha(context: Context, out: Results) -> None:
    out.summary["wave_number"] = dict(context.wave_number)
    reason = _why_not(context)
    if reason:
        out.summary["tau_alpha"] = {
            "value": None, "std_error": None, "censored_at": None, "reason": reason,
        }  # fmt: skip
        return
    out.summary["tau_alpha"] = time_entry(context.tau)
    out.summary["tau_alpha"]["n_tracks"] = context.paths.n_tracks
    out.summary["tau_alpha"]["n_pairs"] = int(context.whole_scattering.counts.sum())
    out.summary["tau_alpha"]["stretched_exponential"] = context.stretched.as_dict()
    out.summary["tau_alpha"]["std_error_method"] = (
        "bootstrap over blocks: " + context.whole_scattering.method.removeprefix("jackknife over ")
    )


def time_entry(tau: Any) -> dict[str, Any]:
    """Summary entry of a relaxation time."""
    entry = {
        "value": tau.value,
        "std_error": tau.std_error,
        "interval_95": list(tau.interval),
        "bias": tau.bias,
        "censored_at": tau.censored_at,
        "censored_fraction": tau.censored_fraction,
    }
    if tau.below is not None:
        entry["below"] = tau.below
    if tau.reason:
        entry["reason"] = tau.reason
    return entry


def windows(context: Context, out: Results) -> None:
    """Density, wave number, F_s and tau_alpha of each window, and of each density bin."""
    from cellquant.observables.dynamics import LagAverage, pool
    from cellquant.observables.relaxation import relaxation_time

    scale = density_scale(context.head.units)
    _, unit = scale or (1.0, f"1/{context.head.units.length}^2")
    curves: list[pd.DataFrame] = []
    entries: list[dict[str, Any]] = []
    binned: dict[float, list[tuple[dict[str, Any], LagAverage]]] = {}
    for number, window in enumerate(context.windows):
        entry = _window_entry(context, number)
        entry.update(number=number, density_unit=unit, bin_centre=None)
        if scale is None:
            entry["bin_reason"] = "density bins are in cells/mm^2 and need lengths in um"
        else:
            entry["bin_centre"] = context.window_bins[number]
            if entry["bin_centre"] is None:
                entry["bin_reason"] = "the density is outside every bin"
        reason = context.no_motion or entry.pop("q_reason", None)
        if reason:
            entry.update(tau_alpha=None, tau_alpha_std_error=None, censored_at=None, reason=reason)
        else:
            average = context.scattering(entry["q"], window)
            tau = time_entry(relaxation_time(average))
            entry["tau_alpha"] = tau.pop("value")
            entry["tau_alpha_std_error"] = tau.pop("std_error")
            entry.update(tau, n_pairs=int(average.counts.sum()))
            centre = entry["bin_centre"]
            curves.append(
                _tagged(average.table(), entry["q"], scope="window", window=number, centre=centre)
            )
            key = np.nan if scale is None else centre
            if key is not None:
                binned.setdefault(key, []).append((entry, average))
        entries.append(entry)
    out.summary["windows"] = entries
    if not binned:
        out.summary["windows_reason"] = _why_no_window(context, entries)
    out.tables["windows"] = _windows_table(entries)
    rows = []
    for centre in sorted(binned):
        members = [entry for entry, _ in binned[centre]]
        pooled = pool([average for _, average in binned[centre]])
        pooled_tau = relaxation_time(pooled)
        q = float(np.mean([m["q"] for m in members]))
        if scale is not None:
            curves.append(_tagged(pooled.table(), q, scope="bin", window=None, centre=centre))
        rows.append(_relaxation_row(context, centre, members, pooled_tau, unit))
    out.tables["relaxation_times"] = _relaxation_table(rows)
    if "self_intermediate_scattering" in context.wanted:
        earlier = out.tables.get("self_intermediate_scattering")
        parts = [t for t in (earlier, *curves) if t is not None and len(t)]
        if parts:
            out.tables["self_intermediate_scattering"] = pd.concat(parts, ignore_index=True)


def _why_no_window(context: Context, entries: list[dict[str, Any]]) -> str:
    """Why no window gives a relaxation time."""
    reasons = list(dict.fromkeys(e["reason"] for e in entries if "n_pairs" not in e))
    return "; ".join(reasons) or context.no_bin or "no window has a relaxation time"


def _window_entry(context: Context, number: int) -> dict[str, Any]:
    window = context.windows[number]
    inside = context.per_frame["frame"].between(window.start, window.stop - 1)
    dt = context.tracks.frame_interval
    d = context.window_diameters[number]
    entry: dict[str, Any] = {
        "start": window.start * dt,
        "stop": window.stop * dt,
        "start_frame": window.start,
        "stop_frame": window.stop,
        "density": context.window_densities[number],
        "n_cells_mean": float(context.per_frame["n_cells"][inside].mean()),
        "mean_diameter": d,
        "q": None,
    }
    if context.settings.wave_number == "2pi/d" and np.isfinite(d):
        entry["q"] = 2 * np.pi / d
    elif context.settings.wave_number == "2pi/d":
        entry["q_reason"] = "no cell away from the border has an area in this window"
    elif context.wave_number["q"] is not None:
        entry["q"] = context.wave_number["q"]
    else:
        entry["q_reason"] = context.wave_number["reason"]
    return entry


_WINDOW_COLUMNS = (
    "number", "start", "stop", "start_frame", "stop_frame", "density", "density_unit",
    "bin_centre", "n_cells_mean", "mean_diameter", "q", "tau_alpha", "tau_alpha_std_error",
    "censored_at", "n_pairs", "reason",
)  # fmt: skip
_TEXT = {"density_unit", "reason"}
_COUNTS = {"number", "start_frame", "stop_frame"}


def _windows_table(entries: list[dict[str, Any]]) -> pd.DataFrame:
    columns: dict[str, Any] = {}
    for name in _WINDOW_COLUMNS:
        values = [entry.get(name) for entry in entries]
        if name in _TEXT:
            columns[name] = pd.array(values, dtype="string")
        elif name in _COUNTS:
            columns[name] = np.array(values, dtype=np.int64)
        else:
            columns[name] = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
    return pd.DataFrame(columns)


def _relaxation_row(
    context: Context, centre: float, members: list[dict[str, Any]], tau: Any, unit: str
) -> dict[str, Any]:
    return {
        "condition": context.settings.condition,
        "trial": context.settings.trial,
        "bin_centre": centre,
        "density": float(np.mean([m["density"] for m in members])),
        "density_unit": unit,
        "tau_alpha": np.nan if tau.value is None else tau.value,
        "std_error": np.nan if tau.std_error is None else tau.std_error,
        "censored": tau.censored_at is not None,
        "censored_at": np.nan if tau.censored_at is None else tau.censored_at,
        "below": np.nan if tau.below is None else tau.below,
        "n_windows": len(members),
        "n_pairs": int(sum(m["n_pairs"] for m in members)),
    }


def _relaxation_table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    kinds = {
        "condition": "string", "trial": "string", "bin_centre": "float64", "density": "float64",
        "density_unit": "string", "tau_alpha": "float64", "std_error": "float64",
        "censored": "bool", "censored_at": "float64", "below": "float64", "n_windows": "int64",
        "n_pairs": "int64",
    }  # fmt: skip
    return pd.DataFrame(rows, columns=list(kinds)).astype(kinds)
