"""Faults at random moments of a study and of a sweep: the same command then ends in equal bytes.

    python benchmarks/fault_campaign.py [--kills 200] [--errors 24] [--commands 12] [--job run]

Each fault strikes a job in an empty folder. Whatever stands there then under its final name must
be readable; the job is given again, without a fault, and every table, summary, stack report and
simulated array must equal those of a job that was never disturbed. Faults:

- kill at a file operation: SIGKILL just before the n-th open, rename, link, mkdir or removal
- kill at a time: SIGKILL after a time drawn from the length of the job
- full disk: the n-th such operation on the output folder, and all later ones, fail with ENOSPC
- command: a real `cellquant` process with two workers loses a worker, its parent, or all of them

The first three fork a process in which everything is loaded and compiled, so that a fault costs a
second or two. Writes fault_campaign_*.json into --results (benchmarks/results) after every fault
and goes on from there when it is given again with the same code; rows of other code are kept.
With --page it writes the table of docs/reliability.md.
"""

import argparse
import contextlib
import errno
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# Before Numba is loaded: forked children must be able to call kernels.
os.environ.update(
    NUMBA_THREADING_LAYER="workqueue", NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1",
    OPENBLAS_NUM_THREADS="1", OPENCV_FOR_THREADS_NUM="1",
)  # fmt: skip

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "reliability.md"
BEGIN, END = "<!-- faults: generated -->", "<!-- end -->"
EVENTS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.truncate"}
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


@dataclass
class Job:
    """A small job, and what it leaves when nothing disturbs it."""

    name: str
    file: Path
    work: Callable[[Path], Any]
    expected: dict[str, str] = field(default_factory=dict)
    events: int = 0
    seconds: float = 0.0


def jobs(folder: Path) -> list[Job]:
    """A study of two stacks and a sweep of two scenes, both tiny."""
    import numpy as np
    import tifffile

    from cellquant.batch import run_experiment
    from cellquant.compare import figures
    from cellquant.sim import run as simulation
    from cellquant.sweep import run_sweep

    simulation.CHECKPOINT_EVERY = 0.0  # a checkpoint after every saved state
    # Drawing is four fifths of the work of a study and touches no file.
    figures.to_svg = lambda figure, name: f'<svg id="{name}"></svg>'
    rows, columns = np.mgrid[:72, :72]
    for name in ("a", "b"):
        movie = np.zeros((26, 72, 72), np.uint8)
        for frame in range(26):
            for label in range(4):
                y, x = 20 + 30 * (label // 2) + 0.2 * frame, 20 + 30 * (label % 2) + 0.3 * frame
                movie[frame][(rows - y) ** 2 + (columns - x) ** 2 < 49] = (label + frame) % 4 + 1
        tifffile.imwrite(folder / f"{name}.tif", movie)
    experiment, sweep = folder / "experiment.toml", folder / "sweep.toml"
    experiment.write_text(
        "[calibration]\npixel_size = 0.65\nframe_interval = 10\n"
        '[observables]\nonly = ["shape_index", "msd"]\n'
        '[[condition]]\nname = "c"\n[[condition.trial]]\nname = "day"\n'
        'stacks = ["a.tif", "b.tif"]\n'
    )
    sweep.write_text(
        "[scene]\ncells = 9\ntransient = 1\nduration = 10\nsave_every = 1\n"
        '[grid]\nphi = [0.9, 0.97]\n[observables]\nonly = ["shape_index", "msd"]\n'
    )
    return [
        Job("run", experiment, lambda out: run_experiment(experiment, out)),
        Job("sweep", sweep, lambda out: run_sweep(sweep, out)),
    ]


def fingerprint(out: Path) -> dict[str, str]:
    """Digest of every result by its path; times, machine and processor seconds are left out."""
    found = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        skipped = path.name in {"run.json", "checkpoint.npz"} or name == "report.html"
        if path.is_dir() or skipped:
            continue
        content = path.read_bytes()
        if name.endswith("run.zarr/zarr.json"):
            attributes = json.loads(content)["attributes"]
            attributes.pop("work")
            content = json.dumps(attributes, sort_keys=True).encode()
        found[name] = hashlib.sha256(content).hexdigest()
    return found


def forked(act: Callable[[], None], *, kill_after: float | None = None) -> int:
    """Do something in a forked child; returns its exit code, negative for a signal."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            act()
            code = 0
        finally:
            os._exit(code)
    if kill_after is not None:
        time.sleep(kill_after)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def hook(out: Path, strike: Callable[[int], None]) -> None:
    """Call `strike` with the number of each file operation that changes the output folder."""
    count = 0
    below = str(out)

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
        if event == "open":
            flags = arguments[2]
            changes = isinstance(flags, int) and bool(flags & WRITES)
        else:
            changes = event in EVENTS
        if changes and str(arguments[0]).startswith(below):
            count += 1
            strike(count)

    sys.addaudithook(audit)


def measure(job: Job, folder: Path) -> None:
    """Run a job undisturbed: what it leaves, how many file operations it makes, how long it takes.

    The first time is in this process, which loads and compiles whatever the children need.
    """
    job.work(folder / "first")
    out, counted = folder / "reference", folder / "count"

    def count() -> None:
        def strike(number: int) -> None:
            counted.write_text(str(number))

        hook(out, strike)
        job.work(out)

    started = time.perf_counter()
    assert forked(count) == 0, f"{job.name} fails undisturbed"
    job.seconds = time.perf_counter() - started
    job.events = int(counted.read_text())
    job.expected = fingerprint(out)
    if fingerprint(folder / "first") != job.expected:
        raise SystemExit(f"{job.name} gives other bytes in a second folder")


def check(job: Job, out: Path, *, reports: bool = True) -> str:
    """Finish a disturbed job, and say how its results differ from the undisturbed ones."""
    code = forked(lambda: job.work(out))
    if code != 0:
        return f"the same command ended with {code}"
    found = fingerprint(out)
    differing = sorted(
        name
        for name in found.keys() | job.expected.keys()
        if found.get(name) != job.expected.get(name)
        and (reports or not name.endswith("report.html"))
    )
    return f"{len(differing)} files differ, first {differing[0]}" if differing else ""


def unreadable(out: Path) -> str:
    """Name of a file that stands under its final name and cannot be read; empty where none is."""
    import pyarrow.parquet as pq

    from cellquant.sim import open_run

    for path in sorted(out.rglob("*")):
        if any(part.endswith(".partial") for part in path.relative_to(out).parts):
            continue
        try:
            if path.suffix == ".json":
                json.loads(path.read_text("utf-8"))
            elif path.suffix == ".parquet":
                pq.read_metadata(path)
            elif path.suffix == ".zarr":
                run = open_run(path)
                assert len(run.position) == run.n_frames
        except Exception as error:  # whatever it is, it is what the campaign looks for
            return f"{path.name} cannot be read ({error})"
    return ""


def kill_at_event(job: Job, out: Path, rng: random.Random) -> str:
    last = rng.randint(1, job.events)

    def act() -> None:
        def strike(number: int) -> None:
            if number == last:
                os.kill(os.getpid(), signal.SIGKILL)

        hook(out, strike)
        job.work(out)

    forked(act)
    return f"operation {last} of {job.events}"


def kill_at_time(job: Job, out: Path, rng: random.Random) -> str:
    after = rng.uniform(0.0, job.seconds)
    forked(lambda: job.work(out), kill_after=after)
    return f"{after:.2f} s of {job.seconds:.2f} s"


def full_disk(job: Job, out: Path, rng: random.Random) -> str:
    last = rng.randint(1, job.events)

    def act() -> None:
        from cellquant.errors import InputError

        def strike(number: int) -> None:
            if number >= last:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out))

        hook(out, strike)
        try:
            outcome = job.work(out)
        except InputError:
            os._exit(2)
        os._exit(2 if outcome.failures and outcome.only_input_errors else 1)

    code = forked(act)
    return f"operation {last} of {job.events}" + ("" if code == 2 else f": EXIT CODE {code}")


def kill_command(job: Job, out: Path, rng: random.Random) -> str:
    """A real command with two workers; the fault takes a worker, the parent, or the group."""
    command = [sys.executable, "-m", "cellquant", job.name, str(job.file), "-o", str(out)]
    target = rng.choice(["a worker", "the parent", "all"])
    process = subprocess.Popen(
        [*command, "--workers", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not list(out.glob("*/**/.started")) and time.monotonic() < deadline:
        time.sleep(0.05)  # the workers have loaded everything and begin
    after = rng.uniform(0.0, 3.0)
    time.sleep(after)
    children = list(_children(process.pid))
    with contextlib.suppress(ProcessLookupError):
        if target == "all":
            os.killpg(process.pid, signal.SIGKILL)
        elif target == "the parent" or not children:
            process.kill()
        else:
            os.kill(rng.choice(children), signal.SIGKILL)
    code = process.wait(timeout=300)
    if target == "a worker" and code != 0:
        return f"{target}, {after:.2f} s: EXIT CODE {code}"
    return f"{target}, {after:.2f} s after the first task began"


def _children(pid: int) -> Iterator[int]:
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            words = stat.read_text().rpartition(")")[2].split()
            if int(words[1]) == pid:
                yield int(stat.parent.name)


FAULTS = {
    "kill at a file operation": kill_at_event,
    "kill at a time": kill_at_time,
    "full disk": full_disk,
    "command with two workers": kill_command,
}


def campaign(job: Job, counts: dict[str, int], seed: int, place: Path, results: Path) -> None:
    """Strike a job as often as `counts` says for each kind of fault; goes on where it stopped.

    The results are written after every fault, one row each.
    """
    rows = read_rows(results)
    present = {row["name"] for row in rows if row["code"] == code()}
    wanted = [
        (f"{job.name}, {kind}, seed {seed}, number {number}", kind)
        for number in range(max(counts.values()))  # all kinds in turn, so that a part is a sample
        for kind, count in counts.items()
        if number < count
    ]
    missing = [(name, kind) for name, kind in wanted if name not in present]
    if not missing:
        return
    place.mkdir()
    measure(job, place)
    for name, kind in missing:
        out = place / "out"
        shutil.rmtree(out, ignore_errors=True)
        where = FAULTS[kind](job, out, random.Random(name))
        whole = unreadable(out)
        # A real command draws its reports.
        different = check(job, out, reports=FAULTS[kind] is not kill_command)
        problems = [where if "EXIT CODE" in where else "", whole, different]
        problem = "; ".join(text for text in problems if text)
        row = {"name": name, "job": job.name, "fault": kind, "where": where, "code": code()}
        rows.append({**row, "problem": problem})
        results.write_text(json.dumps(rows, indent=1) + "\n")
        print(f"{name}, {where}: {problem or 'the same bytes'}", flush=True)


def code() -> str:
    """What decides whether a fault must be tried again."""
    from cellquant.fingerprint import code_digest

    return code_digest("batch")[:16] + code_digest("sweep")[:16]


def read_rows(results: Path) -> list[dict[str, Any]]:
    """Rows of earlier calls."""
    return list(json.loads(results.read_text())) if results.is_file() else []


def table(rows: list[dict[str, Any]]) -> str:
    """The table of docs/reliability.md."""
    lines = ["| job | fault | number | ended in the same bytes |", "|---|---|---|---|"]
    for job in dict.fromkeys(row["job"] for row in rows):
        for kind in FAULTS:
            mine = [row for row in rows if (row["job"], row["fault"]) == (job, kind)]
            if mine:
                good = sum(not row["problem"] for row in mine)
                lines.append(f"| `{job}` | {kind} | {len(mine)} | {good} |")
    good = sum(not row["problem"] for row in rows)
    lines.append(f"| both | all | {len(rows)} | {good} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--errors", type=int, default=24)
    parser.add_argument("--commands", type=int, default=12)
    parser.add_argument("--job", choices=("run", "sweep"), help="both when absent")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--results", type=Path, default=HERE / "results")
    parser.add_argument("--page", action="store_true", help="write the table of the page")
    arguments = parser.parse_args()
    counts = {
        "kill at a file operation": arguments.kills // 4,
        "kill at a time": arguments.kills // 4,
        "full disk": arguments.errors // 2,
        "command with two workers": arguments.commands // 2,
    }
    files = {job: arguments.results / f"fault_campaign_{job}.json" for job in ("run", "sweep")}
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None  # a kill needs no real disk
    with tempfile.TemporaryDirectory(dir=memory) as name:
        for job in jobs(Path(name)):
            if arguments.job in (None, job.name):
                place = Path(name) / job.name
                campaign(job, counts, arguments.seed, place, files[job.name])
    rows = [row for file in files.values() for row in read_rows(file)]
    text = table(rows)
    if arguments.page:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        after = rest.split(END)[1]
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")
    print(text)
    if any(row["problem"] for row in rows if row["code"] == code()):
        sys.exit("some faults did not end in the same bytes")


if __name__ == "__main__":
    main()
