"""What several observables share, each made once and only when an observable asks for it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cellquant.observables.blocks import jackknife_error, leave_one_out, sum_by_block
from cellquant.observables.settings import Settings
from cellquant.observables.shape import cell_blocks
from cellquant.observables.smoothing import (
    leave_out_cut_cells,
    longest_runs,
    ordered_rows,
    remove_drift,
    retain,
)
from cellquant.observables.smoothing import smooth_tracks as smooth
from cellquant.observables.windows import (
    WINDOW_POINTS,
    RowsByFrame,
    Window,
    mean_diameter,
    split_frames,
)
from cellquant.tables import Cells, Tracks

if TYPE_CHECKING:
    from cellquant.observables.dynamics import LagAverage
    from cellquant.observables.fits import StretchedExponential
    from cellquant.observables.relaxation import RelaxationTime
    from cellquant.observables.trajectories import Trajectories


class Context:
    """A source of observables, its settings, and what has been derived from it so far."""

    def __init__(self, source: Tracks | Cells, settings: Settings, wanted: Sequence[str]) -> None:
        self.source = source
        self.settings = settings
        self.wanted = frozenset(wanted)

    @property
    def box(self) -> tuple[float, float] | None:
        """Edges of the periodic box, or None."""
        return self.source.box if isinstance(self.source, Tracks) else None

    @property
    def tracks(self) -> Tracks:
        """The source, where it is known to be tracks."""
        assert isinstance(self.source, Tracks)
        return self.source

    @property
    def smoothing(self) -> int:
        """Points of the moving average: as given, else 5 in an open field and 1 in a box."""
        given = self.settings.smoothing
        return given if given is not None else (5 if self.box is None else 1)

    @property
    def window_points(self) -> int:
        """Frames of a window: as given, else 24 in an open field and the whole run in a box."""
        if self.settings.window is not None:
            return self.settings.window
        return WINDOW_POINTS if self.box is None else max(self.n_frames, 2)

    @cached_property
    def frame_range(self) -> tuple[int, int]:
        """Half-open range of frame numbers."""
        if isinstance(self.source, Cells):
            return 0, self.source.n_frames
        frame = self.source.table["frame"]
        return (int(frame.min()), int(frame.max()) + 1) if len(frame) else (0, 0)

    @property
    def n_frames(self) -> int:
        """Frames from the smallest to the largest number."""
        return self.frame_range[1] - self.frame_range[0]

    @cached_property
    def windows(self) -> list[Window]:
        """The analysis windows."""
        return split_frames(self.frame_range[0], self.n_frames, self.window_points)

    @cached_property
    def contours(self) -> pd.DataFrame:
        """Rows whose shape can be measured: away from the border, with a finite shape index."""
        table = self.source.table
        rows = ~table["touches_border"].to_numpy(dtype=bool)
        rows &= np.isfinite(table["shape_index"].to_numpy(dtype=np.float64))
        kept: pd.DataFrame = table[rows]
        return kept

    @cached_property
    def unsmoothed(self) -> Tracks:
        """Retained tracks without cut cells, drift removed."""
        tracks = self.tracks
        if not self.settings.keep_cut_cells:
            tracks = leave_out_cut_cells(tracks)
        if self.settings.drift:
            tracks = remove_drift(tracks)
        return retain(tracks, self.settings.min_points)

    @cached_property
    def smoothed(self) -> Tracks:
        """Retained tracks, drift removed, smoothed unless the source came smoothed."""
        if self.tracks.smoothing != 1:
            return self.unsmoothed
        return smooth(self.unsmoothed, self.smoothing)

    @cached_property
    def smoothed_rows(self) -> RowsByFrame:
        """Rows of the smoothed tracks by frame."""
        return RowsByFrame(self.smoothed.table)

    @cached_property
    def source_rows(self) -> RowsByFrame:
        """Rows of the source by frame."""
        return RowsByFrame(self.source.table)

    @cached_property
    def paths(self) -> "Trajectories":
        """The smoothed tracks as arrays."""
        from cellquant.observables.trajectories import from_tracks

        return from_tracks(self.smoothed)

    @cached_property
    def unsmoothed_paths(self) -> "Trajectories":
        """The unsmoothed tracks as arrays."""
        from cellquant.observables.trajectories import from_tracks

        return from_tracks(self.unsmoothed)

    @cached_property
    def no_motion(self) -> str | None:
        """Why nothing about motion can be measured; None when it can."""
        if len(self.unsmoothed.table):
            return None
        if not len(self.tracks.table):
            return "there are no tracks"
        longest = int(longest_runs(ordered_rows(self.tracks.table)).max())
        reason = (
            f"no track has {self.settings.min_points} consecutive points (the longest has "
            f"{longest}); min_points sets how many are asked for"
        )
        if longest >= self.settings.min_points:
            reason = (
                f"no track has {self.settings.min_points} consecutive points away from the border "
                "of the image; keep_cut_cells takes the others in"
            )
        return reason

    @cached_property
    def lags(self) -> Any:
        """Lags in frames."""
        from cellquant.observables.trajectories import log_lags

        if self.settings.lags is not None:
            return np.unique(np.asarray(self.settings.lags, dtype=np.int64))
        return log_lags(self.paths.max_lag)

    @cached_property
    def diameter(self) -> dict[str, Any]:
        """Mean diameter, its error and the rule."""
        table = self.source.table
        value, rows = mean_diameter(table)
        if not np.isfinite(value):
            return {"mean_diameter": None, "mean_diameter_std_error": None}
        used = table[rows]
        blocks = cell_blocks(used, self.box)
        d = np.sqrt(4 * used["area"].to_numpy(dtype=np.float64) / np.pi)
        sums, counts = sum_by_block(d, blocks), sum_by_block(np.ones_like(d), blocks)
        error = float("nan")
        if blocks.n >= 2:
            error = float(jackknife_error(leave_one_out(sums) / leave_one_out(counts)))
        return {"mean_diameter": value, "mean_diameter_std_error": error}

    @cached_property
    def structure(self) -> Any:
        """Structure factor and its first peak."""
        from cellquant.observables.structure import structure_factor

        return structure_factor(
            self.source,
            diameter=self.diameter["mean_diameter"],
            max_frames=self.settings.max_frames,
        )

    @cached_property
    def wave_number(self) -> dict[str, Any]:
        """The wave number of scattering and how it was chosen."""
        rule = self.settings.wave_number
        found: dict[str, Any] = {"q": None, "rule": rule, **self.diameter, "q_peak": None}
        d = found["mean_diameter"]
        if rule == "structure_factor_peak" or "structure_factor" in self.wanted:
            peak = self.structure.peak
            found.update(q_peak=peak["q_peak"], q_peak_std_error=peak["q_peak_std_error"])
            if peak.get("reason"):
                found["q_peak_reason"] = peak["reason"]
        else:
            found["q_peak_reason"] = "structure_factor was not asked for"
        if isinstance(rule, (int, float)):
            found.update(q=float(rule), rule="given")
        elif rule == "2pi/d" and d is not None:
            error = found["mean_diameter_std_error"]
            found.update(q=2 * np.pi / d, q_std_error=2 * np.pi / d**2 * error)
        elif rule == "structure_factor_peak" and found["q_peak"] is not None:
            found.update(q=found["q_peak"], q_std_error=found["q_peak_std_error"])
        else:
            found["reason"] = (
                found.get("q_peak_reason")
                if rule == "structure_factor_peak"
                else "no cell away from the border has an area; give wave_number"
            )
        if found["q_peak"] is not None and d is not None:
            found["q_peak_times_d_over_2pi"] = found["q_peak"] * d / (2 * np.pi)
        return found

    @cached_property
    def moments(self) -> "tuple[LagAverage, LagAverage]":
        """Second and fourth moment of the displacement."""
        from cellquant.observables.dynamics import displacement_moments

        return displacement_moments(self.paths, lags=self.lags, stride=self.settings.stride)

    def scattering(self, q: float, window: Window | None = None) -> "LagAverage":
        """F_s of the whole source, or of the pairs of points inside a window."""
        from cellquant.observables.dynamics import scattering_average
        from cellquant.observables.trajectories import from_tracks, log_lags

        paths, lags = self.paths, self.lags
        if window is not None and (window.start, window.stop) == self.frame_range:
            if q == self.wave_number["q"]:
                return self.whole_scattering
        elif window is not None:
            rows = self.smoothed_rows.inside(window)
            paths = from_tracks(replace(self.smoothed, table=rows))
            lags = log_lags(paths.max_lag)
        return scattering_average(
            paths, q, lags=lags, method=self.settings.scattering, stride=self.settings.stride
        )

    @cached_property
    def whole_scattering(self) -> "LagAverage":
        """F_s of the whole source at its wave number."""
        return self.scattering(self.wave_number["q"])

    @cached_property
    def tau(self) -> "RelaxationTime":
        """tau_alpha of the whole source."""
        from cellquant.observables.relaxation import relaxation_time

        return relaxation_time(self.whole_scattering)

    @cached_property
    def length_scale(self) -> float | None:
        """Mean diameter where there is one: the unit of r in the van Hove function."""
        d: float | None = self.diameter["mean_diameter"]
        return d

    @cached_property
    def stretched(self) -> "StretchedExponential":
        """Stretched-exponential fit of F_s of the whole source."""
        from cellquant.observables.fits import fit_stretched_exponential

        return fit_stretched_exponential(self.whole_scattering)

    @cached_property
    def bonds(self) -> Any:
        """Hexatic order and neighbour numbers."""
        from cellquant.observables.bonds import bond_order

        return bond_order(self.source, max_frames=self.settings.max_frames)
