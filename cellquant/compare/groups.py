"""Results that stand for the same thing, e.g. the trials of a condition or the seeds of a scene.

The unit of replication is the trial or the seed: with several, a value is their mean and its
error comes from their spread; with one, the error is the one estimated inside it.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cellquant.compare.figures import Curve
from cellquant.compare.results import (
    Result,
    Scalar,
    curve_of,
    read_result,
    read_scalars,
)
from cellquant.compare.sources import run_of
from cellquant.errors import InputError
from cellquant.storage import FINISHED

FloatArray = np.ndarray[Any, np.dtype[np.float64]]
SCENE_KEYS = ("phi", "v0", "eta")


@dataclass(frozen=True)
class Group:
    """One condition or one scene.

    Attributes
    ----------
    name
        How it is called on the page.
    simulated
        Whether it comes from the model, in reduced units.
    trials
        The results of each trial or seed, by its name.
    scene
        phi, v0, eta of a simulated group, as far as they are known.
    """

    name: str
    simulated: bool
    trials: Mapping[str, tuple[Result, ...]]
    scene: Mapping[str, float]

    @property
    def members(self) -> tuple[Result, ...]:
        """All results, in the order of the trials."""
        return tuple(result for results in self.trials.values() for result in results)

    @property
    def n(self) -> int:
        """Number of independent trials or seeds."""
        return len(self.trials)

    def scalars(self) -> dict[str, Scalar]:
        """Every scalar by key: mean over trials, with the standard error over trials."""
        return dict(self._scalars)

    @cached_property
    def _scalars(self) -> dict[str, Scalar]:
        per_trial = [
            _pool([{s.key: s for s in read_scalars(result)} for result in results], "recordings")
            for results in self.trials.values()
        ]
        return _pool(per_trial, "seeds" if self.simulated else "trials")

    def curve(self, table: str, *, x: str = "lag_time", series: int = 0) -> Curve | None:
        """Mean curve over trials, on the points of the first; band from their spread."""
        found = []
        for results in self.trials.values():
            curves = [curve_of(result, table, x=x, series=series) for result in results]
            joined = _mean_curve([c for c in curves if c is not None])
            if joined is not None:
                found.append(joined)
        mean = _mean_curve(found)
        return None if mean is None else replace(mean, label=self.name)


def read_groups(sources: Sequence[Any], *, names: Sequence[str] | None = None) -> list[Group]:
    """Gather results into groups.

    Parameters
    ----------
    sources
        Observables in memory, results, folders that `observe` wrote, or folders of a whole
        experiment or sweep, whose results are found below them and grouped by condition or scene.
    names
        A name for each source; their own when None.

    Returns
    -------
    list of Group
        Experiments first, each side in the order given.

    Raises
    ------
    InputError
        If a folder holds no results, or fewer or more names than sources are given.
    """
    if names is not None and len(names) != len(sources):
        raise InputError(f"{len(names)} names are given for {len(sources)} results; give as many.")
    groups: list[Group] = []
    for index, source in enumerate(sources):
        name = "" if names is None else names[index]
        groups += _groups_of(source, name)
    groups = [*(g for g in groups if not g.simulated), *(g for g in groups if g.simulated)]
    seen: dict[str, int] = {}
    unique: list[Group] = []
    for group in groups:
        seen[group.name] = seen.get(group.name, 0) + 1
        again = seen[group.name]
        folder = group.members[0].folder
        label = str(again) if folder is None or group.n > 1 else folder.resolve().name
        name = group.name if again == 1 else f"{group.name} ({label})"
        while any(other.name == name for other in unique):
            name = f"{group.name} ({label}, {again})"
            again += 1
        unique.append(replace(group, name=name))
    return unique


def _groups_of(source: Any, name: str) -> list[Group]:
    if not isinstance(source, str | Path) or (Path(source) / "summary.json").is_file():
        result = read_result(source, name=name)
        scene = scene_of(result)
        named = bool(name) or isinstance(source, Result)
        label = result.name if named or not scene else _scene_name(scene)
        return [Group(label, result.simulated, {"1": (result,)}, scene)]
    folder = Path(source)
    paths = _finished(folder)
    if not paths:
        raise InputError(
            f"{folder} holds no summary.json, nor does any folder below it; give a folder that "
            "'cellquant observe', 'run' or 'sweep' has written."
        )
    found: dict[str, dict[str, list[Result]]] = {group: {} for group in _conditions(folder)}
    labels: dict[str, tuple[str, Mapping[str, float]]] = {}
    for path in paths:
        result = read_result(path)
        scene = scene_of(result)
        group, trial = _place(result, path.relative_to(folder), scene)
        # Scenes that differ in anything but the seed are not replicates of each other.
        key = group if not scene else json.dumps(_without_seed(result.record), sort_keys=True)
        found.setdefault(key, {}).setdefault(trial, []).append(result)
        labels[key] = (f"{name}: {group}" if name and group else name or group, scene)
    groups = [
        Group(
            labels[key][0],
            next(iter(members.values()))[0].simulated,
            {trial: tuple(results) for trial, results in members.items()},
            labels[key][1],
        )
        for key, members in found.items()
        if members
    ]
    return sorted(groups, key=lambda group: tuple(group.scene.values()))


def _finished(folder: Path) -> list[Path]:
    """Folders of results below a folder: those that a study or sweep lists as its own, else all."""
    found = sorted(path.parent for path in folder.rglob("summary.json"))
    try:
        listed = json.loads((folder / FINISHED).read_text("utf-8"))
        own = {folder / str(name) for name in listed}
    except (OSError, ValueError, TypeError):
        return found
    return [path for path in found if path in own]


def _without_seed(record: Mapping[str, Any]) -> dict[str, Any]:
    settings = record.get("settings", {})
    return {k: v for k, v in settings.items() if k not in {"seed", "key", "folder", "source"}}


def _conditions(folder: Path) -> list[str]:
    """Conditions of an experiment in the order of its file; none where there is no record."""
    try:
        record = json.loads((folder / "run.json").read_text("utf-8"))
        return [str(condition["name"]) for condition in record["settings"]["condition"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _place(result: Result, path: Path, scene: Mapping[str, float]) -> tuple[str, str]:
    """Group and trial of a result below the folder of an experiment or sweep."""
    settings = result.record.get("settings", {})
    if "condition" in settings and "trial" in settings:
        return str(settings["condition"]), str(settings["trial"])
    seed = _find(result.record, "seed")
    if scene:
        return _scene_name(scene), str(seed if seed is not None else path)
    return (path.parts[0] if len(path.parts) > 1 else "all"), str(path)


def _scene_name(scene: Mapping[str, float]) -> str:
    symbols = {"phi": "φ", "v0": "v₀", "eta": "η"}
    return ", ".join(f"{symbols[key]} = {value:g}" for key, value in scene.items())


def scene_of(result: Result) -> dict[str, float]:
    """phi, v0 and eta of a simulated result, as far as its record or its run tells."""
    if not result.simulated:
        return {}
    found: dict[str, float] = {}
    run = (
        None if all(_find(result.record, key) is not None for key in SCENE_KEYS) else run_of(result)
    )
    for key in SCENE_KEYS:
        value = _find(result.record, key)
        if value is None and run is not None:
            value = getattr(run.scene, key, None)
        if value is None and result.tracks is not None:
            value = _find(result.tracks.provenance, key)
        if isinstance(value, int | float):
            found[key] = float(value)
    return found


def _find(record: Any, key: str) -> Any:
    """First value under a key, however deep; None where there is none."""
    if isinstance(record, Mapping):
        if key in record:
            return record[key]
        inner: Any = record.values()
    elif isinstance(record, list | tuple):
        inner = record
    else:
        return None
    for part in inner:
        value = _find(part, key)
        if value is not None:
            return value
    return None


def _pool(parts: Sequence[Mapping[str, Scalar]], noun: str) -> dict[str, Scalar]:
    if len(parts) == 1:
        return dict(parts[0])
    pooled = {}
    for key in dict.fromkeys(key for part in parts for key in part):
        found = [part[key] for part in parts if key in part]
        if len(found) == 1:
            pooled[key] = found[0]
            continue
        values = np.array([s.value for s in found])
        known = np.isfinite(values)
        sample = f"{len(found)} {noun}"
        rule = f"mean over {noun}; error: their standard error"
        if known.all():
            error = float(values.std(ddof=1) / math.sqrt(len(values)))
            pooled[key] = replace(
                found[0], value=float(values.mean()), std_error=error, n=sample, rule=rule
            )
            continue
        # A mean over those that relaxed alone would be too short. With the bounds in the place of
        # the values that are not known it is a bound of the mean over all.
        bounds = [s.value if math.isfinite(s.value) else s.censored_at for s in found]
        pooled[key] = replace(
            found[0],
            value=math.nan,
            std_error=math.nan,
            censored_at=float(np.mean(bounds)),
            n=f"{sample}, {int((~known).sum())} not reached",
            rule=f"mean over {noun}, with the bound in the place of a value that is not reached",
        )
    return pooled


def _mean_curve(curves: Sequence[Curve]) -> Curve | None:
    if not curves:
        return None
    if len(curves) == 1:
        return curves[0]
    first = curves[0]
    ys = np.array([_resample(first.x, curve) for curve in curves])
    known = np.isfinite(ys)
    n = known.sum(axis=0)
    filled = np.where(known, ys, 0.0)
    mean = np.where(n > 0, filled.sum(axis=0) / np.maximum(n, 1), np.nan)
    squares = np.where(known, (ys - mean) ** 2, 0.0).sum(axis=0)
    error = np.where(n > 1, np.sqrt(squares / np.maximum(n - 1, 1) / np.maximum(n, 1)), np.nan)
    return replace(first, y=mean, error=error)


def _resample(x: FloatArray, curve: Curve) -> FloatArray:
    """Linear interpolation at x; NaN outside, and next to points that are not known."""
    if curve.x.size == x.size and (curve.x == x).all():
        return curve.y
    out: FloatArray = np.interp(x, curve.x, curve.y, left=np.nan, right=np.nan)
    return out
