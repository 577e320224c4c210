"""Simulated values beside the published ones, for both contact rules, several seeds and sizes.

Runs are kept in a folder and resumed; what is there is measured, however long it is:

    python benchmarks/published_values.py simulate --folder RUNS --rule exact --cells 256 --seed 1
    python benchmarks/published_values.py measure --folder RUNS

A run starts from a hexagonal lattice, or from the last state of another (`--start RUN.zarr`). The
transient left out is the shortest of 0.1, 0.2, ... 0.6 of the run after which `Run.stationarity`
sees no drift of <p>; where there is none, the second half is measured and the row says that it
drifts.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import skew

from cellquant.observables import observe
from cellquant.sim import Scene, open_run, simulate
from cellquant.sim.shapes import pinched, shape_indices
from cellquant.tables import TRACK_COLUMNS

RESULTS = Path(__file__).parent / "results"
PUBLISHED = {
    (0.97, 0.03, 0.01): {"p": 3.800, "sigma2": 0.103, "xi": 0.0692},
    (0.95, 0.03, 0.01): {"p": 3.751},
}
RULES = {
    "exact": {"contact": "exact"},
    "exact_fine": {"contact": "exact", "dt": 0.025},
    "40points": {"contact": "quadrature", "integrator": "euler", "dt": 0.005},
}
LONG = 20_000.0  # t0 that a run may go on for; it is measured whenever one likes
SAVE_EVERY = 5.0
FRESH_NOISE = 1000  # added to the seed of runs that start from another's last state
LEAST = 300.0  # t0 below which a run is not measured
KEYS = (
    "p",
    "drift",
    "tau_alpha",
    "sigma2",
    "xi",
    "pinched_share",
    "skewness",
    "length",
    "transient",
)


def go_on(options):
    """Simulate one layer until it is stopped."""
    scene = Scene(
        n_cells=options.cells, phi=options.phi, v0=options.v0, eta=options.eta, seed=options.seed
    )
    point = f"{options.phi}_{options.v0}_{options.eta}"
    name = f"{options.rule}_{options.cells}_{point}_{options.seed}.zarr"
    if options.start is not None:
        run = open_run(options.start)
        state = run.state(-1)
        scene = scene.replace(
            radii=run.radius, box=run.box, positions=state[:, :2], polarities=state[:, 2],
            shapes=state[:, 3:], seed=FRESH_NOISE + options.seed,
        )  # fmt: skip
    simulate(
        scene, duration=LONG, save_every=SAVE_EVERY, output=options.folder / name,
        **RULES[options.rule],
    )  # fmt: skip


def steady_part(run):
    """(first frame, test): the shortest transient after which <p> does not drift."""
    for tenths in range(1, 7):
        start = run.n_frames * tenths // 10
        test = run.stationarity(start=start)
        if test.stationary:
            return start, test
    start = run.n_frames // 2
    return start, run.stationarity(start=start)


def measure(path):
    """Shape index, its drift, and the relaxation of the steady part of one run."""
    run = open_run(path)
    scene = run.scene
    rule = path.stem.rsplit("_", 5)[0]
    start, test = steady_part(run)
    shapes = ("perimeter", "shape_index", "aspect_ratio", "orientation", "n_neighbours")
    tracks = run.to_tracks(columns=[name for name in TRACK_COLUMNS if name not in shapes])
    late = tracks.table[tracks.table["frame"] >= start].copy()
    late["frame"] -= start
    late["time"] -= float(run.time[start])
    summary = observe(replace(tracks, table=late), only=["tau_alpha", "van_hove"]).summary
    hove = summary.get("van_hove") or {}
    series = run.mean_shape_index()
    return {
        "rule": rule,
        "cells": scene.n_cells,
        "phi": scene.phi,
        "v0": scene.v0,
        "eta": scene.eta,
        "seed": scene.seed,
        "started_from": "lattice" if scene.shapes is None else "state",
        "length": float(run.time[-1]),
        "transient": float(run.time[start]),
        "stationary": test.stationary,
        "p": float(series[start:].mean()),
        "drift": test.drift,
        "drift_std_error": test.std_error,
        "p_300": float(series[run.time <= 300.0][-20:].mean()),
        "p_1000": float(series[run.time <= 1000.0][-20:].mean()) if run.time[-1] > 1000 else None,
        "tau_alpha": summary["tau_alpha"]["value"],
        "censored_at": summary["tau_alpha"]["censored_at"],
        "sigma2": hove.get("sigma2"),
        "xi": hove.get("xi"),
        "pinched_share": float(np.mean(pinched_share(run)[start:])),
        "skewness": float(skew(shapes_of_cells(run, start))),
    }


def shapes_of_cells(run, start):
    """Shape index of every cell at a hundred frames of the steady part."""
    frames = np.linspace(start, run.n_frames - 1, 100).astype(int)
    return np.concatenate([shape_indices(run.modes[t]) for t in frames])


def pinched_share(run):
    """Share of pinched cells at every frame."""
    modes = run.modes
    return np.array([pinched(modes[t]).mean() for t in range(run.n_frames)])


def tabulate(rows):
    """Means over the seeds and their standard errors, beside the published values."""
    table = []
    names = ("rule", "cells", "phi", "v0", "eta", "started_from")
    for key in sorted({tuple(r[name] for name in names) for r in rows}):
        chosen = [r for r in rows if tuple(r[name] for name in names) == key]
        entry = dict(zip(names, key, strict=True))
        entry["n_seeds"] = len(chosen)
        entry["n_stationary"] = sum(r["stationary"] for r in chosen)
        entry["published"] = PUBLISHED.get(key[2:5], {})
        for name in KEYS:
            values = np.array([r[name] for r in chosen if r.get(name) is not None], float)
            if len(values):
                entry[name] = float(values.mean())
            if len(values) > 1:
                entry[name + "_std_error"] = float(values.std(ddof=1) / np.sqrt(len(values)))
        table.append(entry)
    return table


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=["simulate", "measure"])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--rule", choices=sorted(RULES), default="exact")
    parser.add_argument("--cells", type=int, default=1024)
    parser.add_argument("--phi", type=float, default=0.97)
    parser.add_argument("--v0", type=float, default=0.03)
    parser.add_argument("--eta", type=float, default=0.01)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=Path, help="run whose last state is the first one")
    options = parser.parse_args()
    if options.task == "simulate":
        go_on(options)
        return
    rows = []
    for path in sorted(options.folder.glob("*.zarr")):
        run = open_run(path)
        if run.n_frames < 2 or run.time[-1] < LEAST:
            continue
        rows.append(measure(path))
        print(rows[-1], flush=True)
    RESULTS.mkdir(exist_ok=True)
    content = {"table": tabulate(rows), "runs": rows}
    (RESULTS / "published_values.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
