"""The tables and the report of a whole study, from the finished folders of its stacks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.storage import atomic_path, write_json
from cellquant.tables import read_table, write_table

if TYPE_CHECKING:
    import pandas as pd

    from cellquant.compare.page import Section
    from cellquant.compare.results import Result

SCALARS = (
    "density.mean",
    "shape_index.mean",
    "shape_index.median",
    "wave_number.mean_diameter",
    "tau_alpha.value",
    "speed.mean",
)
MAX_CURVES = 6


def write_study(
    folder: Path, tasks: Sequence[Mapping[str, Any]], record: Mapping[str, Any]
) -> None:
    """Write a study's ``stacks.parquet``, ``shape_by_bin.parquet``, ``relaxation_times.parquet``,
    ``trial_values.parquet``, ``statistics.json`` and report.

    Parameters
    ----------
    folder
        The study's folder.
    tasks
        The stacks that are finished: condition, trial, name and folder of each.
    record
        How the study was made: the content of ``run.json``.
    """
    from cellquant.compare.results import read_result
    from cellquant.statistics import study_statistics

    results = [
        read_result(task["folder"], name=f"{task['condition']}, {task['trial']}, {task['name']}")
        for task in tasks
    ]
    units = results[0].units
    stacks = stack_table(tasks, results)
    with atomic_path(folder / "stacks.parquet") as path:
        write_table(stacks, path, units=units)
    with atomic_path(folder / "shape_by_bin.parquet") as path:
        write_table(shape_by_bin(tasks, results), path, units=units)
    times = relaxation_times(tasks)
    if times is None:  # nor may those of another configuration stay
        for name in ("relaxation_times.parquet", "trial_values.parquet", "statistics.json"):
            (folder / name).unlink(missing_ok=True)
    else:
        with atomic_path(folder / "relaxation_times.parquet") as path:
            write_table(times, path, units=units)
        trials = trial_values(stacks)
        with atomic_path(folder / "trial_values.parquet") as path:
            write_table(trials, path, units=units)
        write_json(folder / "statistics.json", study_statistics(times, trials))
    _write_report(folder / "report.html", tasks, results, record)


def stack_table(tasks: Sequence[Mapping[str, Any]], results: "Sequence[Result]") -> "pd.DataFrame":
    """One row per stack: condition, trial, stack, and every scalar with its standard error."""
    import pandas as pd

    from cellquant.compare.results import look_up

    rows = []
    for task, result in zip(tasks, results, strict=True):
        row: dict[str, Any] = {
            "condition": task["condition"],
            "trial": task["trial"],
            "stack": task["name"],
            "n_frames": result.summary.get("n_frames"),
            "n_tracks": result.summary.get("n_tracks"),
        }
        for key in SCALARS:
            group, part = key.split(".")
            name = group if part == "value" else key.replace(".", "_")
            row[name] = look_up(result.summary, key)
            error = "std_error" if part in {"mean", "value"} else f"{part}_std_error"
            row[f"{name}_std_error"] = look_up(result.summary, f"{group}.{error}")
        row["tau_alpha_censored_at"] = look_up(result.summary, "tau_alpha.censored_at")
        rows.append(row)
    table = pd.DataFrame(rows)
    numbers = [name for name in table.columns if name not in {"condition", "trial", "stack"}]
    return table.astype(dict.fromkeys(numbers, "float64")).astype({"n_frames": "int64"})


def shape_by_bin(tasks: Sequence[Mapping[str, Any]], results: "Sequence[Result]") -> "pd.DataFrame":
    """Shape index of each stack in each density bin that its windows fall into.

    Returns
    -------
    pandas.DataFrame
        condition, trial, stack, bin_centre, density, mean, median, mode, std and skewness with
        their standard errors, n, n_windows.
    """
    import pandas as pd

    values = ("mean", "median", "mode", "std", "skewness")
    errors = ("std_error", *(f"{name}_std_error" for name in values[1:]))
    numbers = ["bin_centre", "density", *values, *errors]
    rows = [
        {
            "condition": task["condition"],
            "trial": task["trial"],
            "stack": task["name"],
            **{name: entry.get(name) for name in (*numbers, "n", "n_windows")},
        }
        for task, result in zip(tasks, results, strict=True)
        for entry in (result.summary.get("shape_index") or {}).get("by_bin", [])
    ]
    columns = ["condition", "trial", "stack", *numbers, "n", "n_windows"]
    kinds = {**dict.fromkeys(columns[:3], "str"), **dict.fromkeys(numbers, "float64")}
    kinds |= dict.fromkeys(("n", "n_windows"), "int64")
    return pd.DataFrame(rows, columns=columns).astype(kinds)


def relaxation_times(tasks: Sequence[Mapping[str, Any]]) -> "pd.DataFrame | None":
    """tau_alpha of each trial and density bin: the mean over the trial's stacks.

    Each stack counts by its number of analysis windows. A bin is censored when any of its stacks
    is: then tau_alpha is NaN and ``censored_at`` is the smallest bound.

    Returns
    -------
    pandas.DataFrame or None
        condition, trial, bin_centre, density, tau_alpha, std_error, censored, censored_at,
        n_stacks, n_windows; None when no stack has the table.
    """
    import numpy as np
    import pandas as pd

    parts = []
    for task in tasks:
        path = Path(task["folder"]) / "relaxation_times.parquet"
        if path.is_file():
            table = read_table(path)[0]
            parts.append(table.assign(condition=task["condition"], trial=task["trial"]))
    if not parts:
        return None
    every = pd.concat(parts, ignore_index=True)
    rows = []
    keys = ["condition", "trial", "bin_centre"]
    for (condition, trial, centre), group in every.groupby(keys, sort=False, dropna=False):
        weight = group["n_windows"].to_numpy(np.float64)
        share = weight / weight.sum()
        censored = bool(group["censored"].any())
        mean = float((share * group["tau_alpha"].to_numpy(np.float64)).sum())
        variance = float(((share * group["std_error"].to_numpy(np.float64)) ** 2).sum())
        rows.append(
            {
                "condition": condition,
                "trial": trial,
                "bin_centre": centre,
                "density": float((share * group["density"].to_numpy(np.float64)).sum()),
                "tau_alpha": np.nan if censored else mean,
                "std_error": np.nan if censored else float(np.sqrt(variance)),
                "censored": censored,
                "censored_at": float(group["censored_at"].min()),
                "below": float(group["below"].max()),
                "n_stacks": len(group),
                "n_windows": int(weight.sum()),
            }
        )
    kinds = {
        "condition": "str",
        "trial": "str",
        **dict.fromkeys(("bin_centre", "density", "tau_alpha", "std_error"), "float64"),
        "censored": "bool",
        **dict.fromkeys(("censored_at", "below"), "float64"),
        **dict.fromkeys(("n_stacks", "n_windows"), "int64"),
    }
    return pd.DataFrame(rows, columns=list(kinds)).astype(kinds)


def trial_values(stacks: "pd.DataFrame") -> "pd.DataFrame":
    """One row per trial and quantity, the mean over the trial's stacks, for tests of conditions.

    A relaxation time that one of the stacks knows only as a bound is a bound for the trial.

    Returns
    -------
    pandas.DataFrame
        condition, trial, quantity, value, censored.
    """
    import pandas as pd

    parts = []
    for name in ("shape_index_mean", "shape_index_median", "speed_mean", "tau_alpha"):
        bound = stacks["tau_alpha_censored_at"] if name == "tau_alpha" else stacks[name]
        chosen = stacks.assign(
            quantity=name,
            censored=stacks[name].isna() & bound.notna(),
            value=stacks[name].fillna(bound),
        )
        grouped = chosen.groupby(["condition", "trial", "quantity"], sort=False)
        parts.append(grouped.agg({"value": "mean", "censored": "any"}).reset_index())
    return pd.concat(parts, ignore_index=True)


def _write_report(
    path: Path,
    tasks: Sequence[Mapping[str, Any]],
    results: "Sequence[Result]",
    record: Mapping[str, Any],
) -> None:
    from cellquant.compare.page import Page, Row, Section, Table, write_page
    from cellquant.compare.report import methods_section, scalar_text, warnings_section
    from cellquant.compare.results import read_scalars
    from cellquant.compare.study_tables import read_study, statistics_section

    study = read_study(path.parent)
    compared = () if study is None else (statistics_section(study),)
    scalars = [{scalar.key: scalar for scalar in read_scalars(result)} for result in results]
    shown = [key for key in SCALARS if any(key in found for found in scalars)]
    first = {key: next(found[key] for found in scalars if key in found) for key in shown}
    rows = tuple(
        Row(
            (
                task["condition"],
                task["trial"],
                task["name"],
                *(scalar_text(found[key]) if key in found else "not measurable" for key in shown),
            )
        )
        for task, found in zip(tasks, scalars, strict=True)
    )
    columns = tuple(
        f"{first[key].label} ({first[key].unit})" if first[key].unit else first[key].label
        for key in shown
    )
    table = Table(
        name="stacks",
        caption="Value ± standard error within the recording. The unit of replication is the "
        "trial: compare conditions by the spread between their trials.",
        columns=("Condition", "Trial", "Stack", *columns),
        classes=("", "", "", *("number" for _ in shown)),
        rows=rows,
        data=stack_table(tasks, results),
    )
    names = list(dict.fromkeys(str(task["condition"]) for task in tasks))
    trials = len({(task["condition"], task["trial"]) for task in tasks})
    write_page(
        Page(
            title="Study",
            lede=f"{_count(len(names), 'condition')}, {_count(trials, 'independent trial')} and "
            f"{_count(len(tasks), 'stack')}. Each stack has a report of its own beside its tables.",
            sections=(
                *compared,
                Section("results", "Results by stack", tables=(table,)),
                *_curves(path.parent, names, results),
                warnings_section({}, record, {}, []),
                methods_section([("", record)]),
            ),
        ),
        path,
    )


def _curves(
    folder: Path, conditions: Sequence[str], results: "Sequence[Result]"
) -> "tuple[Section, ...]":
    """The conditions side by side; the stacks themselves where there is one condition."""
    if len(conditions) > 1:
        from cellquant.compare import compare
        from cellquant.compare.comparison_page import build_comparison

        page = build_comparison(compare(*(folder / "stacks" / name for name in conditions)))
        return page.sections[:-1]
    from cellquant.compare import panels
    from cellquant.compare.page import Section

    drawn = results[:MAX_CURVES]
    figures = (
        panels.shape_figure(drawn),
        panels.scattering_figure(drawn),
        panels.msd_figure(drawn),
    )
    rest = len(results) - len(drawn)
    note = (f"The curves of the first {MAX_CURVES} stacks are drawn.",) if rest > 0 else ()
    shown = tuple(figure for figure in figures if figure is not None)
    return (Section("curves", "Shape, memory and motion", text=note, figures=shown),)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
