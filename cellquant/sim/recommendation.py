"""What a work-precision diagram says: two ratios to the published scheme, and a sentence."""

import math
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Floats = NDArray[np.float64]

PUBLISHED_DT = 0.005
AVERAGES = {
    "shape_index": "<p>",
    "msd": "the mean-square displacement",
    "scattering": "F_s",
    "tau_alpha": "tau_alpha",
}


def recommend(
    table: pd.DataFrame, weak: pd.DataFrame, integrator: str, points: int
) -> dict[str, Any]:
    """Compare every method with the published scheme: Euler steps of 0.005 on the contour sum.

    Each curve of error against CPU time is interpolated in logarithms, seed by seed; ratios are
    medians over the seeds with their smallest and largest value. A ratio is None where the curve
    does not reach so far.

    Parameters
    ----------
    table, weak
        Of a `Convergence`.
    integrator
        The recommended method.
    points
        Contour points of the published scheme.
    """
    methods = {}
    published = []
    for seed, group in table.dropna(subset=["error", "cpu_seconds"]).groupby("seed"):
        own = group[(group["contact"] == "quadrature") & (group["points"] == points)]
        if own.empty:
            continue
        cpu = _interpolate(own["dt"], own["cpu_seconds"], PUBLISHED_DT, slope=-1.0)
        error = _interpolate(own["dt"], own["error"], PUBLISHED_DT, slope=0.0)
        published.append((seed, cpu, error))
    names = list(dict.fromkeys(table.loc[table["contact"] == "exact", "integrator"]))
    for name in names:
        rows = []
        for seed, cpu, error in published:
            curve = table[
                (table["contact"] == "exact")
                & (table["integrator"] == name)
                & (table["seed"] == seed)
            ].dropna(subset=["error", "cpu_seconds"])
            rows.append(_against(curve, cpu, error))
        methods[name] = {key: _spread([row[key] for row in rows]) for key in (rows or [{}])[0]}
    found: dict[str, Any] = {
        "integrator": integrator,
        "contact": "exact",
        "published_cpu_seconds": _spread([cpu for _, cpu, _ in published]),
        "published_error": _spread([error for _, _, error in published]),
        "methods": methods,
        **methods.get(integrator, {}),
    }
    found["weak"] = _weakest(weak, integrator)
    found["text"] = _in_words(found)
    return found


def _interpolate(dt: Any, values: Any, at: float, *, slope: float) -> float:
    """Value at a step between two measured ones; beyond them it goes on with the slope."""
    order = np.argsort(dt.to_numpy())
    x, y = np.log(dt.to_numpy()[order]), np.log(values.to_numpy()[order])
    inside = min(max(math.log(at), x[0]), x[-1])
    return float(np.exp(np.interp(inside, x, y) + slope * (math.log(at) - inside)))


def _against(curve: pd.DataFrame, cpu: float, error: float) -> dict[str, float]:
    """Share of the time at the same error, of the error at the same time, and the steps there."""
    curve = curve.sort_values("dt", ascending=False)
    step, spent, wrong = (np.log(curve[k].to_numpy()) for k in ("dt", "cpu_seconds", "error"))
    out = dict.fromkeys(
        ("cpu_ratio", "dt_at_published_error", "error_ratio", "dt_at_published_time"), math.nan
    )
    good = np.flatnonzero(wrong <= math.log(error))
    if len(good):
        k = int(good[0])
        share = 0.0 if k == 0 else (math.log(error) - wrong[k]) / (wrong[k - 1] - wrong[k])
        here = [k, k - 1] if k else [k, k]
        out["cpu_ratio"] = math.exp(_mix(spent[here], share)) / cpu
        out["dt_at_published_error"] = math.exp(_mix(step[here], share))
    affordable = np.flatnonzero(spent <= math.log(cpu))
    if len(affordable):
        k = int(affordable[-1])
        here, share = [k, k], 0.0
        if k + 1 < len(spent) and spent[k + 1] > spent[k]:
            here, share = [k, k + 1], (math.log(cpu) - spent[k]) / (spent[k + 1] - spent[k])
        out["error_ratio"] = math.exp(_mix(wrong[here], share)) / error
        out["dt_at_published_time"] = math.exp(_mix(step[here], share))
    return out


def _mix(pair: Floats, share: float) -> float:
    return float((1.0 - share) * pair[0] + share * pair[1])


def _spread(values: list[float]) -> dict[str, float] | None:
    known = [value for value in values if math.isfinite(value)]
    if not known or len(known) < len(values):
        return None
    return {"median": float(np.median(known)), "least": min(known), "most": max(known)}


def _weakest(weak: pd.DataFrame, integrator: str) -> dict[str, Any]:
    """Longest measured step up to which no average differs from the finest method.

    The runs share their paths, so that the difference is judged by its own standard error, which is
    smaller than the sampling error.
    """
    if weak.empty:
        return {}
    own = weak[(weak["contact"] == "exact") & (weak["integrator"] == integrator)]
    measured = own.dropna(subset=["difference", "difference_std_error"])
    within = measured["difference"].abs() <= 2.0 * measured["difference_std_error"]
    good = within.groupby(measured["dt"]).all()  # in the order of the steps
    good = good[good.cummin()]
    return {
        "dt": float(good.index.max()) if len(good) else None,
        "observables": sorted(set(measured["observable"])),
    }


def _in_words(found: dict[str, Any]) -> str:
    name = found["integrator"]
    error, cpu = found["published_error"], found["published_cpu_seconds"]
    if error is None or cpu is None:
        return f"Take {name} with exact contacts; the published scheme fails on this scene."
    words = [f"Take {name} with exact contacts."]
    ratio, dt = found.get("cpu_ratio"), found.get("dt_at_published_error")
    if ratio and dt:
        words.append(
            f"With dt {dt['median']:.2g} it has the error of the published scheme "
            f"({error['median']:.2g} L0) in {_range(ratio)} of its CPU time "
            f"({cpu['median']:.2g} s)."
        )
    else:
        words.append(
            f"None of its steps was found to have the error of the published scheme "
            f"({error['median']:.2g} L0)."
        )
    ratio, dt = found.get("error_ratio"), found.get("dt_at_published_time")
    if ratio and dt:
        words.append(
            f"At the same CPU time (dt {dt['median']:.2g}) it has {_range(ratio)} of that error."
        )
    else:
        words.append("It has no step as quick as the published scheme among those measured.")
    weak = found["weak"]
    if weak.get("observables"):
        averages = ", ".join(AVERAGES[name] for name in AVERAGES if name in weak["observables"])
        words.append(
            f"Averages ({averages}) do not differ from the finest method, "
            f"within twice the standard error of the difference on the same paths, up to "
            f"dt {weak['dt']:.2g}."
            if weak["dt"] is not None
            else f"Averages ({averages}) differ from the finest method at every step measured."
        )
    return " ".join(words)


def _range(ratio: dict[str, float]) -> str:
    return f"{ratio['median']:.2g} ({ratio['least']:.2g} to {ratio['most']:.2g})"
