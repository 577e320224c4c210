"""Which scenes match a layer: distances between distributions and scalars, and their ranking.

It rests on features, numbers that a movie and a run have in common. A feature is compared in
units of its uncertainty, in which the errors of both sides are combined.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cellquant.compare.groups import Group
from cellquant.compare.results import look_up
from cellquant.compare.units import convert_units_file
from cellquant.errors import InputError

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
MATCH = 2.0  # mean distance in combined standard errors up to which a scene is said to match
LEVEL = 0.05  # chance of being the best below which a scene is told apart from the best one


@dataclass(frozen=True)
class Units:
    """L0 and t0 in the units of a movie, each with its standard error.

    With them, lengths and times of the movie count as features; without, only pure numbers do.
    """

    length: tuple[float, float]
    time: tuple[float, float]


REDUCED_UNITS = Units((1.0, 0.0), (1.0, 0.0))


def units_of_file(path: str | Path) -> Units:
    """L0 in um and t0 in min from a units file (`cellquant.compare.units`).

    Raises
    ------
    InputError
        If the file is wrong, or L0 or t0 does not follow from it.
    """
    converted = convert_units_file(path)["measured"]
    for name in ("L0", "t0"):
        if name not in converted:
            raise InputError(
                f"{path} does not fix {name}; give it, or what it follows from "
                "('cellquant convert-units' says what is missing)."
            )
    length, time = converted["L0"], converted["t0"]
    return Units(
        (length["value"], length["std_error"]), (time["value"] / 60, time["std_error"] / 60)
    )


# Pure numbers, and numbers with a unit as (key, power of length, power of time, logarithm).
_PURE = ("shape_index.mean", "shape_index.std", "shape_index.skewness", "van_hove.sigma2",
         "van_hove.xi", "msd.exponent", "alpha2_peak.value")  # fmt: skip
_WITH_UNIT = (
    ("tau_alpha.value", 0, 1),
    ("speed.mean", 1, -1),
    ("msd.diffusion_coefficient", 2, -1),
)
MAX_INTERVAL_RATIO = 1.5  # of the frame intervals of two speeds that may be compared


@dataclass(frozen=True)
class Feature:
    """A number of one group, in reduced units; positive scale-like ones as their logarithm.

    Attributes
    ----------
    value
        The number.
    own_error
        Its standard error without that of the units.
    unit_error
        What the errors of L0 and of t0 add to it, with their sign: shared with every other
        feature of the group that carries these units.
    """

    value: float
    own_error: float
    unit_error: tuple[float, float] = (0.0, 0.0)

    @property
    def std_error(self) -> float:
        """Standard error, that of the units included."""
        return math.hypot(self.own_error, *self.unit_error)


def features_of(group: Group, units: Units | None) -> dict[str, Feature]:
    """The features of a group, by name; those that are not known, or lack an error, are left out.

    Parameters
    ----------
    group
        A movie or a simulated scene.
    units
        L0 and t0 in the units of the group; None where they are not known.
    """
    scalars = group.scalars()
    found = {}
    for key in _PURE:
        scalar = scalars.get(key)
        if scalar is not None and math.isfinite(scalar.value) and scalar.std_error > 0:
            found[key] = Feature(scalar.value, scalar.std_error)
    if units is None:
        return found
    for key, length, time in _WITH_UNIT:
        scalar = scalars.get(key)
        if scalar is None or not scalar.value > 0 or not scalar.std_error > 0:
            continue
        unit = units.length[0] ** length * units.time[0] ** time
        shared = (
            -length * units.length[1] / units.length[0],
            -time * units.time[1] / units.time[0],
        )
        own = scalar.std_error / scalar.value
        found[key] = Feature(math.log(scalar.value / unit), own, shared)
    return found


@dataclass(frozen=True)
class Rank:
    """Where one scene stands.

    Attributes
    ----------
    name, scene
        Of the candidate.
    distance
        Root of the mean squared distance over the features, in combined standard errors.
    best_probability
        Share of the bootstrap draws in which it is the closest.
    interval
        Central 90 % range of its rank over the draws, 1 for the closest.
    parts
        Distance by feature.
    """

    name: str
    scene: Mapping[str, float]
    distance: float
    best_probability: float
    interval: tuple[int, int]
    parts: Mapping[str, float]


@dataclass(frozen=True)
class Ranking:
    """Candidates from the closest to the farthest.

    Attributes
    ----------
    ranks
        One per candidate.
    features
        Names of the features that all candidates and the target have.
    left_out
        Names of those that some of them lack.
    """

    ranks: tuple[Rank, ...]
    features: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def not_distinguishable(self) -> tuple[Rank, ...]:
        """The closest, and all that are the closest in at least one draw of twenty."""
        first, *rest = self.ranks
        return (first, *(r for r in rest if r.best_probability >= LEVEL))

    def statement(self) -> str:
        """In words: which scene is closest, which cannot be told apart from it, if they match."""
        first, *others = self.not_distinguishable
        names = "; ".join(rank.name for rank in others)
        if others:
            found = f"{first.name} is closest, but not distinguishable from {names}."
        else:
            found = f"{first.name} is closest, in {first.best_probability:.0%} of the draws."
        if first.distance <= MATCH:
            return found
        return f"{found} It does not match: {first.distance:.2f} combined standard errors apart."


def rank_candidates(
    target: Group,
    candidates: Sequence[Group],
    *,
    units: Units | None = None,
    n_draws: int = 2000,
    seed: int = 0,
) -> Ranking:
    """Rank scenes by how closely their distributions and scalars match a target.

    The distance of two distributions (shape index, displacement at tau_alpha) is Wasserstein's,
    ``W1 = int |F - G|``; that of two scalars is their difference. Each is divided by the combined
    standard error, for distributions that of their mean, and the root of the mean square over
    features is the distance. The bootstrap draws every feature of every group again from its
    error; the target's draw is shared by all candidates, as its error is.

    Parameters
    ----------
    target
        The layer to match.
    candidates
        Simulated scenes.
    units
        L0 and t0 in the target's units; pure numbers only when None.
    n_draws
        Bootstrap draws.
    seed
        Seed of the draws; equal seeds give equal rankings.

    Raises
    ------
    InputError
        If there are fewer than two candidates, or no feature is known of all of them.

    References
    ----------
    Efron & Tibshirani, An Introduction to the Bootstrap (1993), section 6.5 (parametric).
    """
    if len(candidates) < 2:
        raise InputError(
            f"{len(candidates)} scene is given and a ranking needs two or more; add the folder of "
            "a sweep."
        )
    names, left_out, target_features, tables = common_features(target, candidates, units)
    curves = [
        (name, table, x)
        for name, table, x in (("P(p)", "shape_index", "shape_index"), ("G_s", "van_hove", "r"))
        if all(group.curve(table, x=x) is not None for group in (target, *candidates))
    ]
    signed, ours, theirs = [], [], []
    for name in names:
        signed.append([t[name].value - target_features[name].value for t in tables])
        ours.append(target_features[name].std_error)
        theirs.append([t[name].std_error for t in tables])
    for _, table, x in curves:
        measured = [_distribution(group, table, x) for group in (target, *candidates)]
        first, *rest = measured
        signed.append([_wasserstein(first, other) for other in rest])
        ours.append(first[2])
        theirs.append([other[2] for other in rest])
    delta, spread = np.array(signed), np.array(theirs)
    own = np.array(ours)[:, None]
    scale = np.hypot(own, spread)
    parts = np.abs(delta) / scale
    distance = np.sqrt((parts**2).mean(axis=0))
    rng = np.random.default_rng(seed)
    order = np.empty((n_draws, len(candidates)), dtype=np.int64)
    for draw in range(n_draws):
        shared = own * rng.standard_normal((len(own), 1))
        noise = spread * rng.standard_normal(spread.shape) - shared
        drawn = np.sqrt((((delta + noise) / scale) ** 2).mean(axis=0))
        order[draw] = np.argsort(np.argsort(drawn, kind="stable"), kind="stable") + 1
    labels = [*names, *(name for name, _, _ in curves)]
    ranks = [
        Rank(
            group.name,
            group.scene,
            float(distance[i]),
            float((order[:, i] == 1).mean()),
            (int(np.quantile(order[:, i], 0.05)), int(np.quantile(order[:, i], 0.95))),
            dict(zip(labels, parts[:, i].tolist(), strict=True)),
        )
        for i, group in enumerate(candidates)
    ]
    return Ranking(tuple(sorted(ranks, key=lambda r: r.distance)), tuple(labels), left_out)


def common_features(
    target: Group, candidates: Sequence[Group], units: Units | None
) -> tuple[tuple[str, ...], tuple[str, ...], dict[str, Feature], list[dict[str, Feature]]]:
    """Features that the target and all candidates have, and those that only some have.

    Returns
    -------
    shared, left_out : tuple of str
    ours : dict
    theirs : list of dict
    """
    ours = features_of(target, units)
    theirs = [features_of(g, REDUCED_UNITS if units is not None else None) for g in candidates]
    if units is not None and not all(_same_speed(target, g, units) for g in candidates):
        ours.pop("speed.mean", None)
    every = list(dict.fromkeys([*ours, *(name for table in theirs for name in table)]))
    shared = tuple(n for n in every if n in ours and all(n in table for table in theirs))
    if not shared:
        raise InputError(
            f"{target.name} and the scenes have no feature with a standard error in common; "
            "observe them with the same observables."
        )
    return shared, tuple(n for n in every if n not in shared), ours, theirs


def _same_speed(target: Group, candidate: Group, units: Units) -> bool:
    """Whether both speeds stand for about the same time, smoothed alike."""
    ours, theirs = target.members[0].summary, candidate.members[0].summary
    first, second = look_up(ours, "speed.dt"), look_up(theirs, "speed.dt")
    if first is None or second is None:
        return False
    key = "processing.smoothing_points"
    ratio = abs(math.log(first / units.time[0] / second))
    return look_up(ours, key) == look_up(theirs, key) and ratio <= math.log(MAX_INTERVAL_RATIO)


Distribution = tuple[FloatArray, FloatArray, float]


def _distribution(group: Group, table: str, x: str) -> Distribution:
    """Points, cumulative distribution, and standard error of the mean."""
    curve = group.curve(table, x=x)
    assert curve is not None
    weight = np.nan_to_num(np.clip(curve.y, 0, None))
    if x == "r":
        weight = weight * curve.x  # from probability per area to probability
    total = np.concatenate([[0.0], np.cumsum(0.5 * (weight[1:] + weight[:-1]) * np.diff(curve.x))])
    scalars = group.scalars()
    if x == "r":
        core = scalars.get("van_hove.sigma2")
        error = math.nan
        if core is not None and core.value > 0:
            # The mean of r is sqrt(pi sigma2)/2 for the core exp(-r^2/sigma2).
            error = math.sqrt(math.pi) / 4 * core.std_error / math.sqrt(core.value)
    else:
        mean = scalars.get("shape_index.mean")
        error = mean.std_error if mean is not None else math.nan
    if not error > 0:
        error = 0.05 * float(np.sum(curve.x * weight) / max(weight.sum(), 1e-300))
    return curve.x, total / max(total[-1], 1e-300), error


def _wasserstein(first: Distribution, second: Distribution) -> float:
    grid = np.union1d(first[0], second[0])
    ours = np.interp(grid, first[0], first[1], left=0.0, right=1.0)
    theirs = np.interp(grid, second[0], second[1], left=0.0, right=1.0)
    gap = np.abs(ours - theirs)
    return float(np.sum(0.5 * (gap[1:] + gap[:-1]) * np.diff(grid)))
