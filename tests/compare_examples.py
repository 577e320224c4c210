"""A small layer whose tables, masks and observables stand in for a movie or a run."""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from cellquant.compare.results import Result
from cellquant.storage import write_json
from cellquant.tables import PHYSICAL, REDUCED, Cells, Tracks, Units, write_table


@dataclass
class Layer:
    """Masks (T, H, W), the tables measured on them, and observables in the form of `observe`."""

    masks: np.ndarray
    cells: Cells
    tracks: Tracks
    summary: dict[str, Any]
    tables: dict[str, pd.DataFrame]
    record: dict[str, Any] = field(default_factory=dict)
    run: Any = None

    def result(self, name: str) -> Result:
        """The layer as a result in memory, with its pictures."""
        stack: Any = None if self.run is not None else Stack(self.masks, 1.3, 10.0)
        return Result(
            name, self.summary, self.tables, self.record, None, self.tracks, stack, self.run
        )

    def write(self, folder: Path) -> Path:
        """Write what ``cellquant observe`` leaves in its folder."""
        folder.mkdir(parents=True, exist_ok=True)
        units = self.tracks.units
        for name, table in self.tables.items():
            write_table(table, folder / f"{name}.parquet", units=units)
        write_json(folder / "summary.json", self.summary)
        write_json(folder / "run.json", self.record)
        return folder


class Stack:
    """The part of a label stack that a report reads."""

    def __init__(self, masks: np.ndarray, pixel_size: float, frame_interval: float) -> None:
        self.masks = masks
        self.frame_numbers = tuple(range(len(masks)))
        self.calibration = _Calibration(pixel_size, frame_interval, PHYSICAL)

    def __len__(self) -> int:
        return len(self.masks)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.masks[index]


@dataclass(frozen=True)
class _Calibration:
    pixel_size: float
    frame_interval: float
    units: Units
    source: str = "options"


def make_layer(
    *,
    n_frames: int = 24,
    side: int = 9,
    size: int = 240,
    seed: int = 0,
    simulated: bool = False,
    tau: float = 40.0,
    shape: float = 3.92,
) -> Layer:
    """Voronoi cells of points that wander, with observables of known form.

    F_s is a stretched exponential that crosses 1/e at `tau`; P(p) is a gamma distribution with
    mean `shape`.
    """
    rng = np.random.default_rng(seed)
    pixel = 0.05 if simulated else 1.3
    interval = 5.0 if simulated else 10.0
    units = REDUCED if simulated else PHYSICAL
    spacing = size / side
    points = (np.stack(np.meshgrid(*[np.arange(side)] * 2), -1).reshape(-1, 2) + 0.5) * spacing
    points = points + rng.normal(0, 0.15 * spacing, points.shape)
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2)
    masks = np.zeros((n_frames, size, size), np.int32)
    rows = []
    for frame in range(n_frames):
        distance, owner = cKDTree(points).query(grid)
        labels = np.where(distance < 0.72 * spacing, owner + 1, 0).reshape(size, size)
        masks[frame] = labels
        area = np.bincount(labels.ravel(), minlength=len(points) + 1)[1:] * pixel**2
        shape_index = 3.6 + rng.gamma(4.0, (shape - 3.6) / 4.0, len(points))
        for cell, (x, y) in enumerate(points * pixel):
            edge = min(x, y, size * pixel - x, size * pixel - y) < spacing * pixel / 2
            rows.append(
                (frame, cell + 1, x, y, area[cell], shape_index[cell] * np.sqrt(area[cell]),
                 shape_index[cell], 1.3, 0.1, edge, 6, cell + 1, 0, frame * interval)
            )  # fmt: skip
        points = np.clip(points + rng.normal(0, 0.06 * spacing, points.shape), 1, size - 2)
    columns = ["frame", "label", "x", "y", "area", "perimeter", "shape_index", "aspect_ratio",
               "orientation", "touches_border", "n_neighbours", "track_id", "parent_track_id",
               "time"]  # fmt: skip
    table = pd.DataFrame(rows, columns=columns)
    extent = size * pixel
    cells = Cells(
        table=table.drop(columns=["track_id", "parent_track_id", "time"]),
        units=units,
        pixel_size=pixel,
        frame_interval=interval,
        field_of_view=(extent, extent),
        n_frames=n_frames,
        occupied_area=np.full(n_frames, extent**2),
        faults={"fragments": 3, "holes": 0},
    )
    tracks = Tracks(
        table=table.sort_values(["track_id", "frame"], ignore_index=True),
        units=units,
        frame_interval=interval,
        area=extent**2,
        box=(extent, extent) if simulated else None,
        provenance={"search_range": 0.35 * spacing * pixel, "notes": ["IDs are per frame."]},
    )
    run = _run_of(points * pixel, spacing * pixel, extent, seed) if simulated else None
    summary, tables = _observables(tracks, tau=tau, shape=shape, seed=seed)
    record = {
        "program": "cellquant",
        "version": "0.1.0",
        "command": "observe",
        "settings": {"source": "movie <one>", "only": None, "smoothing": 5},
        "inputs": {"movie <one>/tracks.parquet": "ab" * 32},
        "notes": ["Frame 3 & 4 are <equal>."],
        "stages": [{"stage": "read", "wall_s": float(seed), "cpu_s": 0.1}],
    }
    return Layer(masks, cells, tracks, summary, tables, record, run)


def _run_of(points: np.ndarray, spacing: float, extent: float, seed: int) -> SimpleNamespace:
    """Three states of a run, as far as snapshots need them."""
    rng = np.random.default_rng(seed)
    n = len(points)
    return SimpleNamespace(
        time=np.array([50.0, 60.0, 70.0]),
        position=points[None] + rng.normal(0, 0.05 * spacing, (3, n, 2)),
        polarity=rng.uniform(0, 2 * np.pi, (3, n)),
        modes=rng.normal(0, 0.04, (3, n, 2, 5)),
        radius=np.full(n, spacing / 2),
        box=np.array([extent, extent]),
        scene=SimpleNamespace(phi=0.97, v0=0.03, eta=0.01),
    )


_QUANTILES = {"0.05": 0.02, "0.25": 0.05, "0.5": 0.09, "0.75": 0.13, "0.95": 0.21}


def _observables(
    tracks: Tracks, *, tau: float, shape: float, seed: int
) -> tuple[dict[str, Any], dict[str, pd.DataFrame]]:
    interval, units = tracks.frame_interval, tracks.units
    n_cells = tracks.n_tracks
    diameter = float(np.sqrt(4 * tracks.table["area"] / np.pi).mean())
    lag = interval * np.unique(np.round(np.geomspace(1, 60, 25)))
    scattering = np.exp(-((lag / tau) ** 0.8))
    mobility = 0.2 * diameter**2 * (lag / tau) ** 0.9
    edges = np.linspace(3.5, 5.5, 81)
    p = (edges[1:] + edges[:-1]) / 2
    scale = (shape - 3.6) / 4
    z = np.clip(p - 3.6, 0, None) / scale
    density = z**3 * np.exp(-z) / 6 / scale
    r = np.linspace(0.02, 2.0, 60)
    hove = np.exp(-(r**2) / 0.18) + 0.05 * np.exp(-r / 0.13)
    hove /= np.sum(hove) * (r[1] - r[0])

    def lagged(value: np.ndarray, error: np.ndarray) -> pd.DataFrame:
        return pd.DataFrame(
            {"lag_time": lag, "value": value, "std_error": error, "n_pairs": 500, "scope": "all"}
        )

    tables = {
        "self_intermediate_scattering": lagged(scattering, 0.02 + 0 * lag),
        "msd": lagged(mobility, 0.05 * mobility),
        "shape_index": pd.DataFrame(
            {"shape_index": p, "value": density, "std_error": 0.05 * density, "n": 100}
        ),
        "van_hove": pd.DataFrame(
            {
                "r": r,
                "value": hove,
                "std_error": 0.05 * hove,
                "gaussian": hove[0] * np.exp(-(r**2) / 0.18),
                "exponential": 0.05 * hove[0] * np.exp(-r / 0.13),
            }
        ),
        "relaxation_times": pd.DataFrame(
            {
                "bin_centre": [1100.0, 1350.0, 1600.0],
                "density": [1120.0, 1330.0, 1590.0],
                "tau_alpha": [0.8 * tau, tau, 1.4 * tau],
                "std_error": 0.06 * tau,
            }
        ),
    }
    summary = {
        "n_frames": int(tracks.table["frame"].nunique()),
        "n_cells_mean": float(n_cells),
        "n_tracks": n_cells,
        "length_unit": units.length,
        "time_unit": units.time,
        "density": {"mean": n_cells / tracks.area, "std_error": 0.01 * n_cells / tracks.area},
        "shape_index": {
            "mean": shape, "median": shape - 0.02, "mode": shape - 0.08, "std": 2 * scale,
            "skewness": 1.0, "std_error": 0.006, "n": 10 * n_cells,
            "median_std_error": 0.007, "mode_std_error": 0.01, "std_std_error": 0.004,
            "skewness_std_error": 0.1,
            "quantiles": {q: 3.6 + f * 3 for q, f in _QUANTILES.items()},
        },
        "wave_number": {
            "q": 2 * np.pi / diameter,
            "rule": "2pi/d",
            "mean_diameter": diameter,
            "mean_diameter_std_error": 0.004 * diameter,
            "q_peak": 6.1 / diameter,
        },
        "tau_alpha": {"value": tau, "std_error": 0.06 * tau, "censored_at": None},
        "van_hove": {
            "lag_time": tau, "sigma2": 0.09 + 0.001 * seed, "sigma2_std_error": 0.004, "xi": 0.13,
            "xi_std_error": 0.01, "normalisation": "radial", "core_range": [0, 0.5],
            "tail_range": [0.6, 1.2],
        },
        "speed": {
            "mean": 0.1 * diameter / interval, "median": 0.09 * diameter / interval,
            "std_error": 0.004 * diameter / interval, "dt": interval,
            "quantiles": {q: f * diameter / interval for q, f in _QUANTILES.items()},
        },
        "chi4_peak": {"value": None, "reason": "fewer than 100 tracks"},
    }  # fmt: skip
    return summary, tables
