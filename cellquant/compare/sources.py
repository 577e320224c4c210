"""What a result was made from, where it is still at hand: masks, trajectories, the run."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.compare.results import Result
from cellquant.errors import InputError
from cellquant.tables import read_tracks

if TYPE_CHECKING:
    from cellquant.io import LabelStack
    from cellquant.sim import Run


def with_sources(result: Result) -> Result:
    """Add the trajectories, masks or run that a result was made from, where they are at hand.

    They are looked for in the result's folder and at the paths that its record names; what is
    gone or cannot be read stays None.
    """
    if result.folder is None:
        return result
    found = result
    run = run_of(result)
    if run is not None:
        found = replace(found, run=run, tracks=run.to_tracks())
    for place in _places(result):
        if found.tracks is not None or not (place / "tracks.parquet").is_file():
            continue
        try:
            found = replace(found, tracks=read_tracks(place))
        except (InputError, OSError):
            continue
    for record in _records(result):
        if found.stack is None and not found.simulated:
            found = replace(found, stack=_masks_of(record, result.folder))
    return found


def run_of(result: Result) -> "Run | None":
    """The simulated run that a result was made from; None where it is not at hand."""
    if result.run is not None or not result.simulated:
        return result.run
    for place in _places(result):
        for zarr in (place, place / "run.zarr"):
            if (zarr / "zarr.json").is_file():
                from cellquant.sim import open_run

                try:
                    return open_run(zarr)
                except (InputError, OSError):
                    continue
    return None


def _records(result: Result) -> list[Mapping[str, Any]]:
    return [result.record, *result.record.get("earlier", [])]


def _places(result: Result) -> list[Path]:
    """Where the files behind a result may be: its folder, and the paths that its record names."""
    if result.folder is None:
        return []
    places = [result.folder]
    for record in _records(result):
        source = record.get("settings", {}).get("source")
        if isinstance(source, str):
            places += [Path(source), result.folder / source]
    return places


def _masks_of(record: Mapping[str, Any], folder: Path) -> "LabelStack | None":
    from cellquant.io import read_labels

    settings = record.get("settings", {})
    named = [settings.get("masks"), *record.get("inputs", {})]
    calibration = settings.get("calibration", settings)
    for path in [Path(name) for name in named if isinstance(name, str)]:
        # A path as given may be relative to where the study was made, above its results.
        above = [] if path.is_absolute() else [one / path for one in folder.resolve().parents[:6]]
        for place in (path, folder / path.name, *above):
            if not place.exists() or place.suffix in {".parquet", ".toml", ".json", ".zarr"}:
                continue
            try:
                if {"px", "pixel"} & {calibration.get("length_unit"), calibration.get("units")}:
                    return read_labels(place, units="pixel")
                return read_labels(
                    place,
                    pixel_size=calibration.get("pixel_size"),
                    frame_interval=calibration.get("frame_interval"),
                )
            except (InputError, OSError):
                continue
    return None
