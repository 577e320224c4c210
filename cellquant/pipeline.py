"""The jobs of one movie or one simulation, from input to a finished output folder.

Shared by the command line, the batch and the demo, so that the three can never differ.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cellquant.errors import InputError
from cellquant.storage import RunRecord, check_output, replace_together

if TYPE_CHECKING:
    from cellquant.config import SceneConfig
    from cellquant.io import ImageStack, LabelStack
    from cellquant.observables import Observables
    from cellquant.sim import Run
    from cellquant.tables import Cells, Tracks

Progress = Callable[[int, int], None]
Step = Callable[[str], AbstractContextManager[Progress | None]]


def silent(label: str) -> AbstractContextManager[Progress | None]:
    """Report no progress."""
    return nullcontext()


def track_movie(
    masks: "LabelStack",
    out: str | Path,
    *,
    raw: "ImageStack | None" = None,
    options: Mapping[str, Any] | None = None,
    export_ctc: bool = False,
    key: str | None = None,
    step: Step = silent,
) -> "tuple[Cells, Tracks, RunRecord]":
    """Measure and link the cells of a movie; write cells, tracks and the record of the run.

    Parameters
    ----------
    masks
        The label masks, calibrated or read with ``units="pixel"``.
    out
        Output folder: ``cells.parquet``, ``tracks.parquet``, ``run.json``, and with `export_ctc`
        the folder ``ctc``.
    raw
        The recorded movie, frame by frame the same as `masks`.
    options
        Keyword arguments of `cellquant.track.track_cells`.
    key
        Key of this work, for the record; None where nobody asks for it.
    step
        Gives a progress callback for each stage.

    Raises
    ------
    InputError
        If the masks are not calibrated, cannot be read, hold no cell or a single frame, or the
        output cannot be written.
    """
    from cellquant.segment import measure_cells
    from cellquant.track import track_cells

    folder = check_output(out)
    calibrated = _calibration(masks)
    if masks.n_frames < 2:
        raise InputError(
            f"{masks.path} holds a single frame, and tracking needs at least two; "
            "for shapes alone use 'cellquant observe MASKS --only shape_index'."
        )
    chosen = dict(options or {})
    record = RunRecord(
        "track",
        {
            **calibrated,
            "raw": None if raw is None else str(raw.path),
            **chosen,
            **({} if key is None else {"key": key}),
        },
        notes=list(masks.notes),
    )
    with record.stage("digest"):
        for stack in (masks, raw):
            if stack is not None and stack.path is not None:
                record.add_input(stack.path)
    with record.stage("measure"), step("measure cells") as progress:
        cells = measure_cells(masks, progress=progress)
    if cells.table.empty:
        raise InputError(
            f"{masks.path} holds no cell in any of its {masks.n_frames} frames; "
            "check that it is the mask stack and not the raw movie."
        )
    with record.stage("link"), step("link cells") as progress:
        tracks = track_cells(cells, masks, raw=raw, progress=progress, **chosen)
    record.counts = {
        "frames": cells.n_frames,
        "cells": len(cells.table),
        "tracks": tracks.n_tracks,
        "faults": dict(cells.faults),
    }
    with replace_together(folder) as place:
        with record.stage("write"):
            cells.write(place / "cells.parquet")
            tracks.write(place / "tracks.parquet")
            if export_ctc:
                from cellquant.io import write_ctc

                write_ctc(place / "ctc", masks, tracks.table)
        record.write(place, after=folder)
    return cells, tracks, record


def _calibration(masks: "LabelStack") -> dict[str, Any]:
    calibration = masks.calibration
    return {
        "pixel_size": calibration.pixel_size,
        "frame_interval": calibration.frame_interval,
        "length_unit": calibration.units.length,
        "time_unit": calibration.units.time,
        "calibration_source": calibration.source,
    }


def simulate_scene(config: "SceneConfig", out: str | Path | None, *, step: Step = silent) -> "Run":
    """Simulate the layer of a scene file into a run on disk, or go on with an unfinished one.

    Parameters
    ----------
    config
        The scene with its run: transient, duration, contact rule, integrator.
    out
        Path of the run, e.g. ``RUN.zarr``; None to keep it in memory.
    step
        Gives a progress callback that counts simulated time in t0.

    Raises
    ------
    InputError
        If the scene is impossible, an option is wrong, or the output cannot be written.
    """
    from cellquant.sim import Scene, simulate

    if out is not None:
        check_output(Path(out).parent)
    with step("simulate") as progress:
        return simulate(
            Scene.from_config(config),
            duration=config.duration,
            transient=config.transient,
            contact=config.contact,
            points=config.points,
            integrator=config.integrator,
            dt=config.dt,
            tolerance=config.tolerance,
            save_every=config.save_every,
            output=out,
            progress=progress,
        )


def open_source(
    source: str | Path,
    *,
    only: Sequence[str] | None = None,
    calibration: Mapping[str, Any] | None = None,
    step: Step = silent,
) -> "Tracks | Cells | Any":
    """Open what can be observed: tracks, cells, a simulated run, or label masks for shapes alone.

    Tables stay on disk, to be read in pieces; of a run or of masks only the columns that the
    wanted observables read are made.

    Parameters
    ----------
    source
        A folder with ``tracks.parquet``, a parquet table, a ``RUN.zarr``, or label masks.
    only
        Names of the observables wanted, all when None. Where none needs trajectories a table of
        cells or a single frame will do.
    calibration
        Keyword arguments of `cellquant.io.read_labels`, for label masks.
    step
        Gives a progress callback for each stage.

    Raises
    ------
    InputError
        If the path is missing or is none of these, or a name is unknown.
    """
    from cellquant.observables import columns_read, needs_tracks
    from cellquant.rows import scan_cells, scan_tracks

    shapes_only = only is not None and not needs_tracks(only)
    source = Path(source)
    if not source.exists():
        raise InputError(f"{source} does not exist; give tracks, a run or label masks.")
    if source.is_dir() and (source / "zarr.json").is_file():
        from cellquant.sim import open_run

        return open_run(source).scan(columns=columns_read(only))
    if source.is_dir() and (source / "tracks.parquet").is_file():
        if shapes_only and (source / "cells.parquet").is_file():
            return scan_cells(source, columns=columns_read(only, of_cells=True))
        return scan_tracks(source, columns=columns_read(only))
    if source.suffix == ".parquet":
        if source.name.startswith("cells"):
            return scan_cells(source, columns=columns_read(only, of_cells=True))
        return scan_tracks(source, columns=columns_read(only))
    if not shapes_only:
        raise InputError(
            f"{source} holds neither tracks nor a simulated run; make tracks with "
            f"'cellquant track {source} -o DIR' first, or ask for shapes alone with "
            "'--only shape_index'."
        )
    from cellquant.io import read_labels
    from cellquant.segment import measure_cells

    masks = read_labels(source, **(calibration or {}))
    with step("measure cells") as progress:
        return measure_cells(masks, progress=progress)


def observe_source(
    source: str | Path,
    out: str | Path,
    *,
    only: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    calibration: Mapping[str, Any] | None = None,
    step: Step = silent,
) -> "tuple[Observables, RunRecord]":
    """Measure the observables of a source and write ``summary.json`` and one table each.

    Parameters
    ----------
    source, calibration, step
        See `open_source`.
    out
        Output folder.
    only
        Names of the observables wanted; all when None.
    options
        Keyword arguments of `cellquant.observables.observe`.
    """
    folder = check_output(out)
    record = RunRecord(
        "observe",
        {"source": str(source), "only": only, "calibration": calibration, **(options or {})},
    )
    with record.stage("read"):
        data = open_source(
            source,
            only=only,
            calibration=calibration,
            step=step,
        )
        record.add_input(_file_of(Path(source), data))
    observables = _observe(data, record, {"only": only, **(options or {})}, step)
    with replace_together(folder) as place:
        with record.stage("write observables"):
            observables.write(place)
        record.write(place, after=folder)
    return observables, record


def observe_into(
    data: Any,
    folder: Path,
    record: RunRecord,
    *,
    options: Mapping[str, Any] | None = None,
    step: Step = silent,
) -> "Observables":
    """Observe tracks or cells and write the tables; the record is left for the caller to write."""
    observables = _observe(data, record, options or {}, step)
    with record.stage("write observables"):
        observables.write(folder)
    return observables


def _observe(data: Any, record: RunRecord, options: Mapping[str, Any], step: Step) -> "Observables":
    from cellquant.observables import observe

    with record.stage("observe"), step("observe"):
        return observe(data, **options)


def _file_of(source: Path, data: Any) -> Path:
    """Return the file inside a source folder that the observables were computed from."""
    from cellquant.rows import Scan

    return data.path if isinstance(data, Scan) else source
