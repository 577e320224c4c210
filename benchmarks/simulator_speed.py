"""Contact rules side by side: force error, cost, threads, scaling, memory, absent terms.

Everything that is compared is timed in turns within one process; CPU time, medians and spread.
"""

import json
import math
import time
import tracemalloc
from pathlib import Path

import numba
import numpy as np

from cellquant.sim.contacts import Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.integrators import Implicit
from cellquant.sim.lanes import load_pair, store, zeros
from cellquant.sim.noise import BrownianTree
from cellquant.sim.scene import Scene
from cellquant.sim.steps import FixedSteps, Plan

RESULTS = Path(__file__).parent / "results"


def settle(scene, transient):
    """A state after a transient, by the implicit method."""
    state, radius, box = initial_state(scene)
    method = Implicit(Layer(scene, radius, box))
    tree = BrownianTree(scene.seed, scene.n_cells, 0.4)
    for root in range(round(transient / 0.4)):
        w, area = tree.level(root, 2)
        for step in range(4):
            method.step(state, 0.1, w[step], area[step])
    return state, radius, box


def radius_at(row, r0, modes, angle):
    """Contour radius at given directions, straight from the definition."""
    a, b = row[3 : 2 + modes, None], row[2 + modes :, None]
    n = np.arange(2, modes + 1)[:, None]
    turned = n * (angle - row[2])
    mean = math.sqrt(1.0 - 0.5 * float(np.sum(row[3:] ** 2)))
    return r0 * (mean + np.sum(a * np.cos(turned) + b * np.sin(turned), axis=0))


def reference_velocity(scene, state, radius, box, samples=4000):
    """Forces from dense sampling and bisection; arcs integrated by Gauss-Legendre rules."""
    modes = scene.modes
    n = np.arange(2, modes + 1)[:, None]
    out = np.zeros_like(state)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    pairs = Layer(scene, radius, box)
    pairs.velocity(state, np.empty_like(state))
    phi = 2 * np.pi * np.arange(samples + 1) / samples
    length = 2 * np.pi * np.arange(1024) / 1024
    for i, row in enumerate(state):
        gradient = np.zeros(state.shape[1])
        mean = math.sqrt(1.0 - 0.5 * float(np.sum(row[3:] ** 2)))

        def derivative(angle, row=row, r0=radius[i], mean=mean):
            turned = n * (angle - row[2])
            basis = np.concatenate([np.cos(turned), np.sin(turned)])
            slopes = np.concatenate([-n * np.sin(turned), n * np.cos(turned)])
            return r0 * (basis - 0.5 * row[3:, None] / mean), r0 * slopes, r0 * row[3:] @ slopes

        rho = radius_at(row, radius[i], modes, length)
        grad, slopes, slope = derivative(length)
        arc = np.sqrt(rho**2 + slope**2)
        gradient[3:] += scene.eta * 2 * np.pi * ((grad * rho + slopes * slope) / arc).mean(axis=1)
        lists = [(pairs._other[p], pairs._shift[p]) for p in range(*pairs._first[i : i + 2])]
        back = range(*pairs._back_first[i : i + 2])
        lists += [(pairs._back_cell[b], -pairs._shift[pairs._back_pair[b]]) for b in back]
        for j, shift in lists:
            offset = state[j, :2] + shift - row[:2]

            def depth(angle, row=row, j=j, offset=offset, r0=radius[i]):
                rho = radius_at(row, r0, modes, angle)
                x, y = rho * np.cos(angle) - offset[0], rho * np.sin(angle) - offset[1]
                return radius_at(state[j], radius[j], modes, np.arctan2(y, x)) - np.hypot(x, y)

            g = depth(phi)
            at = np.flatnonzero((g[:-1] > 0) != (g[1:] > 0))
            if len(at) == 0:
                continue
            low, high = phi[at].copy(), phi[at + 1].copy()
            up = g[at] > 0
            for _ in range(60):
                middle = 0.5 * (low + high)
                same = (depth(middle) > 0) == up
                low, high = np.where(same, middle, low), np.where(same, high, middle)
            root = 0.5 * (low + high)
            if up[0]:  # the first crossing leaves the arc that the last one entered
                root, up = np.roll(root, 1), np.roll(up, 1)
            for start, stop in zip(root[~up], root[up], strict=True):
                stop += 2 * np.pi * (stop < start)
                ends = np.array([start, stop])
                r = radius_at(row, radius[i], modes, ends)
                x, y = r * np.cos(ends), r * np.sin(ends)
                gradient[0] += y[1] - y[0]
                gradient[1] -= x[1] - x[0]
                gradient[2] -= 0.5 * (r[1] ** 2 - r[0] ** 2)
                angle = start + 0.5 * (stop - start) * (nodes + 1)
                r = radius_at(row, radius[i], modes, angle)
                gradient[3:] += derivative(angle)[0] @ (r * weights) * 0.5 * (stop - start)
        out[i] = -gradient
        out[i, 3:] *= scene.mu_ab
        out[i, :2] += scene.v0 * np.array([np.cos(row[2]), np.sin(row[2])])
    return out


def force_error():
    """Relative RMS error of translational force, torque and shape force on steady states."""
    table = []
    for phi, v0, eta in [(0.85, 0.03, 0.01), (0.97, 0.03, 0.01), (0.97, 0.07, 0.01),
                         (0.97, 0.01, 0.08), (1.0, 0.03, 0.01)]:  # fmt: skip
        scene = Scene(n_cells=100, phi=phi, v0=v0, eta=eta)
        state, radius, box = settle(scene, 100.0)
        expected = reference_velocity(scene, state, radius, box)
        drive = np.zeros_like(state)
        drive[:, 0], drive[:, 1] = v0 * np.cos(state[:, 2]), v0 * np.sin(state[:, 2])
        row = {"phi": phi, "v0": v0, "eta": eta}
        for contact in ("exact", "quadrature"):
            found = np.empty_like(state)
            Layer(scene, radius, box, contact=contact).velocity(state, found)
            for name, columns in (("force", slice(0, 2)), ("torque", slice(2, 3)),
                                  ("shape", slice(3, None))):  # fmt: skip
                error = np.sum((found - expected)[:, columns] ** 2)
                whole = np.sum((expected - drive)[:, columns] ** 2)
                row[f"{contact}_{name}"] = math.sqrt(error / whole)
            row[f"{contact}_net_force"] = float(np.abs((found - drive)[:, :2].sum(axis=0)).max())
        table.append(row)
        print(row, flush=True)
    return table


def in_turns(jobs, rounds=40):
    """Median and quartiles of the CPU time of each job, in seconds, taken in turns."""
    times = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for _ in range(rounds):
        for name, job in jobs.items():
            start = time.process_time()
            job()
            times[name].append(time.process_time() - start)
    return {name: np.percentile(t, [50, 25, 75, 0]).tolist() for name, t in times.items()}


def evaluation(layer, state):
    out = np.empty_like(state)
    return lambda: layer.velocity(state, out)


@numba.njit(fastmath={"contract"})
def probe(count, numbers):
    """Products and sums that keep the arithmetic of one core busy."""
    a, b = load_pair(numbers, 0), load_pair(numbers, 8)
    c, d = load_pair(numbers, 16), load_pair(numbers, 24)
    e, factor, term = load_pair(numbers, 32), load_pair(numbers, 40), load_pair(numbers, 48)
    for _ in range(count):
        a, b, c = a * factor + term, b * factor + term, c * factor + term
        d, e = d * factor + term, e * factor + term
    store(numbers, 0, a + b + (c + d) + e)


def probed_turns(jobs, rounds):
    """CPU time (rounds, jobs) in turns, and the time (rounds,) of a probe before and after each."""

    def timed(job):
        start = time.process_time()
        job()
        return time.process_time() - start

    numbers = zeros(56)
    numbers[:] = 0.5

    def look():
        return timed(lambda: probe(12_000, numbers))

    for job in jobs:
        job()
    probe(1, numbers)
    table, probes = [], []
    for _ in range(rounds):
        row, seen = [], [look()]
        for job in jobs:
            row.append(timed(job))
            seen.append(look())
        table.append(row)
        probes.append(max(seen))
    return np.array(table), np.array(probes)


def price_of(table):
    """Medians, their ratio, and the spread of the ratio from turn to turn."""
    exact, rule = np.median(table, axis=0)
    return {
        "turns": len(table),
        "exact": exact,
        "40 points": rule,
        "ratio": exact / rule,
        "quartiles": np.percentile(table[:, 0] / table[:, 1], [25, 75]).tolist(),
        "cells_per_second": 1024 / exact,
    }


def cost():
    """One exact against one 40-point evaluation, N = 1024, one thread.

    On a machine that others use, another's work on the same core slows all that runs. A probe of
    constant work, timed before and after every evaluation, tells when: turns in which it took 5 %
    longer than at its best are told apart.
    """
    numba.set_num_threads(1)
    scene = Scene(n_cells=1024)
    state, radius, box = settle(scene, 100.0)
    rules = ("exact", "quadrature")
    jobs = [evaluation(Layer(scene, radius, box, contact=rule), state) for rule in rules]
    table, probes = probed_turns(jobs, 2000)
    quiet = probes < 1.05 * np.percentile(probes, 0.5)
    return {
        "all": price_of(table),
        "undisturbed": price_of(table[quiet]) if quiet.any() else None,
        "ratio_of_least": float(np.divide(*table.min(axis=0))),
    }


def threads():
    """Wall time with one and two threads, in turns."""
    scene = Scene(n_cells=4096)
    state, radius, box = settle(scene, 4.0)
    job = evaluation(Layer(scene, radius, box), state)
    walls = {1: [], 2: []}
    if numba.config.NUMBA_NUM_THREADS < 2:
        return None
    for _ in range(200):
        for count in (1, 2):
            numba.set_num_threads(count)
            job()
            start = time.perf_counter()
            job()
            walls[count].append(time.perf_counter() - start)
    numba.set_num_threads(1)
    medians = [float(np.median(walls[count])) for count in (1, 2)]
    return {
        "speed_up": min(walls[1]) / min(walls[2]),
        "of_medians": medians[0] / medians[1],
        "least": [min(walls[count]) for count in (1, 2)],
    }


def scaling():
    """Time per cell of one evaluation, and memory per cell, against the number of cells.

    Turns of the same number of cells, so that what disturbs one size disturbs the others as much.
    """
    numba.set_num_threads(1)
    sizes = (1024, 4096, 16384, 65536)
    jobs, memory = {}, {}
    for n_cells in sizes:
        scene = Scene(n_cells=n_cells)
        state, radius, box = settle(scene, 0.4)
        tracemalloc.start()
        layer = Layer(scene, radius, box)
        job = evaluation(layer, state)
        job()
        memory[n_cells] = tracemalloc.get_traced_memory()[0] / n_cells
        tracemalloc.stop()
        jobs[n_cells] = repeated(job, sizes[-1] // n_cells)
    found = in_turns(jobs, rounds=25)
    table = [
        {"cells": n, "ns_per_cell": found[n][0] / sizes[-1] * 1e9, "bytes": memory[n]}
        for n in sizes
    ]
    print(table, flush=True)
    return table


def repeated(job, times):
    def several():
        for _ in range(times):
            job()

    return several


def steps(scene, state, radius, box):
    """A job: sixteen implicit steps of 0.1 t0 from a state."""
    plan = Plan.of(1.6, 0.0, 1.6, 0.1)
    walk = FixedSteps(Layer(scene, radius, box), "implicit", plan)
    return lambda: walk.advance(state.copy(), 0)


def features():
    """Specialised against general kernels on scenes that lack a term."""
    numba.set_num_threads(1)
    table = {}
    for name, changes in {
        "torque-free": {"mu_theta": 0.0},
        "tension-free": {"eta": 0.0},
        "passive, no torque, no tension": {"v0": 0.0, "mu_theta": 0.0, "eta": 0.0},
    }.items():
        scene = Scene(n_cells=1024, **changes)
        state, radius, box = settle(Scene(n_cells=1024), 20.0)
        found = in_turns({
            "lean": evaluation(Layer(scene, radius, box), state),
            "general": evaluation(Layer(scene, radius, box, general=True), state),
        })  # fmt: skip
        table[name] = found["lean"][0] / found["general"][0]
    state, radius, box = settle(Scene(n_cells=1024), 20.0)
    found = in_turns({
        name: steps(Scene(n_cells=1024, D_r=noise), state, radius, box)
        for name, noise in (("lean", 0.0), ("general", 1e-30))
    })  # fmt: skip
    table["noiseless (whole steps)"] = found["lean"][0] / found["general"][0]
    discs = Scene(n_cells=1024, modes=1)
    state, radius, box = initial_state(discs)
    general = np.zeros((1024, 13))
    general[:, :3] = state
    found = in_turns({
        "rigid": evaluation(Layer(discs, radius, box), state),
        "general": evaluation(Layer(Scene(n_cells=1024), radius, box), general),
    })  # fmt: skip
    table["rigid discs"] = found["rigid"][0] / found["general"][0]
    return table


def main():
    content = {}
    for part in (cost, force_error, features, threads, scaling):
        content[part.__name__] = part()
        print(part.__name__, json.dumps(content[part.__name__], indent=1), flush=True)
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "simulator_speed.json").write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
