"""The statistics of a study as tables of its page: conditions, tests between them, trends."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.compare.page import Row, Section, Table, format_value
from cellquant.compare.results import unit_text
from cellquant.errors import InputError
from cellquant.tables import Units, read_table

if TYPE_CHECKING:
    import pandas as pd

# Label, and exponents of length and time in the unit.
QUANTITIES: Mapping[str, tuple[str, tuple[int, int]]] = {
    "shape_index_mean": ("Mean shape index", (0, 0)),
    "shape_index_median": ("Median shape index", (0, 0)),
    "speed_mean": ("Mean speed", (1, -1)),
    "tau_alpha": ("Relaxation time τ_{α}", (0, 1)),
}


@dataclass(frozen=True)
class Study:
    """Statistics over the conditions of one study.

    Attributes
    ----------
    name
        Name of its folder.
    statistics
        The content of ``statistics.json``.
    trials
        condition, trial, quantity, value, censored: one row per trial and quantity.
    units
        Units of the values.
    """

    name: str
    statistics: Mapping[str, Any]
    trials: "pd.DataFrame"
    units: Units


def read_study(folder: str | Path) -> Study | None:
    """The statistics that `run` wrote into a study's folder; None where there are none."""
    place = Path(folder)
    statistics, trials = place / "statistics.json", place / "trial_values.parquet"
    if not (statistics.is_file() and trials.is_file()):
        return None
    table, units, *_ = read_table(trials)
    try:
        content = json.loads(statistics.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{statistics} is not readable ({error}); make it again with 'cellquant run'."
        ) from error
    return Study(place.resolve().name, content, table, units)


def statistics_section(study: Study, *, number: int = 1) -> Section:
    """Conditions compared over their trials, and relaxation times against density."""
    statistics = study.statistics
    tables = [_means(study.trials, study.units)]
    if statistics["mann_whitney"]:
        tables.append(_tests(statistics["mann_whitney"]))
    if statistics["mixed_model"]:
        models = statistics["mixed_model"]
        order = [c for c in dict.fromkeys(study.trials["condition"]) if c in models]
        order += [c for c in models if c not in order]
        tables.append(_trends({c: models[c] for c in order}, study.units))
    suffix = "" if number == 1 else f"-{number}"
    return Section(
        f"conditions{suffix}",
        "The conditions compared" + ("" if number == 1 else f": {study.name}"),
        text=(
            "One value per trial, the mean over its stacks; the trial is what is repeated, not the "
            "cell. A relaxation time that a trial does not reach stays out of its mean and enters "
            "the log-rank test at its bound.",
        ),
        tables=tuple(replace(table, name=f"{table.name}{suffix}") for table in tables),
    )


def _means(trials: "pd.DataFrame", units: Units) -> Table:
    conditions = list(dict.fromkeys(trials["condition"]))
    rows = []
    for name, (label, powers) in QUANTITIES.items():
        cells = []
        for condition in conditions:
            here = trials[(trials["condition"] == condition) & (trials["quantity"] == name)]
            known = here.loc[~here["censored"], "value"].dropna()
            error = float(known.std(ddof=1) / math.sqrt(len(known))) if len(known) > 1 else math.nan
            bounds = int(here["censored"].sum())
            text = format_value(float(known.mean()), error) if len(known) else "–"
            text += f" (n = {len(known)}"
            cells.append(text + (f"; {bounds} not reached)" if bounds else ")"))
        unit = unit_text(powers, units)
        rows.append(Row((f"{label} ({unit})" if unit else label, *cells)))
    return Table(
        name="condition-means",
        caption="Mean ± standard error over trials.",
        columns=("Quantity", *conditions),
        classes=("", *("number" for _ in conditions)),
        rows=tuple(rows),
        data=trials,
    )


def _tests(tests: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for test in tests:
        effect = test.get("superiority")
        rows.append(
            Row(
                (
                    QUANTITIES[test["quantity"]][0],
                    f"{test['first']}, {test['second']}",
                    test["test"],
                    f"{test['n_first']}, {test['n_second']}",
                    "–" if effect is None else f"{effect:.2f}",
                    _p_value(test["p_value"]),
                    _p_value(test["p_holm"]),
                    test["reason"] or "",
                ),
                "none" if test["p_value"] is None else "",
            )
        )
    return Table(
        name="tests",
        caption="Tests between conditions. Effect: chance that a trial of the first has the larger "
        "value than one of the second; one half means no difference. P (Holm) is corrected for the "
        "number of pairs.",
        columns=("Quantity", "Conditions", "Test", "Trials", "Effect", "P", "P (Holm)", "Note"),
        classes=("", "", "", "number", "number", "number", "number", "note"),
        rows=tuple(rows),
    )


def _trends(models: Mapping[str, Mapping[str, Any]], units: Units) -> Table:
    density = "1/mm^{2}" if units.length == "um" else unit_text((-2, 0), units)
    rows = []
    for condition, model in models.items():
        if model.get("slope") is None:
            reason = str(model.get("reason", "not measurable"))
            rows.append(Row((condition, reason, "", "", "", "", ""), "none"))
            continue
        low, high = model["interval_95"]
        notes = []
        if model["singular"]:
            notes.append("singular: the trials do not tell both random effects apart")
        notes += _bounds_note(model)
        rows.append(
            Row(
                (
                    condition,
                    format_value(model["slope"], model["std_error"]),
                    " to ".join(
                        format_value(end, model["std_error"]).partition(" ± ")[0]
                        for end in (low, high)
                    ),
                    f"{model['df']:.1f}",
                    _p_value(model["p_value"]),
                    f"{model['n']} in {model['n_groups']} trials",
                    "; ".join(notes),
                )
            )
        )
    return Table(
        name="trends",
        caption="Relaxation time against density: linear mixed model with random intercept and "
        f"slope per trial, restricted likelihood. Slope in {unit_text((0, 1), units)} per "
        f"{density}; degrees of freedom after Satterthwaite.",
        columns=(
            "Condition",
            "Slope",
            "95 % interval",
            "Degrees of freedom",
            "P",
            "Values",
            "Note",
        ),
        classes=("", "number", "number", "number", "number", "", "note"),
        rows=tuple(rows),
    )


def _bounds_note(model: Mapping[str, Any]) -> list[str]:
    """What became of relaxation times that are only known as bounds, and what else they allow."""
    number = model.get("n_censored", 0) + model.get("n_below", 0)
    if not number:
        return []
    others = [
        f"{words} the slope is {format_value(fit['slope'], fit['std_error'])}"
        for name, words in (("without_bounds", "without them"), ("at_bound", "with each at its "
                            "bound"))
        if (fit := model.get(name)) and fit["slope"] is not None
    ]  # fmt: skip
    if model.get("bounds_reason"):
        used = f"left out ({model['bounds_reason']})"
    else:
        used = "taken as such"
    times = "time is only known as a bound" if number == 1 else "times are only known as bounds"
    return ["; ".join(filter(None, (f"{number} {times}, {used}", ", ".join(others))))]


def _p_value(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.2g}" if value >= 1e-4 else "< 0.0001"
