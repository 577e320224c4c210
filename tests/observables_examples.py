"""Toy tracks with known answers, shared by the tests of observables and statistics."""

from typing import Any

import numpy as np
import pandas as pd

from cellquant.tables import PHYSICAL, REDUCED, Tracks, Units

FloatArray = np.ndarray[Any, np.dtype[np.float64]]


def tracks_of(
    positions: FloatArray,
    *,
    frame_interval: float = 1.0,
    units: Units = REDUCED,
    box: tuple[float, float] | None = None,
    area: float | None = None,
    cell_area: Any = np.pi / 4,
    shape_index: Any = 3.8,
    touches_border: Any = False,
) -> Tracks:
    """Tracks from positions (n_tracks, n_frames, 2); rows with NaN are left out."""
    n, t = positions.shape[:2]
    flat = positions.reshape(-1, 2)
    frame, track = np.tile(np.arange(t), n), np.repeat(np.arange(1, n + 1), t)

    def column(value: Any) -> Any:
        return np.broadcast_to(np.asarray(value), (n, t)).ravel()

    cell_area_column, shape = column(cell_area).astype(float), column(shape_index).astype(float)
    table = pd.DataFrame(
        {
            "frame": frame,
            "label": track,
            "x": flat[:, 0],
            "y": flat[:, 1],
            "area": cell_area_column,
            "perimeter": shape * np.sqrt(cell_area_column),
            "shape_index": shape,
            "aspect_ratio": 1.5,
            "orientation": 0.0,
            "touches_border": column(touches_border).astype(bool),
            "n_neighbours": 6,
            "track_id": track,
            "parent_track_id": 0,
            "time": frame * frame_interval,
        }
    )
    table = table[np.isfinite(flat).all(axis=1)].reset_index(drop=True)
    if area is None:
        area = box[0] * box[1] if box is not None else float(n)
    return Tracks(table, units, frame_interval, area, box)


def brownian(
    rng: np.random.Generator,
    n_tracks: int,
    n_frames: int,
    *,
    diffusion: float = 0.01,
    frame_interval: float = 1.0,
    edge: float | None = None,
    **more: Any,
) -> Tracks:
    """Independent Brownian walkers, started uniformly in a square."""
    edge = np.sqrt(n_tracks) if edge is None else edge
    steps = rng.normal(0, np.sqrt(2 * diffusion * frame_interval), (n_tracks, n_frames, 2))
    steps[:, 0] = rng.uniform(0, edge, (n_tracks, 2))
    return tracks_of(np.cumsum(steps, axis=1), frame_interval=frame_interval, **more)


def persistent(
    rng: np.random.Generator,
    n_tracks: int,
    n_frames: int,
    *,
    speed: float,
    persistence: float,
    frame_interval: float = 1.0,
    substeps: int = 20,
) -> Tracks:
    """Ornstein-Uhlenbeck velocities with <v^2> = speed^2, integrated exactly."""
    dt = frame_interval / substeps
    decay = np.exp(-dt / persistence)
    scale = speed / np.sqrt(2)
    # Joint law of the velocity and its integral over a step (Gillespie 1996).
    var_v = scale**2 * (1 - decay**2)
    var_x = scale**2 * persistence**2 * (2 * dt / persistence - 3 + 4 * decay - decay**2)
    cov = scale**2 * persistence * (1 - decay) ** 2
    factor = np.linalg.cholesky(np.array([[var_v, cov], [cov, var_x]]))
    v = rng.normal(0, scale, (n_tracks, 2))
    x = rng.uniform(0, np.sqrt(n_tracks), (n_tracks, 2))
    positions = np.empty((n_tracks, n_frames, 2))
    positions[:, 0] = x
    for frame in range(1, n_frames):
        for _ in range(substeps):
            noise = np.einsum("ij,jnk->ink", factor, rng.normal(size=(2, n_tracks, 2)))
            x = x + v * persistence * (1 - decay) + noise[1]
            v = v * decay + noise[0]
        positions[:, frame] = x
    return tracks_of(positions, frame_interval=frame_interval)


def with_gaps(tracks: Tracks, rng: np.random.Generator, share: float = 0.2) -> Tracks:
    """The same tracks with a share of the rows missing at random."""
    kept = rng.random(len(tracks.table)) > share
    return Tracks(
        tracks.table[kept].reset_index(drop=True), tracks.units, tracks.frame_interval,
        tracks.area, tracks.box,
    )  # fmt: skip


def movie(rng: np.random.Generator, **more: Any) -> Tracks:
    """A movie of 120 walkers, 60 frames of 10 min, in um and min, at 1500 cells/mm^2."""
    edge = np.sqrt(120 / 1500e-6)
    return brownian(
        rng, 120, 60, diffusion=0.4, frame_interval=10.0, edge=edge, area=edge**2,
        units=PHYSICAL, cell_area=np.pi * 10.0**2, **more,
    )  # fmt: skip
