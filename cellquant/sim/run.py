"""A simulation from its scene to a run on disk: the loop, the checkpoint, the archive."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from cellquant import __version__
from cellquant.errors import InputError
from cellquant.sim.archive import (
    Run,
    append_frames,
    create_group,
    open_group,
    read_checkpoint,
    write_checkpoint,
    write_constants,
)
from cellquant.sim.contacts import ContactRule, Layer
from cellquant.sim.initial import initial_state
from cellquant.sim.integrators import find_method
from cellquant.sim.noise import BrownianTree
from cellquant.sim.scene import Scene, SimulationFailure

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

ROOT_DEPTH = 2  # a root of the Brownian tree spans 2^2 steps
WATCH_EVERY = 16  # steps between two checks of the step length
CHATTER_LIMIT = 0.02  # RMS change of the displacement from one step to the next, L0
CELLS_PER_THREAD = 256  # a thread with fewer cells waits longer than it works
CHECKPOINT_EVERY = 20.0  # seconds of wall time
FRAMES_IN_MEMORY = 2_000_000  # numbers of buffered frames before they are written


@dataclass(frozen=True)
class Plan:
    """Steps of a run: n_before frames' worth of transient, then n_frames - 1 saved intervals."""

    h: float
    steps_per_frame: int
    n_before: int
    n_frames: int

    @classmethod
    def of(cls, duration: float, transient: float, save_every: float, dt: float) -> "Plan":
        """Divide the frame interval into equal steps no longer than dt."""
        steps = max(1, math.ceil(save_every / dt * (1.0 - 1e-12)))
        return cls(
            h=save_every / steps,
            steps_per_frame=steps,
            n_before=math.ceil(transient / save_every * (1.0 - 1e-12)),
            n_frames=1 + math.ceil(duration / save_every * (1.0 - 1e-12)),
        )


def simulate(
    scene: Scene,
    *,
    duration: float,
    transient: float = 0.0,
    seed: int | None = None,
    contact: ContactRule = "exact",
    points: int = 40,
    integrator: str | None = None,
    dt: float | None = None,
    tolerance: float | None = None,
    save_every: float | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
) -> Run:
    """Simulate a layer; a run that was interrupted goes on where it stopped.

    Parameters
    ----------
    scene
        The layer.
    duration
        Saved time, t0; rounded up to whole frames.
    transient
        Time before it that is not saved, t0.
    seed
        Replaces the seed of the scene.
    contact
        ``"exact"``, or ``"quadrature"``: the published sum over `points` contour points.
    integrator
        Name of the method; None for the recommended one.
    dt
        Longest step, t0; None for the usual one of the method. Steps divide `save_every`.
    tolerance
        Error per step of the adaptive method, L0; only with it.
    save_every
        Time between saved states, t0; None for the larger of 1 and duration / 2000.
    output
        Path of the run, e.g. ``RUN.zarr``; None to keep it in memory. Where the path holds an
        unfinished run of the same scene and settings, it is resumed, bitwise as if never stopped.
    progress
        Called with the simulated and the total time, in whole t0.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If an option is wrong, or `output` holds something else.
    SimulationFailure
        If the run cannot go on: a step too long, a contour that is none. The exception carries
        the partial run, the step, the cell and the remedy.
    """
    if seed is not None:
        scene = scene.replace(seed=seed)
    _positive("duration", duration)
    if not (math.isfinite(transient) and transient >= 0.0):
        raise InputError(f"transient must be a finite time >= 0 t0, got {transient}; correct it.")
    frame_interval = save_every if save_every is not None else max(1.0, duration / 2000.0)
    if save_every is None and duration < 1.0:
        frame_interval = duration
    _positive("save_every", frame_interval)
    name, method = find_method(integrator)
    if dt is not None:
        _positive("dt", dt)
    if tolerance is not None:
        _positive("tolerance", tolerance)
    if (tolerance is not None) != method.adaptive and (tolerance is not None or dt is not None):
        kind = "needs a tolerance and no dt" if method.adaptive else "takes dt and no tolerance"
        raise InputError(f"the integrator {name} {kind}; change the options.")
    plan = Plan.of(duration, transient, frame_interval, dt or method.dt)
    settings = {
        "contact": contact,
        "points": points if contact == "quadrature" else None,
        "integrator": name,
        "dt": plan.h,
        "tolerance": tolerance if tolerance is not None or not method.adaptive else method.dt,
        "save_every": frame_interval,
        "transient": plan.n_before * frame_interval,
        "duration": (plan.n_frames - 1) * frame_interval,
        "version": __version__,
    }
    simulation = _Simulation(scene, settings, plan, output, points)
    return simulation.run(progress)


def open_run(path: str | Path) -> Run:
    """Open a run written by `simulate`, finished or not.

    Raises
    ------
    InputError
        If the path is missing or is no run.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path} does not exist; make a run with 'cellquant simulate -o {path}'.")
    return Run(open_group(path), path)


def _positive(name: str, value: float) -> None:
    if not (isinstance(value, (int, float)) and math.isfinite(value) and value > 0.0):
        raise InputError(f"{name} must be a finite time > 0 t0, got {value!r}; correct it.")


class _Simulation:
    """The loop over frames, with its checkpoint."""

    def __init__(
        self,
        scene: Scene,
        settings: dict[str, Any],
        plan: Plan,
        output: str | Path | None,
        points: int,
    ) -> None:
        self.scene, self.settings, self.plan = scene, settings, plan
        self.path = None if output is None else Path(output)
        self.state, radius, box = initial_state(scene)
        self.layer = Layer(scene, radius, box, contact=settings["contact"], points=points)
        self.steps = FixedSteps(self.layer, settings["integrator"], plan)
        self.interval = 0  # frame intervals done, those of the transient included
        self.cpu = 0.0
        self.buffer: list[tuple[float, Floats]] = []
        stored = self._resume()
        if stored is None:
            self.group = create_group(self.path, scene, settings)
            write_constants(self.group, radius, box)
            self.written = 0
        self.run_object = Run(self.group, self.path)

    def _resume(self) -> dict[str, Any] | None:
        """Go back to the checkpoint of an earlier run at the same path."""
        if self.path is None or not self.path.exists():
            return None
        if self.path.is_dir() and not any(self.path.iterdir()):
            return None
        if not (self.path / "zarr.json").is_file():
            raise InputError(
                f"{self.path} exists and is no run; choose another output or remove it."
            )
        self.group = open_group(self.path, "r+")
        before = Run(self.group, self.path)
        differing = sorted(
            key
            for old, new in (
                (before.scene.to_dict(), self.scene.to_dict()),
                (before.settings, self.settings),
            )
            for key in set(old) | set(new)
            if old.get(key) != new.get(key)
        )
        if differing:
            raise InputError(
                f"{self.path} holds a run with another {', '.join(differing)}; "
                "choose another output, or remove it."
            )
        stored = read_checkpoint(self.path)
        self.written = 0
        if stored is not None:
            self.state = stored["state"]
            self.interval = int(stored["interval"])
            self.written = int(stored["written"])
            self.cpu = float(stored["cpu"])
            self.layer.evaluations = int(stored["evaluations"])
            self.layer.builds = int(stored["builds"])
            if len(stored["reference"]):
                self.layer.restore_list(stored["reference"])
            self.steps.restore(stored["steps"])
        return stored if stored is not None else {}

    def run(self, progress: Progress | None) -> Run:
        plan = self.plan
        if self.run_object.status == "complete":
            return self.run_object
        frame_interval = self.settings["save_every"]
        total = (plan.n_before + plan.n_frames - 1) * frame_interval
        last_write = time.monotonic()
        clock = time.process_time()
        threads = numba.get_num_threads()
        numba.set_num_threads(max(1, min(threads, len(self.state) // CELLS_PER_THREAD)))
        try:
            while True:
                frame = self.interval - plan.n_before
                if frame >= self.written + len(self.buffer):
                    self.buffer.append((frame * frame_interval, self.state.copy()))
                if frame == plan.n_frames - 1:
                    break
                self.steps.advance(self.state, self.interval)
                self.interval += 1
                if progress is not None:
                    progress(round(self.interval * frame_interval), round(total))
                now = time.monotonic()
                held = len(self.buffer) * self.state.size
                if now - last_write > CHECKPOINT_EVERY or held > FRAMES_IN_MEMORY:
                    self.cpu += time.process_time() - clock
                    clock = time.process_time()
                    self._write()
                    last_write = time.monotonic()
        except SimulationFailure as failure:
            self.cpu += time.process_time() - clock
            raise self._fail(failure) from failure
        except KeyboardInterrupt:
            self.cpu += time.process_time() - clock
            self._write_frames()
            raise
        finally:
            numba.set_num_threads(threads)
        self.cpu += time.process_time() - clock
        self._write()
        self.group.attrs.update({"status": "complete", "failure": None})
        return self.run_object

    def _fail(self, failure: SimulationFailure) -> SimulationFailure:
        self._write_frames()
        told = SimulationFailure(
            failure.reason,
            failure.remedy,
            cell=failure.cell,
            time=self.interval * self.settings["save_every"] + self.steps.elapsed,
            step=self.steps.count,
            run=self.run_object,
        )
        names = ("reason", "remedy", "cell", "time", "step")
        record = {name: getattr(told, name) for name in names}
        self.group.attrs.update({"status": "failed", "failure": record})
        return told

    def _write_frames(self) -> None:
        if self.buffer:
            times = np.array([t for t, _ in self.buffer])
            append_frames(self.group, self.written, times, np.array([s for _, s in self.buffer]))
            self.written += len(self.buffer)
            self.buffer.clear()
        self.group.attrs["work"] = {
            "steps": self.steps.count,
            "rejected": self.steps.rejected,
            "evaluations": self.layer.evaluations,
            "cpu_seconds": self.cpu,
        }

    def _write(self) -> None:
        self._write_frames()
        if self.path is None:
            return
        reference = self.layer.age_of_list() if self.layer.builds else np.empty((0, 3))
        write_checkpoint(
            self.path,
            state=self.state,
            interval=self.interval,
            written=self.written,
            cpu=self.cpu,
            evaluations=self.layer.evaluations,
            builds=self.layer.builds,
            reference=reference,
            steps=self.steps.save(),
        )


class FixedSteps:
    """Equal steps of one method, watched for steps that are too long.

    Attributes
    ----------
    count, rejected
        Steps taken and given up.
    elapsed
        Time since the start of the frame interval, t0.
    """

    def __init__(self, layer: Layer, integrator: str, plan: Plan) -> None:
        self.layer = layer
        self.plan = plan
        self.count = 0
        self.rejected = 0
        self.elapsed = 0.0
        self._method = find_method(integrator)[1].make(layer)
        self._tree = BrownianTree(layer.scene.seed, len(layer.radius), plan.h * 2**ROOT_DEPTH)
        self._still = np.zeros(len(layer.radius))
        self._chatter = 0.0

    def save(self) -> Floats:
        """What a checkpoint has to keep."""
        return np.array([self.count, self._chatter])

    def restore(self, stored: Floats) -> None:
        """Go on from what `save` returned."""
        self.count, self._chatter = int(stored[0]), float(stored[1])

    def advance(self, state: Floats, interval: int) -> None:
        """Advance a state over one frame interval, in place."""
        steps = self.plan.steps_per_frame
        leaves = 2**ROOT_DEPTH
        before = state[:, :2].copy()
        moved: Floats | None = None
        for index in range(interval * steps, (interval + 1) * steps):
            w = area = self._still
            if self.layer.scene.has_noise:
                ws, areas = self._tree.level(index // leaves, ROOT_DEPTH)
                w, area = ws[index % leaves], areas[index % leaves]
            watched = index % WATCH_EVERY < 2
            if watched:
                before[:] = state[:, :2]
            self._method.step(state, self.plan.h, w, area)
            self.count += 1
            self.elapsed = (index + 1 - interval * steps) * self.plan.h
            if watched:
                previous, moved = moved, state[:, :2] - before
                self._watch(moved, previous if index % WATCH_EVERY == 1 else None)
        self.elapsed = 0.0

    def _watch(self, moved: Floats, previous: Floats | None) -> None:
        """Stop where cells jump, or where the displacement changes too much from step to step."""
        remedy = "take a smaller dt or the adaptive integrator"
        reach = float(np.abs(moved).max())
        if not reach < 0.5 * self.layer.scene.mean_radius:
            cell = int(np.argmax(np.abs(moved).max(axis=1)))
            raise SimulationFailure("a cell jumped within one step", remedy, cell=cell)
        if previous is None:
            return
        change = float(np.sqrt(np.mean((moved - previous) ** 2)))
        self._chatter += 0.2 * (change / (2.0 * self.layer.scene.mean_radius) - self._chatter)
        if self._chatter > CHATTER_LIMIT:
            raise SimulationFailure("the step is too long for the contacts, which chatter", remedy)
