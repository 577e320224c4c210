"""Largest differences from loops written out from the definitions and from other programs.

    python benchmarks/observable_oracles.py

The same data go through cellquant and the oracle. Needs freud-analysis, trackpy and tidynamics;
one that is not there is left out. Writes results/observable_oracles.json.
"""

import importlib
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path

os.environ["NUMBA_NUM_THREADS"] = "1"

import numpy as np
import pandas as pd
from scipy.special import j0
from scipy.stats import gaussian_kde

from cellquant.observables import kernels
from cellquant.observables.blocks import Blocks
from cellquant.observables.bonds import bond_order
from cellquant.observables.correlations import velocity_autocorrelation
from cellquant.observables.dynamics import (
    displacement_moments,
    mean_square_displacement,
    overlap,
    scattering_average,
)
from cellquant.observables.motion import displacements
from cellquant.observables.pairs import pair_correlation
from cellquant.observables.shape import describe
from cellquant.observables.smoothing import from_tracks
from cellquant.observables.structure import structure_factor
from cellquant.tables import REDUCED, Tracks

RESULTS = Path(__file__).parent / "results"
LAGS = np.array([1, 2, 5, 9, 20])
Q = 5.0
ANGLES = np.pi * (np.arange(8) + 0.5) / 8
Row = tuple[str, str, float, str]


def tracks_of(place: np.ndarray, box: tuple[float, float] | None = None) -> Tracks:
    """Tracks from positions (n_tracks, n_frames, 2); a NaN is a missing frame."""
    n, t = place.shape[:2]
    table = pd.DataFrame(
        {
            "frame": np.tile(np.arange(t), n), "x": place[..., 0].ravel(),
            "y": place[..., 1].ravel(), "touches_border": False,
            "track_id": np.repeat(np.arange(1, n + 1), t),
        }
    )  # fmt: skip
    table = table[np.isfinite(table["x"])].reset_index(drop=True)
    return Tracks(table, REDUCED, 1.0, float(n), box)


def walkers(n: int, t: int, gaps: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(n)
    step = rng.normal(0, 0.3, (n, t, 2))
    step[:, 0] = rng.uniform(0, np.sqrt(n), (n, 2))
    place = np.cumsum(step, axis=1)
    place[rng.random((n, t)) < gaps] = np.nan
    return place


def loops() -> list[Row]:
    """Double loops over tracks, lags and time origins, with a quarter of the frames missing."""
    place = walkers(25, 40, 0.25)
    terms: dict[str, Callable[[np.ndarray], float]] = {
        "MSD": lambda d: float(d @ d),
        "fourth moment": lambda d: float(d @ d) ** 2,
        "F_s, exact average": lambda d: float(j0(Q * np.hypot(*d))),
        "F_s, eight directions": lambda d: float(
            np.mean(np.cos(Q * (np.cos(ANGLES) * d[0] + np.sin(ANGLES) * d[1])))
        ),
        "Q": lambda d: float(np.hypot(*d) <= 0.4),
    }
    sums = {name: np.zeros(LAGS.size) for name in terms}
    count = np.zeros(LAGS.size)
    for path in place:
        for m, lag in enumerate(LAGS):
            for i in range(len(path) - lag):
                d = path[i + lag] - path[i]
                if np.isfinite(d).all():
                    count[m] += 1
                    for name, term in terms.items():
                        sums[name][m] += term(d)
    tracks = tracks_of(place)
    second, fourth = displacement_moments(tracks, lags=LAGS)
    found = {
        "MSD": second.value,
        "fourth moment": fourth.value,
        "F_s, exact average": scattering_average(tracks, Q, lags=LAGS).value,
        "F_s, eight directions": scattering_average(tracks, Q, lags=LAGS, method="vectors").value,
        "Q": overlap(tracks, 0.4, lags=LAGS).overlap["value"].to_numpy(),
    }
    rows = []
    for name, value in found.items():
        truth = sums[name] / count
        worst = np.max(np.abs(value - truth) / np.maximum(np.abs(truth), 1))
        rows.append((name, "double loop, gaps", float(worst), ""))
    velocity = np.diff(place, axis=1)
    lags = np.array([0, 1, 4])
    vacf = [
        np.nanmean(np.sum(velocity[:, : velocity.shape[1] - k] * velocity[:, k:], axis=2))
        for k in lags
    ]
    worst = np.abs(velocity_autocorrelation(from_tracks(tracks), lags=lags).value - vacf).max()
    rows.append(("velocity autocorrelation", "array arithmetic, gaps", float(worst), ""))
    return rows


def sums_over_vectors() -> list[Row]:
    box = (10.0, 8.0)
    place = np.random.default_rng(1).uniform(0, 1, (60, 3, 2)) * box
    found = structure_factor(tracks_of(place, box), max_wave_number=5.0).table
    step = 2 * np.pi / np.array(box)
    shells: dict[int, list[float]] = {}
    for a in range(20):
        for b in range(-20, 20):
            q = step * (a, b)
            if 0 < np.hypot(*q) <= 5.0 and not (a == 0 and b < 0):
                power = np.mean(np.abs(np.exp(-1j * place @ q).sum(axis=0)) ** 2) / 60
                shells.setdefault(max(int(np.hypot(*q) / step.max() - 0.5), 0), []).append(power)
    truth = np.array([np.mean(shells[k]) for k in sorted(shells)])
    worst = np.max(np.abs(found["value"].to_numpy() - truth) / truth)
    return [("S(q)", "sum over vectors", float(worst), "")]


def special() -> list[Row]:
    x = np.linspace(0, 100, 200001)
    worst = np.abs(kernels.bessel_j0(x, kernels._J0_TABLE) - j0(x)).max()
    values = np.random.default_rng(2).gamma(3, 0.1, 3000) + 3.6
    shape = describe(values, Blocks(np.arange(3000) % 16, 16, "blocks"))
    width = shape.summary["bandwidth"] / values.std(ddof=1)
    density = gaussian_kde(values, width)(shape.table["value"].to_numpy())
    away = np.abs(shape.table["kernel_density"].to_numpy() - density).max() / density.max()
    return [
        ("J0 for 0 <= x <= 100", "scipy", float(worst), ""),
        ("kernel density of shapes", "scipy", float(away), "grid of a tenth of the bandwidth"),
    ]


def trackpy_rows() -> list[Row]:
    import trackpy

    place = walkers(30, 60)
    tracks = tracks_of(place)
    one = tracks.table[tracks.table["track_id"] == 3]
    alone = Tracks(one, REDUCED, 1.0, 1.0)
    peer = trackpy.motion.msd(
        one.rename(columns={"track_id": "particle"}), mpp=1.0, fps=1.0, max_lagtime=40, detail=True
    )
    mine = mean_square_displacement(alone, lags=np.arange(1, 41))["value"].to_numpy()
    msd = np.max(np.abs(mine / peer["msd"].to_numpy() - 1))
    wide = tracks.table.pivot(index="frame", columns="track_id", values="x")
    edges = np.linspace(-3, 3, 31)
    peer = trackpy.motion.vanhove(wide, 4, mpp=1.0, ensemble=True, bins=edges)
    dx = displacements(from_tracks(tracks), 4)[0]
    mine = np.histogram(dx, bins=edges)[0] / dx.size / 0.2
    hove = np.max(np.abs(mine - peer.to_numpy()))
    return [
        ("MSD of one track", "trackpy", float(msd), "its ensemble mean weighs tracks, not pairs"),
        ("1-D van Hove", "trackpy", float(hove), ""),
    ]


def tidynamics_rows() -> list[Row]:
    import tidynamics

    place = walkers(30, 60)
    peer = np.mean([tidynamics.msd(p) for p in place], axis=0)[1:]
    mine = mean_square_displacement(tracks_of(place), lags=np.arange(1, 60))["value"].to_numpy()
    return [("MSD", "tidynamics", float(np.max(np.abs(mine / peer - 1))), "by FFT")]


def freud_rows() -> list[Row]:
    import freud

    place = walkers(30, 60)
    cube = np.zeros((60, 30, 3))
    cube[..., :2] = place.transpose(1, 0, 2)
    peer = freud.msd.MSD(mode="window").compute(cube).msd[1:]
    mine = mean_square_displacement(tracks_of(place), lags=np.arange(1, 60))["value"].to_numpy()
    rows = [("MSD", "freud", float(np.max(np.abs(mine / peer - 1))), "single precision")]
    gas = np.random.default_rng(6).uniform(0, 12, (300, 2))
    layer = tracks_of(gas[:, None], (12.0, 12.0))
    box = freud.box.Box.square(12.0)
    points = np.column_stack([gas - 6, np.zeros(300)]).astype(np.float32)
    cells = freud.locality.Voronoi().compute((box, points))
    hexatic = freud.order.Hexatic(k=6, weighted=False)
    hexatic.compute((box, points), neighbors=cells.nlist)
    order = float(np.abs(hexatic.particle_order).mean())
    away = abs(bond_order(layer).summary["mean"] / order - 1)
    rows.append(("hexatic order", "freud", float(away), "single precision"))
    rdf = freud.density.RDF(bins=40, r_max=4.0, normalization_mode="finite_size")
    rdf.compute((box, points), reset=True)
    mine = pair_correlation(layer, max_distance=4.0, bin_width=0.1).table["value"].to_numpy()
    away = np.max(np.abs(mine - rdf.rdf))
    rows.append(("g(r)", "freud", float(away), "single precision moves pairs across ring edges"))
    return rows


def main() -> None:
    warnings.filterwarnings("ignore", message="Starting with pandas version")
    rows = [*loops(), *sums_over_vectors(), *special()]
    for name, peers in (
        ("trackpy", trackpy_rows), ("tidynamics", tidynamics_rows), ("freud", freud_rows),
    ):  # fmt: skip
        try:
            importlib.import_module(name)
        except ImportError:
            print(f"{name} is not installed")
        else:
            rows += peers()
    for quantity, oracle, worst, note in rows:
        print(f"| {quantity} | {oracle} | {worst:.1e} | {note} |")
    RESULTS.mkdir(exist_ok=True)
    keys = ("quantity", "oracle", "largest_difference", "note")
    content = [dict(zip(keys, row, strict=True)) for row in rows]
    (RESULTS / "observable_oracles.json").write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
