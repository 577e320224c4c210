"""Repeat a recorded run and say what differs: in what goes in, and in what comes out."""

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cellquant.config import (
    ExperimentConfig,
    RunObservablesConfig,
    SceneConfig,
    SweepConfig,
    validate,
)
from cellquant.errors import InputError
from cellquant.fingerprint import code_digest
from cellquant.storage import FINISHED, MANIFEST, check_output, digest, libraries

Progress = Callable[[int, int], None]
_LINKING = ("max_distance", "divisions", "linker", "max_gap")
_TABLES = ("*.parquet", "summary.json", "statistics.json")
_ARRAYS = ("time", "position", "polarity", "modes", "radius", "box")


@dataclass(frozen=True)
class Repetition:
    """What came of repeating a run.

    Attributes
    ----------
    commands
        The commands that were repeated.
    changes
        What was not as it was then: inputs, program, libraries.
    compared
        Number of tables, summaries and arrays that were compared.
    differences
        One sentence for each that differs; a table that only one of the two has counts too.
    """

    commands: tuple[str, ...]
    changes: tuple[str, ...]
    compared: int
    differences: tuple[str, ...]

    @property
    def equal(self) -> bool:
        """Whether every result is the same, value for value."""
        return not self.differences

    def as_lines(self) -> list[str]:
        """In words."""
        count = len(self.differences)
        verdict = f"{self.compared} results compared: " + (
            "all equal" if self.equal else f"{count} difference{'s' if count > 1 else ''}"
        )
        return [
            f"repeated: {', '.join(self.commands)}",
            *(f"changed since: {text}" for text in self.changes),
            *(f"differs: {text}" for text in self.differences),
            verdict,
        ]

    def as_dict(self) -> dict[str, Any]:
        """For programs; JSON-serialisable."""
        return {
            "commands": list(self.commands),
            "changes": list(self.changes),
            "compared": self.compared,
            "differences": list(self.differences),
            "equal": self.equal,
        }


def repeat(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    workers: int = 1,
    progress: Progress | None = None,
) -> Repetition:
    """Do again what an output folder records, elsewhere, and compare every result.

    Parameters
    ----------
    folder
        Output folder of `track`, `observe`, `run` (or one of its stacks) or `sweep` (or one of
        its runs), or a simulated run.
    out
        Where to keep the repetition; a temporary folder when None.
    workers
        Local worker processes, for a study or a sweep.
    progress
        Called with (tasks done, tasks in all).

    Raises
    ------
    InputError
        If the folder records nothing that can be repeated, is not finished, or an input is gone.
    """
    folder = Path(folder)
    if out is None:
        with tempfile.TemporaryDirectory(prefix="cellquant-rerun-") as name:
            return repeat(folder, Path(name) / "again", workers=workers, progress=progress)
    out = check_output(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty; give a new folder for the repetition.")
    if (folder / "zarr.json").is_file():
        return _repeat_simulation(folder, out, progress)
    records = _records(folder)
    changes = [text for record in records for text in _changes(record)]
    for number, record in enumerate(records):
        _REPEATED[record["command"]](record, out, workers, progress)
        if progress is not None:
            progress(number + 1, len(records))
    compared, differences = _compare_folders(folder, out)
    commands = tuple(str(record["command"]) for record in records)
    return Repetition(commands, tuple(dict.fromkeys(changes)), compared, tuple(differences))


def _records(folder: Path) -> list[dict[str, Any]]:
    path = folder / MANIFEST
    try:
        last = json.loads(path.read_text(encoding="utf-8"))
        records = [*last.get("earlier", []), last]
        commands = [record["command"] for record in records]
        settings = [record["settings"].keys() for record in records]
    except FileNotFoundError as error:
        raise InputError(
            f"{path} does not exist; give the folder of a finished run, or a RUN.zarr."
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is no record of a run ({error}); give another folder.") from error
    if commands[-1] in {"run", "sweep"}:  # it did the earlier ones itself
        records, commands = records[-1:], commands[-1:]
    unknown = [name for name in commands if name not in _REPEATED]
    if unknown or not settings:
        raise InputError(
            f"{path} records '{unknown[0]}', which is not repeated; give a folder of "
            f"{', '.join(_REPEATED)}, or a RUN.zarr."
        )
    return records


def _changes(record: Mapping[str, Any]) -> list[str]:
    changes = []
    for name, then in sorted(record.get("inputs", {}).items()):
        path = _found(name, record)
        now = digest(path)
        if now != then:
            changes.append(f"the input {path} (SHA-256 {then[:12]}, now {now[:12]})")
    code = record.get("code")
    if code is not None and code != code_digest("pipeline"):
        changes.append(f"the program (code {code[:12]}, now {code_digest('pipeline')[:12]})")
    for name, version in sorted(record.get("libraries", {}).items()):
        now = libraries().get(name, "not installed")
        if now != version:
            changes.append(f"{name} ({version}, now {now})")
    return changes


def _found(name: str, record: Mapping[str, Any]) -> Path:
    """An input by the name under which it was given, also from another working folder."""
    for path in (Path(name), Path(str(record.get("working_folder", "")), name)):
        if path.exists():
            return path
    raise InputError(f"the input {name} is gone; put it back to repeat the run.")


def _track(record: Mapping[str, Any], out: Path, workers: int, progress: Progress | None) -> None:
    from cellquant.io import read_images, read_labels
    from cellquant.pipeline import track_movie

    settings = record["settings"]
    raw = settings["raw"]
    masks = next(name for name in sorted(record["inputs"]) if name != raw)
    pixel = settings["length_unit"] == "px"
    stack = read_labels(
        _found(masks, record),
        pixel_size=None if pixel else settings["pixel_size"],
        frame_interval=None if pixel else settings["frame_interval"],
        units="pixel" if pixel else None,
    )
    track_movie(
        stack,
        out,
        raw=None if raw is None else read_images(_found(raw, record)),
        options={name: settings[name] for name in _LINKING if name in settings},
    )


def _observe(record: Mapping[str, Any], out: Path, workers: int, progress: Progress | None) -> None:
    from cellquant.pipeline import observe_source

    settings = dict(record["settings"])
    source = _found(settings.pop("source"), record)
    only = settings.pop("only")
    calibration = settings.pop("calibration", None)
    observe_source(source, out, only=only, options=settings, calibration=calibration)


def _run(record: Mapping[str, Any], out: Path, workers: int, progress: Progress | None) -> None:
    from cellquant.batch import run_config, work_on_stack

    settings = dict(record["settings"])
    if "masks" in settings:  # one stack of a study
        work_on_stack({**settings, "code": code_digest("batch"), "folder": str(out)})
        return
    base = Path(settings.pop("base"))
    config = validate(settings, ExperimentConfig, where="the record")
    run_config(config, base, out, workers=workers, progress=progress)


def _sweep(record: Mapping[str, Any], out: Path, workers: int, progress: Progress | None) -> None:
    from cellquant.sweep import sweep_config, work_on_scene

    settings = record["settings"]
    if "scene" in settings:
        config = validate(dict(settings), SweepConfig, where="the record")
        sweep_config(config, out, workers=workers, progress=progress)
        return
    task = {
        "scene": {k: v for k, v in settings.items() if k in SceneConfig.model_fields},
        "observables": {
            k: v for k, v in settings.items() if k in RunObservablesConfig.model_fields
        },
        "code": code_digest("sweep"),
        "run_key": "again",
        "key": "again",
        "folder": str(out),
    }
    work_on_scene(task)


_REPEATED: dict[str, Callable[[Mapping[str, Any], Path, int, Progress | None], None]] = {
    "track": _track,
    "observe": _observe,
    "run": _run,
    "sweep": _sweep,
}


def _repeat_simulation(folder: Path, out: Path, progress: Progress | None) -> Repetition:
    from cellquant import __version__
    from cellquant.sim import open_run, simulate

    before = open_run(folder)
    if before.status != "complete":
        raise InputError(f"{folder} is not finished ({before.status}); finish it before.")
    settings = before.settings
    names = ("contact", "integrator", "dt", "tolerance", "save_every", "transient", "duration")
    options = {name: settings[name] for name in names}
    if settings["points"] is not None:
        options["points"] = settings["points"]
    after = simulate(before.scene, output=out, progress=progress, **options)
    changes = []
    if settings["version"] != __version__:
        changes.append(f"the program (version {settings['version']}, now {__version__})")
    differences = [
        f"{name}: {text}"
        for name in _ARRAYS
        for text in [_compare_arrays(getattr(before, name), getattr(after, name))]
        if text
    ]
    return Repetition(("simulate",), tuple(changes), len(_ARRAYS), tuple(differences))


def _compare_folders(before: Path, after: Path) -> tuple[int, list[str]]:
    """Number of results compared, and a sentence for each that differs."""
    names = sorted(_results(before) | _results(after))
    differences = []
    for name in names:
        one, two = before / name, after / name
        if not one.is_file() or not two.is_file():
            differences.append(f"{name} is only in {before if one.is_file() else after}")
        elif one.read_bytes() != two.read_bytes():
            compare = _compare_tables if one.suffix == ".parquet" else _compare_json
            text = compare(one, two)
            if text:
                differences.append(f"{name}: {text}")
    return len(names), differences


def _results(folder: Path) -> set[str]:
    """Names of the results in a folder; of a study or sweep only those that belong to it."""
    folders = [folder]
    if (folder / FINISHED).is_file():
        folders += [folder / name for name in json.loads((folder / FINISHED).read_text("utf-8"))]
    found = [path for place in folders for kind in _TABLES for path in place.glob(kind)]
    return {path.relative_to(folder).as_posix() for path in found}


def _compare_tables(before: Path, after: Path) -> str:
    """What differs between two parquet tables; empty where every value is the same."""
    from cellquant.tables import read_table

    (one, units_one, more_one), (two, units_two, more_two) = read_table(before), read_table(after)
    if units_one != units_two:
        return f"the units are {units_two}, not {units_one}"
    if list(one.columns) != list(two.columns):
        return f"the columns are {list(two.columns)}, not {list(one.columns)}"
    if len(one) != len(two):
        return f"{len(two)} rows instead of {len(one)}"
    texts = [
        f"column {name} ({text})"
        for name in one.columns
        for text in [_compare_arrays(one[name].to_numpy(), two[name].to_numpy())]
        if text
    ]
    if not texts and more_one != more_two:
        texts = [f"metadata: {_compare_values(more_one, more_two)}"]
    return ", ".join(texts)


def _compare_json(before: Path, after: Path) -> str:
    one, two = (json.loads(path.read_text(encoding="utf-8")) for path in (before, after))
    return _compare_values(one, two)


def _compare_values(one: Any, two: Any, where: str = "") -> str:
    """First place at which two JSON values differ; empty where they are the same."""
    if isinstance(one, dict) and isinstance(two, dict) and one.keys() == two.keys():
        pairs: Sequence[tuple[str, Any, Any]] = [(key, one[key], two[key]) for key in sorted(one)]
    elif isinstance(one, list) and isinstance(two, list) and len(one) == len(two):
        pairs = [(str(place), *both) for place, both in enumerate(zip(one, two, strict=True))]
    else:
        return "" if one == two else f"{where or 'the value'} is {two!r:.60}, not {one!r:.60}"
    for key, left, right in pairs:
        text = _compare_values(left, right, f"{where}.{key}" if where else key)
        if text:
            return text
    return ""


def _compare_arrays(one: Any, two: Any) -> str:
    """How far two arrays are apart; empty where they are the same, NaN equal to NaN."""
    import numpy as np

    one, two = np.asarray(one), np.asarray(two)
    if one.shape != two.shape:
        return f"shape {two.shape} instead of {one.shape}"
    if one.dtype.kind not in "fiub" or two.dtype.kind not in "fiub":
        count = int(np.sum(one != two))
        return f"{count} of {one.size} values" if count else ""
    if np.array_equal(one, two, equal_nan=one.dtype.kind == "f" and two.dtype.kind == "f"):
        return ""
    gap = np.abs(two.astype(np.float64) - one.astype(np.float64))
    known = np.isfinite(gap)
    scale = np.abs(one[known].astype(np.float64)).max(initial=0.0) or 1.0
    count = int((gap[known] > 0).sum() + (np.isnan(one) != np.isnan(two)).sum())
    largest = gap[known].max(initial=0.0) / scale
    return f"{count} of {one.size} values, by up to {largest:.1e} of the largest"
