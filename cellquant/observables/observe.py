"""From tracks, cells or a run to `summary.json` and one tidy table per observable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from cellquant.errors import InputError
from cellquant.observables import fields, measures, relaxations
from cellquant.observables.context import Context
from cellquant.observables.measures import Measure, Results
from cellquant.observables.settings import checked_settings
from cellquant.rows import Scan
from cellquant.storage import atomic_path, write_json
from cellquant.tables import CELL_COLUMNS, TRACK_COLUMNS, Cells, Tracks, Units, write_table


class _Entry(NamedTuple):
    meaning: str
    needs_tracks: bool
    measure: Measure
    columns: tuple[str, ...] = ()  # beyond those that every observable reads


_CATALOGUE: dict[str, _Entry] = {
    "density": _Entry("number density", False, measures.density),
    "shape_index": _Entry(
        "distribution of P/sqrt(A)", False, measures.shape_index, ("shape_index",)
    ),
    "aspect_ratio": _Entry(
        "distribution of the aspect ratio",
        False,
        measures.aspect_ratio,
        ("shape_index", "aspect_ratio"),
    ),
    "wave_number": _Entry("q = 2 pi/d, and d", False, measures.wave_number),
    "speed": _Entry("distribution of |v| over one frame interval", True, measures.speed),
    "msd": _Entry("mean-square displacement", True, measures.msd),
    "alpha2": _Entry("non-Gaussian parameter", True, measures.alpha2),
    "self_intermediate_scattering": _Entry(
        "F_s(q, t), isotropic average", True, relaxations.self_intermediate_scattering
    ),
    "tau_alpha": _Entry("time at which F_s falls to 1/e", True, relaxations.tau_alpha),
    "windows": _Entry(
        "density and tau_alpha per window and density bin", True, relaxations.windows
    ),
    "overlap": _Entry("self-overlap Q(t)", True, measures.overlap),
    "chi4": _Entry("four-point susceptibility", True, measures.chi4),
    "velocity_autocorrelation": _Entry(
        "<v(s) . v(s + t)> and the persistence time", True, fields.velocity_autocorrelation
    ),
    "velocity_correlation": _Entry(
        "<v_i . v_j> against distance", True, fields.velocity_correlation
    ),
    "cage_relative": _Entry("MSD and F_s relative to the neighbours", True, fields.cage_relative),
    # The last of motion: it alone needs trajectories that are not smoothed.
    "van_hove": _Entry("G_s(r, t) with core and tail", True, fields.van_hove),
    "structure_factor": _Entry("S(q) and its first peak", False, fields.structure_factor),
    "pair_correlation": _Entry("g(r)", False, fields.pair_correlation),
    "hexatic_order": _Entry("psi_6", False, fields.hexatic_order),
    "neighbours": _Entry("number of Delaunay neighbours", False, fields.neighbours),
}


@dataclass(frozen=True)
class Observables:
    """Everything measured from one source.

    Attributes
    ----------
    summary
        The content of ``summary.json``.
    tables
        Tidy tables by name of the observable.
    units
        Unit names of summary and tables.
    statistics
        The content of ``statistics.json``; None where windows were not asked for.
    """

    summary: Mapping[str, Any]
    tables: Mapping[str, pd.DataFrame]
    units: Units
    statistics: Mapping[str, Any] | None = None

    def write(self, folder: str | Path) -> None:
        """Write ``summary.json``, ``NAME.parquet`` for every table, and ``statistics.json``.

        Parameters
        ----------
        folder
            Made when it does not exist. Equal observables give byte-equal files.
        """
        folder = Path(folder)
        for name, table in self.tables.items():
            with atomic_path(folder / f"{name}.parquet") as path:
                write_table(table, path, units=self.units)
        write_json(folder / "summary.json", self.summary)
        if self.statistics is not None:
            write_json(folder / "statistics.json", self.statistics)


def available_observables() -> dict[str, str]:
    """Names that may be asked for, and what they mean."""
    return {name: entry.meaning for name, entry in _CATALOGUE.items()}


def needs_tracks(names: Sequence[str]) -> bool:
    """Whether any of the named observables needs trajectories; the others take cells.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    return any(_CATALOGUE[name].needs_tracks for name in _checked(names))


def columns_read(names: Sequence[str] | None, *, of_cells: bool = False) -> list[str]:
    """Columns of the table that the named observables read, in the order of the table.

    Parameters
    ----------
    names
        Names out of `available_observables`; all when None.
    of_cells
        Whether the table is one of cells, which has no track_id.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    entries = [_CATALOGUE[name] for name in _checked(names if names is not None else [*_CATALOGUE])]
    read = {"frame", "x", "y", "area", "touches_border", "track_id"}
    read = read.union(*(entry.columns for entry in entries))
    return [name for name in (CELL_COLUMNS if of_cells else TRACK_COLUMNS) if name in read]


def _checked(names: Sequence[str]) -> list[str]:
    unknown = [name for name in names if name not in _CATALOGUE]
    if unknown:
        raise InputError(
            f"there is no observable {unknown[0]!r}; choose from {', '.join(_CATALOGUE)}."
        )
    return [name for name in _CATALOGUE if name in set(names)]


def observe(source: Any, *, only: Sequence[str] | None = None, **options: Any) -> Observables:
    """Measure observables of tracks, of a simulated run, or of cells.

    Positions of cells that the border of the image cuts are left out; trajectories are expressed
    relative to the centre of mass of the population; those without enough consecutive points are
    dropped; then they are smoothed: with five points in an open field of view, not at all in a
    periodic box. ``summary["processing"]`` says what was done.

    Parameters
    ----------
    source
        `Tracks`; anything with a ``scan(columns=...)`` method, such as a run; or `Cells`, from
        which only what needs no trajectories is measured. Tracks and cells may stay on disk
        (`cellquant.rows.scan_tracks`, `scan_cells`): they are read in pieces and never held whole.
    only
        Names out of `available_observables`; all that the source allows when None.
    smoothing
        Points of the moving average, odd; 5 in an open field and 1 in a box when None.
    drift
        Whether the motion of the centre of mass is removed.
    keep_cut_cells
        Whether positions of cells that touch the border enter the motion; the centroid of the
        part that is seen moves less than the cell.
    min_points
        Consecutive points a trajectory must have, 24 by default.
    window
        Frames of an analysis window; 24 in an open field and the whole run in a box when None.
    bin_centres, bin_width
        Density bins, in cells/mm^2.
    wave_number
        A number in inverse length units, "2pi/d" (default) or "structure_factor_peak".
    scattering
        "bessel" for the exact isotropic average, "vectors" for eight directions of q.
    lags
        Lags in frames; about 35 evenly spaced in the logarithm when None.
    stride
        Frames between time origins; 1, every origin, by default.
    overlap_cutoff
        Distance of the overlap function in length units; 0.3 mean diameters when None.
    van_hove_lag
        Lag of the van Hove function in time units; tau_alpha when None.
    core_range, tail_range
        Ranges in which the Gaussian core and the exponential tail of the van Hove function are
        fitted, in mean diameters; chosen from the data when None.
    max_frames
        Frames, evenly spaced, on which structure is measured; 32 by default.
    condition, trial
        Names written to ``relaxation_times.parquet``.

    Returns
    -------
    Observables

    Raises
    ------
    InputError
        If a name is unknown, a name needs trajectories that the source lacks, an option has no
        such value, or a track has two positions in one frame.
    """
    if isinstance(only, str):
        raise InputError(f"only must be a list of names, got {only!r}; write only=[{only!r}].")
    if not isinstance(source, (Tracks, Cells, Scan)):
        if not hasattr(source, "scan"):
            raise InputError(
                f"observables are measured from tracks, cells or a run, got "
                f"{type(source).__name__}; open the source first."
            )
        source = source.scan(columns=columns_read(only))
    wanted = _wanted(source.head if isinstance(source, Scan) else source, only)
    settings = checked_settings(options)
    context = Context(source, settings, wanted)
    out = Results(_head(context))
    for name in wanted:
        _CATALOGUE[name].measure(context, out)
    if needs_tracks(wanted):
        out.summary["processing"] = _processing(context)
    head = context.head
    stationarity = head.provenance.get("stationarity") if isinstance(head, Tracks) else None
    if stationarity is not None and "shape_index" in out.summary:
        out.summary["stationarity"] = stationarity
    summary: dict[str, Any] = _plain(out.summary)
    statistics = None
    if "relaxation_times" in out.tables:
        from cellquant.statistics import study_statistics

        statistics = study_statistics(
            out.tables["relaxation_times"], why_empty=out.summary.get("windows_reason")
        )
    return Observables(summary, out.tables, head.units, statistics)


def _wanted(source: Tracks | Cells, only: Sequence[str] | None) -> list[str]:
    if only is None:
        has_tracks = isinstance(source, Tracks)
        return [name for name, entry in _CATALOGUE.items() if has_tracks or not entry.needs_tracks]
    wanted = _checked(only)
    if isinstance(source, Cells):
        moving = [name for name in wanted if _CATALOGUE[name].needs_tracks]
        if moving:
            raise InputError(
                f"{', '.join(moving)} needs trajectories, but the source is a table of cells; "
                "track it first."
            )
    return wanted


def _head(context: Context) -> dict[str, Any]:
    head, n_frames, census = context.head, context.n_frames, context.census
    return {
        "n_frames": n_frames,
        "n_cells_mean": census.n_rows / n_frames if n_frames else None,
        "n_tracks": census.n_tracks if isinstance(head, Tracks) else None,
        "length_unit": head.units.length,
        "time_unit": head.units.time,
        "unit_rule": (
            "densities carry their own unit; lengths, wave numbers, times, speeds and diffusion "
            f"coefficients are in {head.units.length}, 1/{head.units.length}, {head.units.time}, "
            f"{head.units.length}/{head.units.time} and {head.units.length}^2/{head.units.time}; "
            "sigma2, xi and the ranges of van_hove in the unit given there; the rest has none"
        ),
    }


def _processing(context: Context) -> dict[str, Any]:
    drift = context.survey.drift
    return {
        "smoothing_points": context.smoothed_over,
        "smoothing_rule": "given"
        if context.settings.smoothing is not None
        else "5 in an open field of view, 1 in a periodic box",
        "drift_removed": bool(drift and drift["removed"]),
        "drift": drift,
        "cut_cells_left_out": context.survey.n_cut,
        "min_points": context.settings.min_points,
        "n_tracks_retained": int(context.survey.kept.sum()),
        "window_points": context.window_points,
        "time_origin_stride": context.settings.stride,
    }


def _plain(value: Any) -> Any:
    """Python types only; NaN and infinity become None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
