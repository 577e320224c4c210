"""What linking errors do to the physics: dynamics of the tracks against those of the truth."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cellquant.observables import Observables, observe
from cellquant.tables import Tracks
from cellquant.track.evaluate import match_cells, pixel_size_of, read_truth


@dataclass(frozen=True)
class DynamicsError:
    """Errors of dynamical observables that linking alone causes.

    ``table`` has one row per lag: lag_time, and value, true value and relative error (MSD) or
    difference (F_s) of each. ``tau_alpha`` and ``true_tau_alpha`` are None where the curve does
    not reach 1/e within the movie.
    """

    table: pd.DataFrame
    tau_alpha: float | None
    true_tau_alpha: float | None


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
    return DynamicsError(table, _tau(found), _tau(true))


def _beside(found: Observables, true: Observables, name: str) -> pd.DataFrame:
    def whole(result: Observables) -> pd.DataFrame:
        mean = result.tables[name].groupby("lag_time")["value"].mean()
        return pd.DataFrame({"lag_time": mean.index.to_numpy(), "value": mean.to_numpy()})

    return whole(found).merge(whole(true).rename(columns={"value": "true"}), on="lag_time")


def _tau(result: Observables) -> float | None:
    value = result.summary.get("tau_alpha", {}).get("value")
    return None if value is None else float(value)
