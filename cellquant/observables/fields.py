"""The measures of structure, van Hove function, velocities and cages."""

from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables.context import Context
from cellquant.observables.measures import Results
from cellquant.observables.relaxations import time_entry

_PER_DISTANCE = ("distance", "value", "std_error")


def _blank(*names: str, counts: str = "n_pairs") -> pd.DataFrame:
    columns = {name: np.empty(0) for name in names}
    return pd.DataFrame({**columns, counts: np.empty(0, dtype=np.int64)})


def structure_factor(context: Context, out: Results) -> None:
    out.summary["wave_number"] = dict(context.wave_number)
    out.summary["structure_factor"] = {
        **context.structure.peak,
        **context.layer.note,
        "n_frames": int(context.layer.frames.size),
    }
    out.tables["structure_factor"] = context.structure.table


def pair_correlation(context: Context, out: Results) -> None:
    from cellquant.observables.pairs import pair_correlation as measure

    found = measure(context.layer, diameter=context.diameter["mean_diameter"])
    out.tables["pair_correlation"] = found.table
    out.summary["pair_correlation"] = {
        **found.peak,
        "n_frames": int(context.layer.frames.size),
        **context.layer.note,
    }


def hexatic_order(context: Context, out: Results) -> None:
    out.summary["hexatic_order"] = context.bonds.summary
    out.tables["hexatic_order"] = context.bonds.hexatic


def neighbours(context: Context, out: Results) -> None:
    out.summary["neighbours"] = context.bonds.neighbour_summary
    out.tables["neighbours"] = context.bonds.neighbours


def van_hove(context: Context, out: Results) -> None:
    from cellquant.observables.vanhove import CORE_FORM, NORMALISATIONS, TAIL_FORM, self_van_hove

    lag_time, reason, source = _van_hove_lag(context)
    d = context.diameter["mean_diameter"]
    entry: dict[str, Any] = {
        "lag_time": lag_time, "lag_rule": source,
        "sigma2": None, "sigma2_std_error": None, "component_variance": None,
        "component_variance_std_error": None, "xi": None, "xi_std_error": None,
        "core_form": CORE_FORM, "tail_form": TAIL_FORM,
        "normalisation": NORMALISATIONS, "core_range": None, "tail_range": None,
        "length_unit": "mean diameter" if d else context.head.units.length,
        "length_in_table_unit": d or 1.0,
    }  # fmt: skip
    if lag_time is None:
        out.summary["van_hove"] = {**entry, "reason": reason}
        names = ("r", "value", "std_error", "unit_integral", "unit_integral_std_error",
                 "gaussian", "exponential")  # fmt: skip
        out.tables["van_hove"] = _blank(*names, counts="n")
        out.tables["van_hove_components"] = _blank("displacement", "value", "std_error", counts="n")
        return
    lag = round(lag_time / context.tracks.frame_interval)
    found = self_van_hove(
        context.unsmoothed_paths,
        lag,
        unit=d or 1.0,
        core_range=context.settings.core_range,
        tail_range=context.settings.tail_range,
    )
    reasons = [found.fits[k] for k in ("reason", "core_reason", "tail_reason") if k in found.fits]
    entry.update(found.fits, **({"reason": "; ".join(reasons)} if reasons else {}))
    out.summary["van_hove"] = entry
    out.tables["van_hove"] = found.table
    out.tables["van_hove_components"] = found.components


def _van_hove_lag(context: Context) -> tuple[float | None, str | None, str]:
    """Lag in time units, a whole number of frames; or why there is none."""
    dt = context.tracks.frame_interval
    given = context.settings.van_hove_lag
    source = "given, to the nearest frame" if given else "tau_alpha, to the nearest frame"
    if context.no_motion:
        return None, context.no_motion, source
    if given is None:
        if context.wave_number["q"] is None:
            return None, context.wave_number["reason"], source
        tau = context.tau
        if tau.value is None:
            return None, f"tau_alpha is not known: {tau.reason}; give van_hove_lag", source
        given = tau.value
    lag = max(round(given / dt), 1)
    if lag > context.unsmoothed_paths.max_lag:
        return None, f"no track is {lag} frames long", source
    return lag * dt, None, source


def velocity_autocorrelation(context: Context, out: Results) -> None:
    from cellquant.observables.correlations import persistence_time
    from cellquant.observables.correlations import velocity_autocorrelation as measure

    if context.no_motion:
        out.summary["velocity_autocorrelation"] = {
            "persistence_time": None, "reason": context.no_motion,
        }  # fmt: skip
        out.tables["velocity_autocorrelation"] = _blank("lag_time", "value", "std_error")
        return
    found = measure(context.paths)
    first = max(context.smoothed_over, 1)
    out.summary["velocity_autocorrelation"] = persistence_time(
        found, first_lag=first, interval=context.tracks.frame_interval
    )
    out.tables["velocity_autocorrelation"] = found.table()


def velocity_correlation(context: Context, out: Results) -> None:
    from cellquant.observables.correlations import velocity_correlation as measure

    d = context.diameter["mean_diameter"]
    reason = context.no_motion
    if reason is None and d is None:
        density = context.census.n_cells.mean() / context.tracks.area
        d = float(density**-0.5)
    if reason is not None or d is None:
        out.summary["velocity_correlation"] = {"correlation_length": None, "reason": reason}
        out.tables["velocity_correlation"] = _blank(*_PER_DISTANCE)
        return
    found = measure(
        context.paths,
        bin_width=d / 2,
        max_distance=10 * d,
        max_frames=context.settings.max_frames,
    )
    out.summary["velocity_correlation"] = found.summary
    out.tables["velocity_correlation"] = found.table


def cage_relative(context: Context, out: Results) -> None:
    from cellquant.observables.correlations import cage_relative as measure
    from cellquant.observables.relaxation import relaxation_time

    reason = context.no_motion or context.wave_number.get("reason")
    names = ("lag_time", "value", "std_error", "msd", "msd_std_error")
    if reason:
        out.summary["cage_relative"] = {"tau_alpha": None, "reason": reason}
        out.tables["cage_relative"] = _blank(*names)
        return
    square, wave, n_origins = measure(
        context.paths,
        context.wave_number["q"],
        lags=context.lags,
        max_frames=context.settings.max_frames,
    )
    table, msd = wave.table(), square.table()
    table.insert(3, "msd", msd["value"])
    table.insert(4, "msd_std_error", msd["std_error"])
    out.tables["cage_relative"] = table
    if not wave.counts.any():
        reason = "no cell keeps a neighbour: fewer than four cells in view, or all on a line"
        out.summary["cage_relative"] = {"tau_alpha": None, "reason": reason}
        return
    out.summary["cage_relative"] = {
        "tau_alpha": time_entry(relaxation_time(wave)),
        "n_origins": n_origins,
        "std_error_method": wave.method,
    }
