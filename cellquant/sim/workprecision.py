"""Error against run time of contact rules, integrators and steps, measured on a scene."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cellquant.errors import InputError
from cellquant.sim.contacts import ContactRule, Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.integrators import METHODS, recommended
from cellquant.sim.noise import BrownianTree
from cellquant.sim.scene import Scene, SimulationFailure
from cellquant.sim.shapes import measure_shapes

Floats = NDArray[np.float64]
PUBLISHED = ("quadrature", "euler", 40)
PUBLISHED_DT = 0.005
REFERENCE_DEPTH = 12


@dataclass(frozen=True)
class Convergence:
    """Result of `convergence`.

    Attributes
    ----------
    table
        contact, points, integrator, dt, seed, cpu_seconds, evaluations, error (RMS over the cells
        of the distance to the reference at the end, L0; NaN where the run failed), shape_error
        (error of <p>).
    sampling_error
        Standard error of <p> over the cells: errors of <p> below it cannot be told from chance.
    recommendation
        contact, integrator, dt, and how it compares with the published scheme.
    """

    table: pd.DataFrame
    sampling_error: float
    recommendation: dict[str, Any]


def convergence(
    scene: Scene,
    output: str | Path | None = None,
    *,
    duration: float = 4.0,
    transient: float = 60.0,
    seeds: tuple[int, ...] = (1, 2, 3),
    points: tuple[int, ...] = (40,),
    progress: Callable[[int, int], None] | None = None,
) -> Convergence:
    """Measure the strong error of every method against its CPU time, on one Brownian path.

    From a state after `transient`, every contact rule, integrator and step runs over `duration` on
    the same path; the reference is SRA1 with exact contacts at duration / 4096.

    Parameters
    ----------
    scene
        The scene; at least a hundred cells make the averages steady.
    output
        Folder for ``convergence.parquet``, ``convergence.json`` and ``convergence.svg``; None
        for none.
    duration, transient
        Times, t0.
    seeds
        Repetitions with other paths, radii and initial polarities.
    points
        Contour points of the quadrature rule.

    Returns
    -------
    Convergence

    Raises
    ------
    InputError
        If a time is not positive or there is no seed.
    """
    for name, value in (("duration", duration), ("transient", transient)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a finite time > 0 t0, got {value}; correct it.")
    if not seeds:
        raise InputError("seeds must name at least one seed, got none; give one.")
    candidates = _candidates(scene, points)
    rows: list[dict[str, Any]] = []
    spreads = []
    total = len(seeds) * (len(candidates) + 1)
    for number, seed in enumerate(seeds):
        seeded = scene.replace(seed=seed)
        start, radius, box = _settled(seeded, transient)
        tree = BrownianTree(seed + 1_000_003, scene.n_cells, duration)
        exact = Layer(seeded, radius, box)
        name = "euler" if scene.rigid else "sra1"
        reference, _ = _integrate(exact, name, start, tree, REFERENCE_DEPTH)
        shapes = _shape_index(reference, radius)
        spreads.append(float(shapes.std(ddof=1)) / math.sqrt(len(shapes)) if len(shapes) > 1 else 0)
        for index, (contact, integrator, count, depth) in enumerate(candidates):
            layer = Layer(seeded, radius, box, contact=cast(ContactRule, contact), points=count)
            row = {
                "contact": contact,
                "points": count if contact == "quadrature" else 0,
                "integrator": integrator,
                "dt": duration / 2**depth,
                "seed": seed,
            }
            try:
                state, cpu = _integrate(layer, integrator, start, tree, depth)
                row["error"] = _distance(state, reference)
                row["shape_error"] = float(np.mean(_shape_index(state, radius) - shapes))
            except SimulationFailure:
                row["error"], row["shape_error"], cpu = math.nan, math.nan, math.nan
            row["cpu_seconds"], row["evaluations"] = cpu, layer.evaluations
            rows.append(row)
            if progress is not None:
                progress(number * (len(candidates) + 1) + index + 2, total)
    table = pd.DataFrame(rows)
    result = Convergence(table, float(np.mean(spreads)), _recommend(table, scene))
    if output is not None:
        _write(result, Path(output), scene, duration)
    return result


def _candidates(scene: Scene, points: tuple[int, ...]) -> list[tuple[str, str, int, int]]:
    """Contact rule, integrator, points and depth (steps are duration / 2^depth)."""
    depths = {"euler": range(6, 12), "sra1": range(6, 10), "implicit": range(4, 11)}
    found = [
        ("exact", name, 0, depth)
        for name in METHODS
        if name in depths and not (name == "implicit" and scene.rigid)
        for depth in depths[name]
    ]
    found = [(contact, name, 40, depth) for contact, name, _, depth in found]
    return found + [("quadrature", "euler", count, d) for count in points for d in (8, 9, 10)]


def _settled(scene: Scene, transient: float) -> tuple[Floats, Floats, Floats]:
    state, radius, box = initial_state(scene)
    layer = Layer(scene, radius, box)
    name = recommended(scene, "exact")
    h = METHODS[name].dt
    depth = 2
    tree = BrownianTree(scene.seed, scene.n_cells, h * 2**depth)
    for root in range(math.ceil(transient / (h * 2**depth))):
        state, _ = _integrate(layer, name, state, tree, depth, root)
    return state, radius, box


def _integrate(
    layer: Layer, name: str, start: Floats, tree: BrownianTree, depth: int, root: int = 0
) -> tuple[Floats, float]:
    method = METHODS[name].make(layer)
    w, area = tree.level(root, depth)
    h = tree.span / 2**depth
    method.step(start.copy(), h, w[0], area[0])  # loads what is compiled, makes the lists
    state = start.copy()
    layer.evaluations = 0
    begin = time.process_time()
    for index in range(2**depth):
        method.step(state, h, w[index], area[index])
    if not np.isfinite(state).all():
        raise SimulationFailure("the state is not finite", "take a smaller step")
    return state, time.process_time() - begin


def _distance(state: Floats, reference: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum((state[:, :2] - reference[:, :2]) ** 2, axis=1))))


def _shape_index(state: Floats, radius: Floats) -> Floats:
    modes = state[:, 3:].reshape(len(state), 2, -1)
    shapes = measure_shapes(modes, state[:, 2], radius)
    return np.asarray(shapes["shape_index"], np.float64)


def _rms(values: "pd.Series[float]") -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _recommend(table: pd.DataFrame, scene: Scene) -> dict[str, Any]:
    """Cheapest method at the published error, and the most exact one at the published time."""
    keys = ["contact", "points", "integrator", "dt"]
    means = table.groupby(keys, as_index=False)[["error", "cpu_seconds"]].agg(
        {"error": _rms, "cpu_seconds": "median"}
    )
    means = means.dropna()
    contact, integrator, points = PUBLISHED
    published = means[
        (means["contact"] == contact)
        & (means["integrator"] == integrator)
        & (means["points"] == points)
    ]
    if published.empty:
        return {"integrator": recommended(scene, "exact"), "contact": "exact"}
    nearest = published.iloc[(published["dt"] - PUBLISHED_DT).abs().argmin()]
    # The published step lies between two measured ones; time goes as 1 / dt.
    cpu = float(nearest["cpu_seconds"] * nearest["dt"] / PUBLISHED_DT)
    error = float(nearest["error"])
    ours = means[means["contact"] == "exact"]
    found: dict[str, Any] = {"published_error": error, "published_cpu_seconds": cpu}
    good = ours[ours["error"] <= error]
    if not good.empty:
        best = good.iloc[int(good["cpu_seconds"].to_numpy().argmin())]
        found |= {
            "contact": "exact",
            "integrator": str(best["integrator"]),
            "dt": float(best["dt"]),
            "cpu_ratio_at_published_error": float(best["cpu_seconds"]) / cpu,
        }
    quick = ours[ours["cpu_seconds"] <= cpu]
    if not quick.empty:
        best = quick.iloc[int(quick["error"].to_numpy().argmin())]
        found |= {
            "error_ratio_at_published_time": float(best["error"]) / error,
            "integrator_at_published_time": str(best["integrator"]),
            "dt_at_published_time": float(best["dt"]),
        }
    return found


def _write(result: Convergence, folder: Path, scene: Scene, duration: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    result.table.to_parquet(folder / "convergence.parquet", index=False)
    content = {
        "scene": scene.to_dict(),
        "duration": duration,
        "sampling_error": result.sampling_error,
        "recommendation": result.recommendation,
    }
    text = json.dumps(content, indent=1, sort_keys=True)
    (folder / "convergence.json").write_text(text + "\n", encoding="utf-8")
    draw(result, folder / "convergence.svg")


def draw(result: Convergence, path: Path) -> None:
    """Draw the work-precision diagram: strong error against CPU time, one curve per method."""
    import matplotlib as mpl

    mpl.use("svg")
    import matplotlib.pyplot as plt

    with mpl.rc_context({"svg.hashsalt": "cellquant", "svg.fonttype": "none"}):
        figure, axes = plt.subplots(1, 2, figsize=(9.5, 4.2), layout="constrained")
        for (contact, integrator, points), group in result.table.groupby(
            ["contact", "integrator", "points"]
        ):
            means = group.groupby("dt")[["cpu_seconds", "error", "shape_error"]].agg(
                {
                    "cpu_seconds": "median",
                    "error": _rms,
                    "shape_error": _rms,
                }
            )
            name = f"{contact} {points or ''} {integrator}".replace("  ", " ")
            axes[0].loglog(means["cpu_seconds"], means["error"], "o-", label=name)
            axes[1].loglog(means["cpu_seconds"], means["shape_error"], "o-", label=name)
        axes[1].axhline(result.sampling_error, color="0.5", linestyle="--", label="sampling error")
        axes[0].set_ylabel("RMS error of positions / L0")
        axes[1].set_ylabel("error of <p>")
        for axis in axes:
            axis.set_xlabel("CPU time / s")
            axis.legend(fontsize=7)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)
