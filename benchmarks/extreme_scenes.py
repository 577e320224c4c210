"""Stiff and extreme scenes: each ends with a right answer and its error, or a clear refusal.

The error is the RMS distance to a run with a tenth of the tolerance on the same Brownian path.
"""

import json
import math
import time
from pathlib import Path

import numpy as np

from cellquant.errors import InputError
from cellquant.sim import Scene, simulate

RESULTS = Path(__file__).parent / "results"
DURATION = 1.0
SCENES = {
    "reference": {},
    "dilute, phi 0.1": {"phi": 0.1},
    "phi 1.0": {"phi": 1.0},
    "phi 1.2": {"phi": 1.2},
    "phi 1.2, fast": {"phi": 1.2, "v0": 0.3},
    "v0 0": {"v0": 0.0},
    "v0 0.3": {"v0": 0.3},
    "v0 1": {"v0": 1.0},
    "eta 0": {"eta": 0.0},
    "eta 0.1": {"eta": 0.1},
    "eta 1": {"eta": 1.0},
    "D_r 0": {"D_r": 0.0},
    "D_r 1": {"D_r": 1.0},
    "D_r 10": {"D_r": 10.0},
    "mu_ab 0": {"mu_ab": 0.0},
    "mu_ab 1": {"mu_ab": 1.0},
    "mu_ab 10": {"mu_ab": 10.0},
    "mu_ab 10, eta 1": {"mu_ab": 10.0, "eta": 1.0},
    "mu_theta 0": {"mu_theta": 0.0},
    "rigid": {"modes": 1, "phi": 0.8},
    "M 2": {"modes": 2},
    "M 12": {"modes": 12},
    "polydispersity 0": {"polydispersity": 0.0},
    "polydispersity 0.3": {"polydispersity": 0.3},
    "one cell": {"n_cells": 1},
    "two cells": {"n_cells": 2},
    "four cells": {"n_cells": 4},
    "box of one cell width": {"n_cells": 3, "box": (1.0, 4.0)},
    "on top of each other": {"positions": ((2.0, 2.0),) * 16},
    "two almost on top": {"n_cells": 2, "box": (3, 3), "positions": ((1, 1), (1.001, 1))},
    "sixteen almost on top": {"positions": tuple((2.0 + 1e-3 * i, 2.0) for i in range(16))},
    "random start": {"initial": "random"},
    "box far too small": {"n_cells": 16, "box": (2.0, 2.0)},
}


def outcome(changes):
    """What becomes of a scene: (outcome, error, steps, seconds)."""
    start = time.process_time()
    try:
        scene = Scene(**{"n_cells": 16, **changes})
        if scene.rigid:
            options = [{"dt": 0.002}, {"dt": 0.001}]
        else:
            options = [{"tolerance": 1e-3}, {"tolerance": 1e-4}]
        runs = [simulate(scene, duration=DURATION, save_every=DURATION, **o) for o in options]
    except InputError as refusal:
        return {"outcome": str(refusal), "error": None, "cpu": time.process_time() - start}
    coarse, fine = (run.position[-1] for run in runs)
    error = float(np.sqrt(np.mean(np.sum((coarse - fine) ** 2, axis=1))))
    assert math.isfinite(error)
    return {
        "outcome": "solved",
        "error": error,
        "steps": runs[0].work["steps"],
        "rejected": runs[0].work["rejected"],
        "cpu": time.process_time() - start,
    }


def main():
    table = {}
    for name, changes in SCENES.items():
        table[name] = outcome(changes)
        print(f"{name:24s} {table[name]}", flush=True)
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "extreme_scenes.json").write_text(json.dumps(table, indent=1) + "\n")
    return table


if __name__ == "__main__":
    main()
