"""A simulation from its scene to a run on disk: the loop, the checkpoint, the archive."""

import math
import time
from collections.abc import Callable
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
from cellquant.sim.integrators import find_method, recommended
from cellquant.sim.scene import Scene, SimulationFailure
from cellquant.sim.shapes import pinched
from cellquant.sim.steps import AdaptiveSteps, FixedSteps, Plan
from cellquant.storage import atomic_path, clear_disk_errors

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

CELLS_PER_THREAD = 256  # a thread with fewer cells waits longer than it works
CHECKPOINT_EVERY = 20.0  # seconds of wall time
TOLERANCE = 1e-3  # of the adaptive method, L0
FRAMES_IN_MEMORY = 2_000_000  # numbers of buffered frames before they are written


@clear_disk_errors()
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
        Longest step, t0; None for the usual one of the method, shorter where cells are fast
        (`Method.usual_step`). Steps divide `save_every`.
    tolerance
        RMS error of the centres that a step of the adaptive method may make, L0; chooses it.
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
        If the run cannot go on, e.g. a step is too long even in 64 parts. The exception carries
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
    if integrator is None:
        integrator = recommended(scene, contact) if tolerance is None else "adaptive"
    name, method = find_method(integrator)
    if dt is not None:
        _positive("dt", dt)
    if tolerance is not None:
        _positive("tolerance", tolerance)
    if (dt if method.adaptive else tolerance) is not None:
        kind = "a tolerance and no dt" if method.adaptive else "dt and no tolerance"
        raise InputError(f"the integrator {name} takes {kind}; change the options.")
    longest = frame_interval if method.adaptive else (dt or method.usual_step(scene))
    plan = Plan.of(duration, transient, frame_interval, longest)
    settings = {
        "contact": contact,
        "points": points if contact == "quadrature" else None,
        "integrator": name,
        "dt": None if method.adaptive else plan.h,
        "tolerance": (tolerance or TOLERANCE) if method.adaptive else None,
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
        self.steps: FixedSteps | AdaptiveSteps
        if settings["tolerance"] is None:
            self.steps = FixedSteps(self.layer, settings["integrator"], plan)
        else:
            self.steps = AdaptiveSteps(self.layer, plan, settings["tolerance"])
        self.interval = 0  # frame intervals done, those of the transient included
        self.cpu = 0.0
        self.pinched = np.zeros(len(radius), np.int64)  # frame intervals each cell ended pinched
        self.buffer: list[tuple[float, Floats]] = []
        stored = self._resume()
        if stored is None:
            self.group = self._create(radius, box)
            self.written = 0
        self.run_object = Run(self.group, self.path)

    def _create(self, radius: Floats, box: Floats) -> Any:
        """Make the run whole or not at all, so that a kill leaves nothing to trip over."""
        if self.path is None:
            group = create_group(None, self.scene, self.settings)
            write_constants(group, radius, box)
            return group
        with atomic_path(self.path) as temporary:
            write_constants(create_group(temporary, self.scene, self.settings), radius, box)
        return open_group(self.path, "r+")

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
            self.pinched = stored["pinched"]
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
                self._count_pinched()
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

    def _count_pinched(self) -> None:
        if not self.scene.rigid:
            modes = self.state[:, 3:].reshape(len(self.state), 2, -1)
            self.pinched += pinched(modes)

    def _write_frames(self) -> None:
        if self.buffer:
            times = np.array([t for t, _ in self.buffer])
            append_frames(self.group, self.written, times, np.array([s for _, s in self.buffer]))
            self.written += len(self.buffer)
            self.buffer.clear()
        self.group.attrs["work"] = {
            "steps": self.steps.count,
            "rejected": self.steps.rejected,
            "repaired": self.steps.repaired,
            "evaluations": self.layer.evaluations,
            "cpu_seconds": self.cpu,
            "pinched_cells": int(np.count_nonzero(self.pinched)),
            "pinched_share": float(self.pinched.mean() / max(1, self.interval)),
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
            pinched=self.pinched,
            evaluations=self.layer.evaluations,
            builds=self.layer.builds,
            reference=reference,
            steps=self.steps.save(),
        )
