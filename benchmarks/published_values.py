"""Simulated values beside the published ones, for both contact rules, several seeds.

Runs are kept in a folder and resumed, so that the table can be made longer at any time:

    python benchmarks/published_values.py --folder RUNS --cells 256 --transient 2000 --duration 2000
"""

import argparse
import json
from pathlib import Path

import numpy as np

from cellquant.observables import observe
from cellquant.sim import Scene, SimulationFailure, simulate

RESULTS = Path(__file__).parent / "results"
POINTS = [
    {
        "phi": 0.97,
        "v0": 0.03,
        "eta": 0.01,
        "published": {"p": 3.800, "sigma2": 0.103, "xi": 0.0692},
    },
    {"phi": 0.95, "v0": 0.03, "eta": 0.01, "published": {"p": 3.751}},
]
RULES = {
    "exact, implicit": {"contact": "exact"},
    "40 points, euler 0.005": {"contact": "quadrature", "integrator": "euler", "dt": 0.005},
}


def measure(run):
    """Shape index, its drift, and the relaxation of one run."""
    series = run.mean_shape_index()
    half = len(series) // 2
    found = {
        "p": float(series.mean()),
        "p_drift": float(series[half:].mean() - series[:half].mean()),
        "cpu_seconds": run.work["cpu_seconds"],
    }
    summary = observe(run.to_tracks(), only=["tau_alpha", "van_hove"]).summary
    hove = summary.get("van_hove") or {}
    return found | {
        "tau_alpha": summary["tau_alpha"]["value"],
        "sigma2": hove.get("sigma2"),
        "xi": hove.get("xi"),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--cells", type=int, default=1024)
    parser.add_argument("--transient", type=float, default=5000.0)
    parser.add_argument("--duration", type=float, default=5000.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--save-every", type=float, default=5.0)
    options = parser.parse_args()
    rows = []
    for rule, settings in RULES.items():
        for point in POINTS:
            scene = {k: v for k, v in point.items() if k != "published"}
            for seed in options.seeds:
                name = f"{rule.split(',')[0].replace(' ', '')}_{scene['phi']}_{seed}.zarr"
                try:
                    run = simulate(
                        Scene(n_cells=options.cells, seed=seed, **scene),
                        duration=options.duration,
                        transient=options.transient,
                        save_every=options.save_every,
                        output=options.folder / name,
                        **settings,
                    )
                except SimulationFailure as failure:
                    rows.append({"rule": rule, **scene, "seed": seed, "failure": str(failure)})
                    print(rows[-1], flush=True)
                    continue
                rows.append({"rule": rule, **scene, "seed": seed, **measure(run)})
                print(rows[-1], flush=True)
                write(rows, options)


def write(rows, options):
    """Means over the seeds and their standard errors, beside the published values."""
    table = []
    for rule in RULES:
        for point in POINTS:
            chosen = [
                r for r in rows if r["rule"] == rule and r["phi"] == point["phi"] and "p" in r
            ]
            if not chosen:
                continue
            entry = {"rule": rule, **point, "n_seeds": len(chosen)}
            for key in ("p", "p_drift", "tau_alpha", "sigma2", "xi", "cpu_seconds"):
                values = np.array([r[key] for r in chosen if r[key] is not None], float)
                if len(values):
                    entry[key] = float(values.mean())
                if len(values) > 1:
                    entry[key + "_std_error"] = float(values.std(ddof=1) / np.sqrt(len(values)))
            table.append(entry)
    RESULTS.mkdir(exist_ok=True)
    content = {
        "cells": options.cells,
        "transient": options.transient,
        "duration": options.duration,
        "table": table,
        "runs": rows,
    }
    (RESULTS / "published_values.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
