"""Error against run time of contact rules, integrators and steps, measured on a scene."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from cellquant.errors import InputError
from cellquant.sim.contacts import ContactRule, Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.integrators import METHODS, recommended
from cellquant.sim.noise import BrownianTree
from cellquant.sim.recommendation import recommend
from cellquant.sim.scene import Scene, SimulationFailure
from cellquant.sim.shapes import measure_shapes
from cellquant.sim.steps import AdaptiveSteps, Plan
from cellquant.sim.weakerrors import Start, weak_errors
from cellquant.storage import replace_together

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

LONGEST = {"euler": 0.0625, "sra1": 0.0625, "implicit": 1.0, "rosenbrock": 0.5}
SHORTEST = {"euler": 0.0019, "sra1": 0.0039, "implicit": 0.0039, "rosenbrock": 0.0078}
PUBLISHED_STEPS = (0.016, 0.0036)  # longest and shortest, round 0.005
TOLERANCES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)
REFERENCE_STEP = 0.001
SHORT = 0.2  # CPU seconds below which a run is timed three times


class Candidate(NamedTuple):
    """One point of the diagram: a contact rule, an integrator, and its step or tolerance."""

    contact: ContactRule
    points: int
    integrator: str
    dt: float
    tolerance: float


@dataclass(frozen=True)
class Convergence:
    """Result of `convergence`.

    Attributes
    ----------
    table
        contact, points, integrator, dt (the mean one of the adaptive method), tolerance, seed,
        cpu_seconds, evaluations, error (RMS over the cells of the distance to the reference at
        the end, L0; NaN where the run failed), shape_error (error of <p>).
    weak
        Errors of averages over long runs, see `weak_errors`; empty where not asked for.
    sampling_error
        Standard error of <p> over the cells: errors of <p> below it cannot be told from chance.
    reference_error
        RMS distance between the references of two different methods, L0: errors near it are its.
    recommendation
        The recommended method, how it compares with the published scheme, and ``text``.
    """

    table: pd.DataFrame
    weak: pd.DataFrame
    sampling_error: float
    reference_error: float
    recommendation: dict[str, Any]


def convergence(
    scene: Scene,
    output: str | Path | None = None,
    *,
    duration: float = 4.0,
    transient: float = 60.0,
    weak_duration: float = 200.0,
    seeds: Sequence[int] = (1, 2, 3),
    points: Sequence[int] = (40,),
    integrators: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Convergence:
    """Measure the errors of every method against its CPU time, on common Brownian paths.

    From a state after `transient`, every contact rule, integrator and step runs over `duration`;
    the reference of the strong error has exact contacts and steps of 0.001 t0. Averages over runs
    of `weak_duration` give the weak errors.

    Parameters
    ----------
    scene
        The scene; at least a hundred cells make the averages steady.
    output
        Folder for ``convergence.parquet``, ``weak_errors.parquet``, ``convergence.json`` and
        ``convergence.svg``; None for none.
    duration, transient
        Times, t0.
    weak_duration
        Length of the runs for the weak errors, t0; 0 leaves them out.
    seeds
        Repetitions with other paths, radii and initial polarities.
    points
        Contour points of the quadrature rule.
    integrators
        Names of the methods to measure; None for all that the scene allows.
    progress
        Called with the number of runs done and to be done.

    Returns
    -------
    Convergence

    Raises
    ------
    InputError
        If a time is not positive, there is no seed, or an integrator is unknown.
    """
    for name, value in (("duration", duration), ("transient", transient)):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a finite time > 0 t0, got {value}; correct it.")
    if not (math.isfinite(weak_duration) and weak_duration >= 0.0):
        raise InputError(
            f"weak_duration must be a finite time >= 0 t0, got {weak_duration}; correct it."
        )
    if not seeds:
        raise InputError("seeds must name at least one seed, got none; give one.")
    candidates = _candidates(scene, duration, points, integrators)
    rows: list[dict[str, Any]] = []
    starts, spreads, doubts = [], [], []
    total = len(seeds) * (len(candidates) + 1) + (len(seeds) if weak_duration else 0)
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    for seed in seeds:
        seeded = scene.replace(seed=seed)
        start = _settled(seeded, transient)
        starts.append(start)
        tree = BrownianTree(seed + 1_000_003, scene.n_cells, duration)
        reference, doubt = _reference(start, tree)
        doubts.append(doubt)
        shapes = _shape_index(reference, start.radius)
        spreads.append(float(shapes.std(ddof=1)) / math.sqrt(len(shapes)) if len(shapes) > 1 else 0)
        advance()
        for candidate in candidates:
            rows.append(_measure(candidate, start, tree, reference, shapes) | {"seed": seed})
            advance()
    table = pd.DataFrame(rows)
    weak = pd.DataFrame()
    if weak_duration:
        weak = weak_errors(starts, weak_duration, points=points[0], advance=advance)
    sampling, doubt = float(np.mean(spreads)), float(np.max(doubts))
    advice = recommend(table, weak, recommended(scene, "exact"), points[0])
    result = Convergence(table, weak, sampling, doubt, advice)
    if output is not None:
        _write(result, Path(output), scene, duration)
    return result


def _candidates(
    scene: Scene, duration: float, points: Sequence[int], integrators: Sequence[str] | None
) -> list[Candidate]:
    possible = ["euler", "sra1"] if scene.rigid else list(METHODS)
    wanted = possible if integrators is None else list(integrators)
    for name in wanted:
        if name not in possible:
            raise InputError(
                f"integrators must be among {', '.join(possible)} for this scene, got {name!r}; "
                "choose others."
            )
    if not points:
        raise InputError("points must name at least one number of contour points; give 40.")
    found: list[Candidate] = []
    for name in wanted:
        if METHODS[name].adaptive:
            found += [Candidate("exact", 0, name, math.nan, tol) for tol in TOLERANCES]
        else:
            steps = _dyadic(duration, LONGEST[name], SHORTEST[name])
            found += [Candidate("exact", 0, name, h, math.nan) for h in steps]
    return found + [
        Candidate("quadrature", count, "euler", h, math.nan)
        for count in points
        for h in _dyadic(duration, *PUBLISHED_STEPS)
    ]


def _dyadic(duration: float, longest: float, shortest: float) -> list[float]:
    """Steps duration / 2^n between two lengths, the longest first; at least one."""
    first = max(0, math.ceil(math.log2(duration / longest)))
    last = max(first, math.floor(math.log2(duration / shortest)))
    return [duration / 2**n for n in range(first, last + 1)]


def _settled(scene: Scene, transient: float) -> Start:
    state, radius, box = initial_state(scene)
    layer = Layer(scene, radius, box)
    name = recommended(scene, "exact")
    tree = BrownianTree(scene.seed, scene.n_cells, 0.4)
    depth = math.ceil(math.log2(0.4 / METHODS[name].usual_step(scene)))
    method = METHODS[name].make(layer)
    for root in range(math.ceil(transient / 0.4)):
        w, area = tree.level(root, depth)
        for index in range(2**depth):
            method.step(state, 0.4 / 2**depth, w[index], area[index])
    return Start(scene, state, radius, box)


def _reference(start: Start, tree: BrownianTree) -> tuple[Floats, float]:
    """Final state by the method of the highest order, and its distance to that of another one."""
    scene = start.scene
    depth = math.ceil(math.log2(tree.span / REFERENCE_STEP))
    h = tree.span / 2**depth
    ends = []
    for name in ("euler", "sra1") if scene.rigid else ("sra1", "rosenbrock"):
        try:
            layer = Layer(scene, start.radius, start.box)
            candidate = Candidate("exact", 0, name, h, math.nan)
            ends.append(_integrate(candidate, layer, start, tree)[0])
        except SimulationFailure:
            if name != "sra1" or scene.rigid:  # an explicit method may fail on very stiff shapes
                raise
    return ends[-1], _distance(ends[0], ends[-1]) if len(ends) > 1 else math.nan


def _measure(
    candidate: Candidate, start: Start, tree: BrownianTree, reference: Floats, shapes: Floats
) -> dict[str, Any]:
    row: dict[str, Any] = candidate._asdict()
    times = []
    try:
        for repetition in range(4):
            layer = Layer(
                start.scene, start.radius, start.box,
                contact=candidate.contact, points=candidate.points or 40,
            )  # fmt: skip
            begin = time.process_time()
            state, steps = _integrate(candidate, layer, start, tree)
            spent = time.process_time() - begin
            if repetition > 0 or spent > SHORT:  # the first one loads what is compiled
                times.append(spent)
            if spent > SHORT:
                break
    except SimulationFailure:
        failed = dict.fromkeys(("error", "shape_error", "cpu_seconds"), math.nan)
        return row | failed | {"evaluations": 0}
    return row | {
        "dt": tree.span / steps,
        "error": _distance(state, reference),
        "shape_error": float(np.mean(_shape_index(state, start.radius) - shapes)),
        "cpu_seconds": float(np.median(times)),
        "evaluations": layer.evaluations,
    }


def _integrate(
    candidate: Candidate, layer: Layer, start: Start, tree: BrownianTree
) -> tuple[Floats, int]:
    state = start.state.copy()
    if METHODS[candidate.integrator].adaptive:
        plan = Plan(tree.span, 1, 0, 2)
        steps = AdaptiveSteps(layer, plan, candidate.tolerance, tree)
        steps.advance(state, 0)
        count = steps.count
    else:
        count = round(tree.span / candidate.dt)
        w, area = tree.level(0, round(math.log2(count)))
        method = METHODS[candidate.integrator].make(layer)
        for index in range(count):
            method.step(state, candidate.dt, w[index], area[index])
    if not np.isfinite(state).all():
        raise SimulationFailure("the state is not finite", "take a smaller step")
    return state, count


def _distance(state: Floats, reference: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum((state[:, :2] - reference[:, :2]) ** 2, axis=1))))


def _shape_index(state: Floats, radius: Floats) -> Floats:
    modes = state[:, 3:].reshape(len(state), 2, -1)
    shapes = measure_shapes(modes, state[:, 2], radius)
    return np.asarray(shapes["shape_index"], np.float64)


def _write(result: Convergence, folder: Path, scene: Scene, duration: float) -> None:
    from cellquant.sim.precisionfigure import draw

    content = {
        "scene": scene.to_dict(),
        "duration": duration,
        "sampling_error": result.sampling_error,
        "reference_error": result.reference_error,
        "recommendation": result.recommendation,
    }
    with replace_together(folder) as place:
        result.table.to_parquet(place / "convergence.parquet", index=False)
        if len(result.weak):
            result.weak.to_parquet(place / "weak_errors.parquet", index=False)
        text = json.dumps(content, indent=1, sort_keys=True)
        (place / "convergence.json").write_text(text + "\n", encoding="utf-8")
        draw(result.table, result.weak, result.sampling_error, place / "convergence.svg")
