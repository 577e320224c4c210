"""Stiff and extreme scenes: each ends with a right answer and its error, or a clear refusal.

Every scene is run for 20 t0 as `cellquant simulate` would, by the recommended scheme, and with
adaptive steps. Errors are RMS distances of the centres after about 1 t0 to a converged run on the
same Brownian path: later on, neighbouring trajectories part whatever the scheme. What remains
comparable then is the mean shape index over the last 10 t0.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np

from cellquant.errors import InputError
from cellquant.sim import Scene, SimulationFailure, simulate
from cellquant.sim.contacts import Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.integrators import find_method, recommended
from cellquant.sim.noise import BrownianTree
from cellquant.sim.steps import ROOT_DEPTH

RESULTS = Path(__file__).parent / "results"
LONG = 20.0
SHORT = 1.0
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
    "mu_ab 1, v0 0.3, eta 0": {"mu_ab": 1.0, "v0": 0.3, "eta": 0.0},
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


def attempt(scene, duration, **options):
    """(run, failure): the partial run where it stopped."""
    try:
        return simulate(scene, duration=duration, **options), None
    except SimulationFailure as failure:
        return failure.run, str(failure)


def by_euler(scene, span, n_spans, depth):
    """Centres after n_spans root intervals of the Brownian tree, by Euler steps span / 2^depth."""
    state, radius, box = initial_state(scene)
    method = find_method("euler")[1].make(Layer(scene, radius, box))
    tree = BrownianTree(scene.seed, scene.n_cells, span)
    still = np.zeros((2**depth, scene.n_cells))
    for root in range(n_spans):
        w, area = tree.level(root, depth) if scene.has_noise else (still, still)
        for index in range(2**depth):
            method.step(state, span / 2**depth, w[index], area[index])
    return state[:, :2]


def distance(a, b):
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


def late_shape_index(run):
    series = run.mean_shape_index()
    return float(series[len(series) // 2 :].mean())


def measure(scene):
    """Errors after SHORT, then the long runs."""
    name = recommended(scene, "exact")
    # Roots of the tree are as long for equal steps as a frame interval is for adaptive ones.
    span = find_method(name)[1].dt * 2**ROOT_DEPTH
    n_spans = math.ceil(SHORT / span)
    duration = n_spans * span
    found = {"scheme": name}
    usual, failure = attempt(scene, duration, save_every=span)
    if failure:
        return found | {"outcome": failure}
    if scene.rigid:
        exact, finer = (by_euler(scene, span, n_spans, depth) for depth in (9, 8))
        found["reference_error"] = distance(finer, exact)
    else:
        exact, finer = (
            simulate(scene, duration=duration, save_every=span, tolerance=tolerance).position[-1]
            for tolerance in (1e-5, 3e-5)
        )
        found["reference_error"] = distance(finer, exact)
        run, failure = attempt(scene, duration, save_every=span, tolerance=1e-3)
        found["adaptive_error"] = None if failure else distance(run.position[-1], exact)
    found["error"] = distance(usual.position[-1], exact)
    run, failure = attempt(scene, LONG, save_every=0.5)
    found |= {key: run.work[key] for key in ("steps", "repaired", "pinched_share")}
    found["outcome"] = failure or "solved"
    found["p"] = late_shape_index(run)
    if not scene.rigid:
        run, failure = attempt(scene, LONG, save_every=0.5, tolerance=1e-3)
        found["adaptive_steps"] = run.work["steps"]
        found["adaptive_outcome"] = failure or "solved"
        found["adaptive_p"] = late_shape_index(run)
    return found


def outcome(changes):
    """What becomes of a scene."""
    start = time.process_time()
    try:
        found = measure(Scene(**{"n_cells": 16, **changes}))
    except InputError as refusal:
        found = {"outcome": str(refusal)}
    return found | {"cpu": time.process_time() - start}


def main(names=None):
    """Try all scenes, or renew some of the stored ones."""
    path = RESULTS / "extreme_scenes.json"
    stored = json.loads(path.read_text()) if names else {}
    for name in names or SCENES:
        stored[name] = outcome(SCENES[name])
        print(f"{name:24s} {stored[name]}", flush=True)
        table = {known: stored[known] for known in SCENES if known in stored}
        RESULTS.mkdir(exist_ok=True)
        path.write_text(json.dumps(table, indent=1) + "\n")
    return stored


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="scenes to try again; all without any")
    main(parser.parse_args().names)
