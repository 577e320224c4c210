"""A run on disk: a zarr group that grows frame by frame and can be read meanwhile."""

import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import zarr
from numpy.typing import NDArray

from cellquant import __version__
from cellquant.errors import InputError
from cellquant.io.runstore import check_run_store, read_arrays
from cellquant.sim.rows import RunRows, RunScan
from cellquant.sim.scene import MOST_OF_A_MODE, Scene
from cellquant.sim.shapes import shape_indices
from cellquant.storage import atomic_path
from cellquant.tables import REDUCED, TRACK_COLUMNS, Tracks

Floats = NDArray[np.float64]
CHECKPOINT = "checkpoint.npz"
_LARGEST = 1e300  # number in the description of a run
CHUNK = 262_144  # numbers of a chunk: what one write of a growing run touches


def create_group(path: Path | None, scene: Scene, settings: dict[str, Any]) -> Any:
    """Make an empty run on disk, or in memory where the path is None."""
    store = zarr.storage.MemoryStore() if path is None else zarr.storage.LocalStore(path)
    group = zarr.create_group(store, zarr_format=3)
    n_cells, n_modes = scene.n_cells, scene.modes - 1
    for name, shape in (
        ("time", ()),
        ("position", (n_cells, 2)),
        ("polarity", (n_cells,)),
        ("modes", (n_cells, 2, n_modes)),
    ):
        per_frame = max(1, int(np.prod(shape)))
        group.create_array(
            name,
            shape=(0, *shape),
            chunks=(min(4096, max(1, CHUNK // per_frame)), *(max(1, n) for n in shape)),
            dtype="float64",
            fill_value=np.nan,
        )
    group.attrs.update(
        {
            "format": "cellquant run",
            "version": __version__,
            "length_unit": REDUCED.length,
            "time_unit": REDUCED.time,
            "scene": scene.to_dict(),
            "settings": settings,
            "status": "running",
            "failure": None,
        }
    )
    return group


def write_constants(group: Any, radius: Floats, box: Floats) -> None:
    """Store what does not change with time."""
    for name, values in (("radius", radius), ("box", box)):
        array = group.create_array(name, shape=values.shape, dtype="float64", fill_value=np.nan)
        array[:] = values


def open_group(path: Path, mode: Literal["r", "r+"] = "r") -> Any:
    """Open the group of a run; `InputError` where the folder is none."""
    check_run_store(path)
    try:
        group = zarr.open_group(zarr.storage.LocalStore(path, read_only=mode == "r"), mode=mode)
        attributes: dict[str, Any] = dict(group.attrs)
        _check_description(attributes)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} is not a readable run ({_first_line(error)}); "
            "make one with 'cellquant simulate -o RUN.zarr'."
        ) from error
    return group


def _check_description(attributes: dict[str, Any]) -> None:
    """Raise `ValueError`, `KeyError` or `TypeError` where attributes are not those of a run."""
    Scene.from_dict(dict(attributes["scene"]))
    if not isinstance(attributes["status"], str):
        raise ValueError("its status is not a word")
    if attributes["failure"] is not None:
        dict(attributes["failure"])
    settings = dict(attributes["settings"])
    for name in ("contact", "integrator"):
        if not isinstance(settings[name], str):
            raise ValueError(f"its {name} is {settings[name]!r}, not a name")
    positive = ("save_every", "dt", "tolerance", "points")
    numbers = {name: settings[name] for name in (*positive, "transient", "duration")}
    for name in ("points", "dt" if numbers["dt"] is None else "tolerance"):
        if numbers[name] is None:
            del numbers[name]
    for name, value in (*numbers.items(), *dict(attributes.get("work", {})).items()):
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"its {name} is {value!r}, not a number")
        if not 0 <= value <= _LARGEST or (name in positive and value == 0):
            raise ValueError(f"its {name} is {value!r}")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def append_frames(group: Any, start: int, times: Floats, states: Floats) -> None:
    """Write frames from index `start` on; what stood there, after a kill, is overwritten."""
    stop = start + len(times)
    n_modes = (states.shape[2] - 3) // 2
    shapes = states[:, :, 3:].reshape(len(states), states.shape[1], 2, n_modes)
    columns = {"position": states[:, :, :2], "polarity": states[:, :, 2], "modes": shapes}
    # The time comes last: a frame counts only once its time is there.
    for name, values in (*columns.items(), ("time", times)):
        array = group[name]
        array.resize((stop, *array.shape[1:]))
        if values.size:
            array[start:stop] = values


def write_checkpoint(path: Path, **arrays: Any) -> None:
    """Replace the checkpoint of a run in one move, once the frames it counts on are on the disk."""
    for chunk in path.glob("*/c/**/*"):
        if chunk.is_file():
            with open(chunk, "rb") as file:
                os.fsync(file.fileno())
    with atomic_path(path / CHECKPOINT) as partial:
        np.savez(partial, **arrays)


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """Read the checkpoint of a run, None where there is none."""
    return read_arrays(path / CHECKPOINT) if (path / CHECKPOINT).is_file() else None


@dataclass(frozen=True)
class Stationarity:
    """Result of `Run.stationarity`.

    Attributes
    ----------
    stationary
        Whether the drift is within twice its standard error.
    drift, std_error
        Mean of <p> over the second half of the run minus that over the first, and its error from
        blocks.
    n_blocks
        Blocks per half.
    """

    stationary: bool
    drift: float
    std_error: float
    n_blocks: int


def _compare_halves(series: Floats, n_blocks: int) -> Stationarity:
    length = len(series) // (2 * n_blocks)
    if length < 4:
        raise InputError(
            f"a test of stationarity needs {8 * n_blocks} frames, the run has {len(series)}; "
            "simulate for longer or save more often."
        )
    blocks = series[-2 * n_blocks * length :].reshape(2, n_blocks, length).mean(axis=2)
    drift = float(blocks[1].mean() - blocks[0].mean())
    error = float(np.sqrt(np.sum(blocks.var(axis=1, ddof=1)) / n_blocks))
    return Stationarity(abs(drift) <= 2.0 * error, drift, error, n_blocks)


class Run:
    """A simulated run, in memory or on disk, finished or growing.

    Of a growing run it shows the frames that were there when it was first asked for them, so that
    its arrays belong together; open the run again to see more.

    Attributes
    ----------
    path
        Where the run is stored, None in memory.
    """

    def __init__(self, group: Any, path: Path | None = None) -> None:
        self._group: Any = group
        self.path = path

    @cached_property
    def scene(self) -> Scene:
        """The scene that was simulated."""
        return Scene.from_dict(dict(self._group.attrs["scene"]))

    @property
    def settings(self) -> dict[str, Any]:
        """Contact rule, integrator, step, frame interval, transient, duration, version."""
        return dict(self._group.attrs["settings"])

    @property
    def status(self) -> str:
        """``running`` (or interrupted), ``complete`` or ``failed``."""
        return str(self._group.attrs["status"])

    @property
    def failure(self) -> dict[str, Any] | None:
        """Reason, remedy, cell, time and step where the run failed."""
        found = self._group.attrs["failure"]
        return None if found is None else dict(found)

    @property
    def work(self) -> dict[str, Any]:
        """What the run took, and what was out of the ordinary.

        steps, rejected (given up) and repaired (taken in parts) steps, force evaluations,
        cpu_seconds; pinched_cells: cells that ended some frame interval with R <= 0 somewhere,
        the transient included, and pinched_share: their share of all cells and intervals.
        """
        return dict(self._group.attrs.get("work", {}))

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.time)

    @cached_property
    def time(self) -> Floats:
        """(T,) time of the frames since the end of the transient, t0."""
        times = self.read("time", slice(None))
        return times[: int(np.argmax(np.isnan(times)))] if np.isnan(times).any() else times

    @property
    def position(self) -> Floats:
        """(T, N, 2) unwrapped centres, L0."""
        return self._frames("position")

    @property
    def polarity(self) -> Floats:
        """(T, N) polarity angles, radians, not wrapped."""
        return self._frames("polarity")

    @property
    def modes(self) -> Floats:
        """(T, N, 2, M - 1) coefficients a_n and b_n, n = 2 .. M."""
        return self._frames("modes")

    @cached_property
    def radius(self) -> Floats:
        """(N,) radii R0_i, L0."""
        return self.read("radius", slice(None))

    @cached_property
    def box(self) -> tuple[float, float]:
        """Edges of the periodic box, L0."""
        edges = self.read("box", slice(None))
        return float(edges[0]), float(edges[1])

    @property
    def phi(self) -> float:
        """Packing fraction sum(pi R0_i^2) / (Lx Ly)."""
        return float(np.sum(math.pi * self.radius**2)) / (self.box[0] * self.box[1])

    def read(self, name: str, where: slice | int) -> Floats:
        """Frames of an array, or all of what does not change.

        Raises
        ------
        InputError
            If they cannot be decoded or are not all there.
        """
        with self._decoding(name):
            values = np.asarray(self._group[name][where], np.float64)
        # A lost file of an array reads as its fill value, NaN; times end where the run does.
        sound = name == "time" or bool(np.isfinite(values).all())
        if sound and name in ("radius", "box"):
            sound = bool((values > 0.0).all())
        elif sound and name == "modes":
            sound = not (np.abs(values) > MOST_OF_A_MODE).any()
        if not sound:
            raise InputError(
                f"{self.path or 'the run'}: {name} is incomplete; a file of it is lost or damaged: "
                "simulate the run again."
            )
        return values

    @contextmanager
    def _decoding(self, name: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # whatever a decoder calls it
            raise InputError(
                f"{self.path or 'the run'}: {name} cannot be decoded ({_first_line(error)}); the "
                "run is damaged: simulate it again."
            ) from error

    def _frames(self, name: str) -> Floats:
        return self.read(name, slice(self.n_frames))

    def state(self, frame: int) -> Floats:
        """State rows x, y, theta, a_2 .. a_M, b_2 .. b_M of one frame."""
        frame = range(self.n_frames)[frame]
        modes = self.read("modes", frame)
        polarity = self.read("polarity", frame)
        position = self.read("position", frame)
        return np.column_stack([position, polarity, modes.reshape(len(modes), -1)])

    def stretches(self) -> Iterator[slice]:
        """Successive frames that lie together on disk, all frames in turn."""
        with self._decoding("modes"):
            size = int(self._group["modes"].chunks[0])
        for start in range(0, self.n_frames, size):
            yield slice(start, min(start + size, self.n_frames))

    def mean_shape_index(self) -> Floats:
        """(T,) mean over the cells of p = P / sqrt(A), from the true contours."""
        means = [
            shape_indices(modes).mean()
            for frames in self.stretches()
            for modes in self.read("modes", frames)
        ]
        return np.array(means)

    def stationarity(self, n_blocks: int = 5, *, start: int = 0) -> Stationarity:
        """Test whether <p> still drifts: the halves of the run against their block errors.

        The difference of the two halves' means is compared with the standard error that `n_blocks`
        blocks per half give; a run is taken for stationary where it is within two errors.

        Parameters
        ----------
        n_blocks
            Blocks per half.
        start
            Frames before this one are left out, as a transient.

        Raises
        ------
        InputError
            If the run has fewer than four frames per block.
        """
        return _compare_halves(self.mean_shape_index()[start:], n_blocks)

    def to_tracks(self, *, columns: Sequence[str] | None = None) -> Tracks:
        """The run as tracks, measured on the true contours, in reduced units.

        Label and track_id are the index of the cell plus one; x, y the unwrapped centres;
        n_neighbours counts the cells whose contours overlap; no cell touches a border.

        Parameters
        ----------
        columns
            Names out of `cellquant.tables.TRACK_COLUMNS`; contours are measured and neighbours
            are counted only for a column that needs it. All columns when None.

        Raises
        ------
        InputError
            If the run holds no frame.
        """
        scan = self.scan(columns=columns)
        assert isinstance(scan.head, Tracks)
        names = list(scan.head.table.columns)
        pieces = list(RunRows(self).pieces(*names))
        table = pd.DataFrame({k: np.concatenate([piece.pop(k) for piece in pieces]) for k in names})
        return replace(scan.head, table=table)

    def scan(self, *, columns: Sequence[str] | None = None) -> RunScan:
        """The run as tracks that are made a few cells at a time, without holding the table.

        Parameters
        ----------
        columns
            As in `to_tracks`.

        Raises
        ------
        InputError
            If the run holds no frame.
        """
        if self.n_frames == 0:
            raise InputError(f"{self.path or 'the run'} holds no frame yet; simulate for longer.")
        wanted = [name for name in TRACK_COLUMNS if columns is None or name in columns]
        provenance: dict[str, Any] = {
            "source": "simulation",
            "scene": self.scene.to_dict(),
            "settings": self.settings,
            "status": self.status,
        }
        if "shape_index" in wanted:
            try:
                provenance["stationarity"] = asdict(self.stationarity())
            except InputError as error:
                provenance["stationarity"] = {"stationary": None, "reason": str(error)}
        head = Tracks(
            table=pd.DataFrame({name: np.empty(0, TRACK_COLUMNS[name]) for name in wanted}),
            units=REDUCED,
            frame_interval=float(self.settings["save_every"]),
            area=self.box[0] * self.box[1],
            box=self.box,
            provenance=provenance,
        )
        return RunScan(head, self.path or Path("run"), self)

    def count_neighbours(self) -> NDArray[np.int64]:
        """(T, N) number of cells whose contours each cell overlaps."""
        from cellquant.sim.contacts import Layer

        layer = Layer(self.scene, self.radius, np.array(self.box))
        counts = np.zeros((self.n_frames, len(self.radius)), np.int64)
        for t in range(self.n_frames):
            pairs = layer.touching(self.state(t))
            pairs = pairs[pairs[:, 0] != pairs[:, 1]]
            if len(pairs):
                pairs = np.unique(np.sort(pairs, axis=1), axis=0)
                counts[t] = np.bincount(pairs.ravel(), minlength=len(self.radius))
        return counts
