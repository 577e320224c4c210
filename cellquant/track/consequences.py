"""What linking errors do to the physics: dynamics of the tracks against those of the truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables import Observables, observe
from cellquant.tables import Tracks
from cellquant.track.evaluate import match_cells, pixel_size_of, read_truth

_PAIRS = 100  # pairs of points below which a lag is not spoken of


@dataclass(frozen=True)
class DynamicsError:
    """Errors of dynamical observables that linking alone causes.

    ``table`` has one row per lag: lag_time, n_pairs (of the side that has fewer), and value, true
    value and relative error (MSD) or difference (F_s) of each. ``tau_alpha`` and
    ``true_tau_alpha`` are None where the curve does not reach 1/e within the movie. ``reason``
    says why nothing could be measured.
    """

    table: pd.DataFrame
    tau_alpha: float | None
    true_tau_alpha: float | None
    time_unit: str
    reason: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Every number by name, NaN as None."""
        columns = {
            str(name): [None if np.isnan(value) else float(value) for value in column]
            for name, column in self.table.items()
        }
        return {
            **columns,
            "tau_alpha": self.tau_alpha,
            "true_tau_alpha": self.true_tau_alpha,
            "time_unit": self.time_unit,
            "reason": self.reason,
        }

    def as_lines(self) -> list[str]:
        """The errors as text."""
        if self.reason is not None:
            return [f"dynamics: not measurable, {self.reason}"]
        lines = []
        for name, column, factor, unit in (
            ("MSD", "msd_relative_error", 100.0, " %"),
            ("F_s", "scattering_error", 1.0, ""),
        ):
            many = self.table[self.table["n_pairs"] >= _PAIRS].dropna(subset=[column])
            if many.empty:
                lines.append(f"error of {name} from linking: no lag has {_PAIRS} pairs of points")
                continue
            error = factor * many[column].to_numpy(np.float64)
            worst = int(np.argmax(np.abs(error)))
            lag = float(many["lag_time"].to_numpy()[worst])
            lines.append(
                f"error of {name} from linking: {error[worst]:+.3g}{unit} at most, at a lag of "
                f"{lag:g} {self.time_unit}; root mean square over "
                f"{len(error)} lags {np.sqrt(np.mean(error**2)):.2g}{unit}"
            )
        values = [
            "not reached" if tau is None else f"{tau:.4g} {self.time_unit}"
            for tau in (self.tau_alpha, self.true_tau_alpha)
        ]
        lines.append(f"tau_alpha: {values[0]}, of the true links {values[1]}")
        return lines


def dynamics_error(tracks: Tracks, truth: str | Path, **options: Any) -> DynamicsError:
    """Measure MSD, F_s and tau_alpha of the tracks and of the same cells linked by the truth.

    Both sides hold the same cells at the same places, so that the difference is that of the links.

    Parameters
    ----------
    tracks
        Tracks in the coordinates of the true masks.
    truth
        CTC folder, as for `evaluate`.
    options
        Passed on to `cellquant.observables.observe`, such as ``min_points``.

    Returns
    -------
    DynamicsError
    """
    true_table = read_truth(truth, pixel_size=pixel_size_of(tracks))
    true_rows, rows = match_cells(true_table, tracks.table)
    kept = tracks.table.iloc[np.sort(rows)]
    order = np.argsort(rows)
    linked = kept.assign(
        track_id=true_table["track_id"].to_numpy()[true_rows[order]],
        parent_track_id=true_table["parent_track_id"].to_numpy()[true_rows[order]],
    ).sort_values(["track_id", "frame"], ignore_index=True)
    names = ["msd", "self_intermediate_scattering", "tau_alpha"]
    found = observe(replace(tracks, table=kept.reset_index(drop=True)), only=names, **options)
    # The same wave number on both sides, or the difference would not be that of the links.
    wave_number = found.summary.get("wave_number", {}).get("q")
    if wave_number is not None:
        options = {**options, "wave_number": wave_number}
    true = observe(replace(tracks, table=linked), only=names, **options)
    msd = _beside(found, true, "msd")
    scattering = _beside(found, true, "self_intermediate_scattering")
    table = pd.DataFrame(
        {
            "lag_time": msd["lag_time"],
            "n_pairs": msd["n_pairs"],
            "msd": msd["value"],
            "true_msd": msd["true"],
            "msd_relative_error": msd["value"] / msd["true"] - 1.0,
        }
    ).merge(
        pd.DataFrame(
            {
                "lag_time": scattering["lag_time"],
                "scattering": scattering["value"],
                "true_scattering": scattering["true"],
                "scattering_error": scattering["value"] - scattering["true"],
            }
        ),
        on="lag_time",
        how="outer",
    )
    reason = None
    if table.empty:
        reason = str(found.summary.get("msd", {}).get("reason") or "no lag could be measured")
    return DynamicsError(table, _tau(found), _tau(true), tracks.units.time, reason)


def _beside(found: Observables, true: Observables, name: str) -> pd.DataFrame:
    def whole(result: Observables) -> pd.DataFrame:
        table = result.tables[name]
        if "scope" in table:  # the whole movie, not its windows
            table = table[table["scope"] == "all"]
        return table[["lag_time", "value", "n_pairs"]]

    other = whole(true).rename(columns={"value": "true", "n_pairs": "true_pairs"})
    beside = whole(found).merge(other, on="lag_time")
    beside["n_pairs"] = np.minimum(beside["n_pairs"], beside.pop("true_pairs"))
    return beside


def _tau(result: Observables) -> float | None:
    value = result.summary.get("tau_alpha", {}).get("value")
    return None if value is None else float(value)
