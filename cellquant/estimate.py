"""What a sweep will cost, from short pilot runs on this machine."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cellquant.config import SceneConfig, SweepConfig, load
from cellquant.storage import content_key

PILOT_TIME = 4.0  # t0 of a pilot run
PILOT_FRAMES = 32  # states on which the observables are tried
SHORT = 0.05  # t0 between those
PILOTS = 3  # scenes tried of each group that differs in phi, v0, eta and the like alone
# What decides the cost of a step beside the state of the layer.
_KIND = ("cells", "modes", "contact", "points", "integrator", "tolerance")
# Memory of a worker beside its tables, and of the tables: measured, see docs/scale.md.
BASE_MEMORY = 345e6
BYTES_PER_CELL_AND_FRAME = 350.0

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Estimate:
    """Cost of a sweep.

    Attributes
    ----------
    runs, scenes, pilots
        Number of runs, of scenes that differ in more than the seed, and of pilot runs made.
    simulate_s, observe_s
        Processor time of all runs, one kernel thread each.
    wall_s
        Time with `workers` worker processes that have a core each.
    memory_MB
        Of the largest run, for one worker.
    disk_MB
        Simulated runs before compression, and their tables.
    workers
        Worker processes assumed.
    """

    runs: int
    scenes: int
    pilots: int
    simulate_s: float
    observe_s: float
    wall_s: float
    memory_MB: float
    disk_MB: float
    workers: int

    def as_dict(self) -> dict[str, Any]:
        """For programs; JSON-serialisable."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def as_lines(self) -> list[str]:
        """In words."""
        noun = "worker" if self.workers == 1 else "workers"
        return [
            f"{self.runs} runs of {self.scenes} scenes, judged by {self.pilots} pilot runs",
            f"time: about {_duration(self.simulate_s)} of one core to simulate and "
            f"{_duration(self.observe_s)} to observe, {_duration(self.wall_s)} with "
            f"{self.workers} {noun}",
            f"memory: about {self.memory_MB:.0f} MB for each worker",
            f"disk: at most {self.disk_MB:.0f} MB",
        ]


def estimate_sweep(
    path: str | Path, *, workers: int = 1, progress: Progress | None = None
) -> Estimate:
    """Estimate time, memory and disk of a sweep.

    Scenes that differ in nothing that decides the cost of a step form a group; of each, up to
    `PILOTS` scenes, spread over the order of the file, are simulated for `PILOT_TIME` from the
    start and observed. Processor time is scaled with simulated time and saved states.

    Parameters
    ----------
    path
        The sweep file.
    workers
        Worker processes, each with a core of its own.
    progress
        Called with (pilot runs done, in all).
    """
    config = load(path, SweepConfig)
    groups: dict[str, list[SceneConfig]] = {}
    different: set[str] = set()
    scenes = config.scenes()
    for scene in scenes:
        content = scene.model_dump()
        kind = {name: content[name] for name in _KIND} | {"step": _step(scene)}
        groups.setdefault(content_key(kind), []).append(scene)
        different.add(content_key({k: v for k, v in content.items() if k != "seed"}))
    chosen = {key: _spread(members, PILOTS) for key, members in groups.items()}
    total = sum(len(pilots) for pilots in chosen.values())
    options = config.observables.model_dump(exclude_none=True)
    simulate_s = observe_s = disk = memory = 0.0
    done = 0
    for key, members in groups.items():
        costs = []
        for pilot in chosen[key]:
            costs.append(_pilot(pilot, options))
            done += 1
            if progress is not None:
                progress(done, total)
        per_time = sum(cost[0] for cost in costs) / len(costs)
        per_cell_and_frame = sum(cost[1] for cost in costs) / len(costs)
        for scene in members:
            states = _frames(scene) * scene.cells
            simulate_s += per_time * (scene.transient + scene.duration)
            observe_s += per_cell_and_frame * states
            disk += 8.0 * states * (3 + 2 * (scene.modes - 1))
            memory = max(memory, BASE_MEMORY + BYTES_PER_CELL_AND_FRAME * states)
    cpu = simulate_s + observe_s
    return Estimate(
        runs=len(scenes),
        scenes=len(different),
        pilots=total,
        simulate_s=round(simulate_s, 1),
        observe_s=round(observe_s, 1),
        wall_s=round(cpu / min(workers, len(scenes)), 1),
        memory_MB=round(memory / 1e6, 1),
        disk_MB=round(disk / 1e6, 1),
        workers=workers,
    )


def _frames(scene: SceneConfig) -> float:
    return scene.duration / (scene.save_every or max(1.0, scene.duration / 2000)) + 1


def _step(scene: SceneConfig) -> float:
    from cellquant.sim import Scene
    from cellquant.sim.integrators import METHODS, recommended

    reduced = Scene.from_config(scene)
    name = scene.integrator or recommended(reduced, scene.contact)
    return scene.dt or METHODS[name].usual_step(reduced)


def _spread(members: list[SceneConfig], number: int) -> list[SceneConfig]:
    last = len(members) - 1
    places = {round(place * last / max(1, number - 1)) for place in range(number)}
    return [members[place] for place in sorted(places)]


def _pilot(scene: SceneConfig, options: dict[str, Any]) -> tuple[float, float]:
    """Processor time of one t0 of simulation, and of observing one cell in one frame."""
    from cellquant.observables import observe
    from cellquant.sim import Run, Scene, simulate

    def run(duration: float, save_every: float) -> Run:
        return simulate(
            Scene.from_config(scene),
            duration=duration,
            save_every=save_every,
            contact=scene.contact,
            points=scene.points,
            integrator=scene.integrator,
            dt=scene.dt,
            tolerance=scene.tolerance,
        )

    few = run(PILOT_FRAMES * SHORT, SHORT)  # compiles, and has states to observe
    simulated, observed = [], []
    for _ in range(2):
        started = time.process_time()
        run(PILOT_TIME, min(1.0, scene.save_every or 1.0))
        between = time.process_time()
        observe(few, **options)
        simulated.append(between - started)
        observed.append(time.process_time() - between)
    return min(simulated) / PILOT_TIME, min(observed) / (few.n_frames * scene.cells)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172_800 else f"{seconds / 86_400:.1f} days"
