"""What several observables share, each made once and only when an observable asks for it."""

import warnings
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from cellquant.observables.blocks import ratio_with_error, sum_by_block
from cellquant.observables.settings import Settings
from cellquant.observables.shape import pooled
from cellquant.observables.windows import (
    WINDOW_POINTS,
    Census,
    Window,
    bin_density,
    count_by_frame,
    density_per_frame,
    density_scale,
    diameter_by_frame,
    split_frames,
    usable_area,
)
from cellquant.rows import Piece, Scan
from cellquant.tables import Cells, Tracks

if TYPE_CHECKING:
    from cellquant.observables.dynamics import LagAverage
    from cellquant.observables.fits import StretchedExponential
    from cellquant.observables.relaxation import RelaxationTime
    from cellquant.observables.smoothing import Survey
    from cellquant.observables.trajectories import Trajectories


class Context:
    """A source of observables, its settings, and what has been derived from it so far."""

    def __init__(
        self, source: Tracks | Cells | Scan, settings: Settings, wanted: Sequence[str]
    ) -> None:
        self.source = source
        self.settings = settings
        self.wanted = frozenset(wanted)

    @property
    def head(self) -> Tracks | Cells:
        """The source, of which only what is beside its rows may be used."""
        return self.source.head if isinstance(self.source, Scan) else self.source

    @property
    def box(self) -> tuple[float, float] | None:
        """Edges of the periodic box, or None."""
        return self.head.box if isinstance(self.head, Tracks) else None

    @property
    def tracks(self) -> Tracks:
        """The head, where it is known to be that of tracks."""
        assert isinstance(self.head, Tracks)
        return self.head

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
    def census(self) -> Census:
        """Rows per frame."""
        return count_by_frame(self.source)

    @cached_property
    def per_frame(self) -> pd.DataFrame:
        """Density of every frame."""
        return density_per_frame(self.source, self.census)

    @property
    def frame_range(self) -> tuple[int, int]:
        """Half-open range of frame numbers."""
        if isinstance(self.head, Cells):
            return 0, self.head.n_frames
        first = self.census.first_frame
        return first, first + self.census.n_frames

    @property
    def n_frames(self) -> int:
        """Frames from the smallest to the largest number."""
        return self.frame_range[1] - self.frame_range[0]

    @cached_property
    def windows(self) -> list[Window]:
        """The analysis windows."""
        return split_frames(self.frame_range[0], self.n_frames, self.window_points)

    @cached_property
    def survey(self) -> "Survey":
        """Drift of the population and tracks to retain."""
        from cellquant.observables.smoothing import survey

        settings = self.settings
        return survey(
            self._moving,
            keep_cut_cells=settings.keep_cut_cells,
            drift=settings.drift,
            min_points=settings.min_points,
        )

    @property
    def _moving(self) -> Tracks | Scan:
        assert not isinstance(self.source, Cells)
        return self.source

    def _trajectories(self) -> "Trajectories":
        from cellquant.observables.smoothing import trajectories_of

        keep = self.settings.keep_cut_cells
        return trajectories_of(self._moving, self.survey, keep_cut_cells=keep)

    @cached_property
    def unsmoothed_paths(self) -> "Trajectories":
        """The retained tracks, drift removed, not smoothed; the smoothed ones are let go."""
        if self._as_smoothed:
            return self.paths
        self.__dict__.pop("paths", None)
        return self._trajectories()

    @property
    def _as_smoothed(self) -> bool:
        """Whether smoothing changes nothing."""
        return self.tracks.smoothing != 1 or self.smoothing == 1

    @property
    def smoothed_over(self) -> int:
        """Points of the moving average that the smoothed paths have been through."""
        return self.smoothing if self.tracks.smoothing == 1 else self.tracks.smoothing

    @cached_property
    def paths(self) -> "Trajectories":
        """The retained tracks, drift removed, smoothed unless the source came smoothed."""
        from cellquant.observables.smoothing import smooth

        if self._as_smoothed:
            return self._trajectories()
        return smooth(self._trajectories(), self.smoothing, overwrite=True)

    @cached_property
    def no_motion(self) -> str | None:
        """Why nothing about motion can be measured; None when it can."""
        from cellquant.observables.smoothing import survey

        if self.survey.kept.any():
            return None
        longest = survey(self._moving).longest_run
        if not longest:
            return "there are no tracks"
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

        def of_piece(piece: Piece) -> Any:
            used = usable_area(piece)
            return used, np.sqrt(4 * piece["area"][used] / np.pi)

        d, blocks = pooled(self.source, ("area", "touches_border"), of_piece)
        if not d.size:
            return {"mean_diameter": None, "mean_diameter_std_error": None}
        sums = sum_by_block(d, blocks)
        _, error = ratio_with_error(sums, sum_by_block(np.ones_like(d), blocks))
        return {"mean_diameter": float(np.mean(d)), "mean_diameter_std_error": float(error)}

    @cached_property
    def layer(self) -> Any:
        """Positions in the frames on which structure is measured."""
        from cellquant.observables.layer import layer_of

        return layer_of(self.source, max_frames=self.settings.max_frames)

    @cached_property
    def window_diameters(self) -> list[float]:
        """Mean diameter in each window; NaN without a cell that has an area."""
        frames = self.census.frame
        total, count = diameter_by_frame(self.source, frames)
        found = []
        for window in self.windows:
            first, last = np.searchsorted(frames, (window.start, window.stop))
            n = float(count[first:last].sum())
            found.append(float(total[first:last].sum()) / n if n else float("nan"))
        return found

    @cached_property
    def window_densities(self) -> list[float]:
        """Mean density in each window, in the unit of the density bins where they apply."""
        factor, _ = density_scale(self.head.units) or (1.0, "")
        frame = self.per_frame["frame"].to_numpy()
        density = self.per_frame["density"].to_numpy()
        found = []
        for window in self.windows:
            first, last = np.searchsorted(frame, (window.start, window.stop))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # no area in any frame
                found.append(float(np.nanmean(density[first:last])) * factor)
        return found

    @cached_property
    def window_bins(self) -> list[float | None]:
        """Centre of the density bin of each window; None outside every bin."""
        if density_scale(self.head.units) is None:
            return [None] * len(self.windows)
        centres, width = self.settings.bin_centres, self.settings.bin_width
        return [bin_density(d, centres=centres, width=width) for d in self.window_densities]

    @cached_property
    def no_bin(self) -> str | None:
        """Why no window lies in a density bin; None when one does."""
        if density_scale(self.head.units) is None:
            return "density bins are in cells/mm^2 and need lengths in um"
        if not self.windows:
            return (
                f"the movie has {self.n_frames} frames, fewer than the {self.window_points} of a "
                "window"
            )
        if any(centre is not None for centre in self.window_bins):
            return None
        low, high = min(self.window_densities), max(self.window_densities)
        width, centres = self.settings.bin_width, self.settings.bin_centres
        return (
            f"the windows have densities of {low:.4g} to {high:.4g} 1/mm^2, all outside the bins "
            f"from {min(centres) - width / 2:g} to {max(centres) + width / 2:g}"
        )

    @cached_property
    def structure(self) -> Any:
        """Structure factor and its first peak."""
        from cellquant.observables.structure import structure_factor

        return structure_factor(self.layer, diameter=self.diameter["mean_diameter"])

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
        from cellquant.observables.trajectories import log_lags

        paths, lags = self.paths, self.lags
        if window is not None and (window.start, window.stop) == self.frame_range:
            if q == self.wave_number["q"]:
                return self.whole_scattering
        elif window is not None:
            paths = paths.inside(window.start, window.stop)
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

        return bond_order(self.layer)
