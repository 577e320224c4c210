"""Disks that are full or read-only, for real: one sentence, and the old results stay whole."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tifffile

from cellquant.batch import run_experiment
from cellquant.errors import InputError
from cellquant.io import read_labels
from cellquant.io.exports import export_tracks
from cellquant.pipeline import observe_source, track_movie
from cellquant.sim import Scene, open_run, render, simulate
from cellquant.sweep import run_sweep
from cellquant.tables import read_tracks
from examples import drifting_discs

REFUSED = r"No space left|Read-only|not a folder that may be"


class Disk:
    """A file system of two megabytes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.filler = folder / "filler"
        folder.mkdir()
        self._mount("-t", "tmpfs", "-o", "size=2m", "tmpfs")

    def _mount(self, *arguments: str) -> None:
        command = ["mount", *arguments, str(self.folder)]
        subprocess.run(command, check=True, capture_output=True)

    def fill(self) -> None:
        with open(self.filler, "wb", buffering=0) as stream:
            try:
                while True:
                    stream.write(bytes(1024))
            except OSError:
                pass

    def close(self) -> None:
        self._mount("-o", "remount,ro")

    def free(self) -> None:
        self._mount("-o", "remount,rw")
        self.filler.unlink(missing_ok=True)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    if sys.platform != "linux" or os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root may mount a small file system")
    folder = tmp_path / "disk"
    try:
        mounted = Disk(folder)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"cannot mount: {error.stderr!r}")
    yield mounted
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def contents(folder: Path) -> dict[str, bytes]:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "filler")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def movie(path: Path, frames: int) -> Path:
    tifffile.imwrite(path, drifting_discs(frames))
    return path


def track(disk: Path, beside: Path, again: bool) -> Any:
    masks = read_labels(movie(beside / "m.tif", 5 + again), pixel_size=0.5, frame_interval=10)
    return track_movie(masks, disk / "tracks")


def observe(disk: Path, beside: Path, again: bool) -> Any:
    if not (beside / "tracks").exists():
        track(beside, beside, False)
    only = ["shape_index", "msd"] if again else ["shape_index"]
    return observe_source(beside / "tracks", disk / "seen", only=only)


def export(disk: Path, beside: Path, again: bool) -> Any:
    if not (beside / "tracks").exists():
        track(beside, beside, False)
    to = "napari" if again else "csv"
    return export_tracks(read_tracks(beside / "tracks"), to, disk / "tracks.csv")


def simulated(disk: Path, beside: Path, again: bool) -> Any:
    scene = Scene(n_cells=4, phi=0.5, modes=3)
    return simulate(scene, duration=3.0, output=disk / f"{'b' if again else 'a'}.zarr")


def rendered(disk: Path, beside: Path, again: bool) -> Any:
    if not (beside / "a.zarr").exists():
        simulated(beside, beside, False)
    size = 0.5 if again else 0.6
    return render(
        open_run(beside / "a.zarr"),
        disk / "masks.tif",
        pixel_size=size,
        phase_contrast=disk / "grey.tif",
    )


@pytest.mark.parametrize("act", [track, observe, export, simulated, rendered])
@pytest.mark.parametrize("fault", [Disk.fill, Disk.close], ids=["full", "read-only"])
def test_old_results_stay_whole(
    act: Callable[[Path, Path, bool], Any],
    fault: Callable[[Disk], None],
    disk: Disk,
    tmp_path: Path,
) -> None:
    act(disk.folder, tmp_path, False)
    before = contents(disk.folder)
    assert before
    fault(disk)
    with pytest.raises(InputError, match=REFUSED):
        act(disk.folder, tmp_path, True)
    found = contents(disk.folder)
    assert {name: found[name] for name in before} == before
    disk.free()
    act(disk.folder, tmp_path, True)
    assert contents(disk.folder) != before
    assert not list(disk.folder.rglob("*.partial"))


@pytest.mark.parametrize("fault", [Disk.fill, Disk.close], ids=["full", "read-only"])
def test_a_study_and_a_sweep_go_on_when_there_is_space(
    fault: Callable[[Disk], None], disk: Disk, tmp_path: Path
) -> None:
    movie(tmp_path / "m.tif", 26)
    (tmp_path / "experiment.toml").write_text(
        "[calibration]\npixel_size = 0.65\nframe_interval = 10\n"
        '[observables]\nonly = ["shape_index"]\n'
        '[[condition]]\nname = "c"\n[[condition.trial]]\nname = "day"\nstacks = ["m.tif"]\n'
    )
    sweep = "seeds = [{}]\n[scene]\ncells = 4\nmodes = 3\ntransient = 0\nduration = 3\n"
    sweep += '[observables]\nonly = ["shape_index"]\n'
    (tmp_path / "s.toml").write_text(sweep.format("1"))
    jobs = {"run": (run_experiment, "experiment.toml"), "sweep": (run_sweep, "s.toml")}
    for name, (job, file) in jobs.items():
        assert job(tmp_path / file, disk.folder / name).failures == {}
    before = contents(disk.folder)
    fault(disk)
    (tmp_path / "s.toml").write_text(sweep.format("1, 2"))
    for name, (job, file) in jobs.items():
        with pytest.raises(InputError, match=REFUSED):
            job(tmp_path / file, disk.folder / name)
    found = contents(disk.folder)
    assert {name: found.get(name) for name in before} == before
    disk.free()
    for name, (job, file) in jobs.items():
        outcome = job(tmp_path / file, disk.folder / name)
        assert (outcome.failures, outcome.skipped) == ({}, 1)
    runs = json.loads((disk.folder / "sweep" / "run.json").read_text())
    assert runs["counts"] == {"failed": 0, "runs": 2}


def test_the_command_names_the_disk(disk: Disk, tmp_path: Path) -> None:
    masks = movie(tmp_path / "m.tif", 5)
    command = [sys.executable, "-m", "cellquant", "track", str(masks), "-o", str(disk.folder)]
    command += ["--pixel-size", "0.5", "--frame-interval", "10", "--progress", "json"]
    disk.fill()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    events = [json.loads(line) for line in done.stderr.splitlines()]
    assert [event["text"] for event in events if event["event"] == "error"] == [
        f"cannot write to {disk.folder}: No space left on device; free space or choose another "
        "output folder."
    ]
