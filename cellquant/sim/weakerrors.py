"""Weak errors: what integrator and step do to averages over long runs."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cellquant.observables import observe
from cellquant.sim.archive import Run, append_frames, create_group, write_constants
from cellquant.sim.contacts import ContactRule, Layer
from cellquant.sim.integrators import METHODS
from cellquant.sim.noise import BrownianTree
from cellquant.sim.scene import Scene, SimulationFailure

Floats = NDArray[np.float64]

INTERVAL = 1.28  # t0 between frames: 256 steps of the published 0.005
Point = tuple[ContactRule, str, float]
DEFORMABLE: tuple[Point, ...] = (
    ("exact", "rosenbrock", 0.02),
    ("exact", "euler", 0.01),
    ("exact", "implicit", 0.08),
    ("exact", "implicit", 0.16),
    ("exact", "implicit", 0.32),
    ("exact", "implicit", 0.64),
    ("quadrature", "euler", 0.005),
)  # the first one is the reference
RIGID: tuple[Point, ...] = (
    ("exact", "euler", 0.0025),
    ("exact", "euler", 0.005),
    ("exact", "euler", 0.02),
)


class Start(NamedTuple):
    """A settled layer."""

    scene: Scene
    state: Floats
    radius: Floats
    box: Floats


def weak_errors(
    starts: Sequence[Start],
    duration: float,
    *,
    points: int = 40,
    advance: Callable[[], None] | None = None,
) -> pd.DataFrame:
    """Means of <p>, MSD, F_s and tau_alpha by every method, against the finest one.

    Every start runs once per method, on the same Brownian path. <p> is averaged over the second
    half of the run; MSD and F_s are taken at a quarter of it.

    Returns
    -------
    DataFrame
        contact, points, integrator, dt, observable, value (mean over the starts), difference (to
        the reference, mean over the starts, paired), difference_std_error, sampling_error (of the
        reference over the starts: a smaller difference cannot be told from chance), n (starts
        that gave a value: tau_alpha has none where F_s stays above 1/e), cpu_seconds per t0.
        NaN where not measurable.
    """
    rows: list[dict[str, Any]] = []
    for number, start in enumerate(starts):
        methods = RIGID if start.scene.rigid else DEFORMABLE
        for contact, integrator, dt in methods:
            values, spent = _averages(start, contact, integrator, dt, points, duration)
            rows += [
                {
                    "contact": contact,
                    "points": points if contact == "quadrature" else 0,
                    "integrator": integrator,
                    "dt": dt,
                    "observable": name,
                    "start": number,
                    "value": value,
                    "cpu_seconds": spent / duration,
                }
                for name, value in values.items()
            ]
        if advance is not None:
            advance()
    table = pd.DataFrame(rows)
    keys = ["contact", "points", "integrator", "dt"]
    first = table[keys].iloc[0]
    reference = table[(table[keys] == first).all(axis=1)].set_index(["observable", "start"])[
        "value"
    ]
    out = []
    for key, group in table.groupby([*keys, "observable"], sort=False):
        here = group.set_index(["observable", "start"])["value"]
        base = reference.loc[here.index]
        apart = (here - base).dropna()
        out.append(
            dict(zip([*keys, "observable"], key, strict=True))
            | {
                "value": here.mean(),
                "difference": apart.mean(),
                "difference_std_error": _standard_error(apart),
                "sampling_error": _standard_error(base.dropna()),
                "n": int(here.notna().sum()),
                "cpu_seconds": float(group["cpu_seconds"].median()),
            }
        )
    return pd.DataFrame(out)


def _standard_error(values: "pd.Series[float]") -> float:
    return float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def _averages(
    start: Start, contact: ContactRule, integrator: str, dt: float, points: int, duration: float
) -> tuple[dict[str, float], float]:
    scene = start.scene
    layer = Layer(scene, start.radius, start.box, contact=contact, points=points)
    method = METHODS[integrator].make(layer)
    tree = BrownianTree(scene.seed + 2_000_003, scene.n_cells, INTERVAL)
    depth = round(math.log2(INTERVAL / dt))
    state = start.state.copy()
    frames = [state.copy()]
    still = np.zeros(scene.n_cells)
    begin = time.process_time()
    names = ("shape_index", "msd", "scattering", "tau_alpha")
    try:
        for interval in range(max(8, round(duration / INTERVAL))):
            w, area = tree.level(interval, depth) if scene.has_noise else (None, None)
            for index in range(2**depth):
                if w is None or area is None:
                    method.step(state, dt, still, still)
                else:
                    method.step(state, dt, w[index], area[index])
            frames.append(state.copy())
    except SimulationFailure:
        return dict.fromkeys(names, math.nan), math.nan
    spent = time.process_time() - begin
    group = create_group(None, scene, {"save_every": INTERVAL})
    write_constants(group, start.radius, start.box)
    times = INTERVAL * np.arange(len(frames), dtype=np.float64)
    append_frames(group, 0, times, np.array(frames))
    run = Run(group)
    lag = max(1, (len(frames) - 1) // 4)
    found = observe(
        run, only=["msd", "self_intermediate_scattering", "tau_alpha"], min_points=2,
        lags=sorted({*np.unique(np.geomspace(1, len(frames) - 1, 30).astype(int)).tolist(), lag}),
    )  # fmt: skip
    at = lag * INTERVAL
    tau = found.summary["tau_alpha"]["value"]
    values = (
        float(run.mean_shape_index()[len(frames) // 2 :].mean()),
        _at(found.tables["msd"], at),
        _at(found.tables["self_intermediate_scattering"], at),
        math.nan if tau is None else float(tau),
    )
    return dict(zip(names, values, strict=True)), spent


def _at(table: pd.DataFrame, lag_time: float) -> float:
    nearest = (table["lag_time"] - lag_time).abs().to_numpy().argmin()
    return float(table["value"].to_numpy()[nearest])
