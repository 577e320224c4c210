"""Repeating a recorded run: equal results, and every kind of difference told."""

import json
from pathlib import Path

import pandas as pd
import pytest
import tifffile

from cellquant.batch import run_experiment
from cellquant.config import SceneConfig
from cellquant.errors import InputError
from cellquant.io import read_labels
from cellquant.pipeline import observe_source, simulate_scene, track_movie
from cellquant.rerun import repeat
from cellquant.sweep import run_sweep
from examples import drifting_discs, shuffled


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    path = tmp_path / "masks.tif"
    tifffile.imwrite(path, shuffled(drifting_discs(26, step=(0.5, 0.3))))
    return path


@pytest.fixture
def tracked(movie: Path, tmp_path: Path) -> Path:
    out = tmp_path / "out"
    masks = read_labels(movie, pixel_size=0.65, frame_interval=10)
    options = {"max_distance": None, "divisions": True, "linker": "cues"}
    track_movie(masks, out, options=options)
    observe_source(out, out, only=["shape_index", "msd"])
    return out


def test_tracks_and_observables_are_repeated(tracked: Path) -> None:
    found = repeat(tracked)
    assert found.commands == ("track", "observe")
    assert (found.equal, found.differences, found.changes) == (True, (), ())
    assert found.compared == len(list(tracked.glob("*.parquet"))) + 1


def test_a_changed_result_and_a_changed_input_are_told(tracked: Path, movie: Path) -> None:
    summary = json.loads((tracked / "summary.json").read_text())
    summary["n_tracks"] += 1
    (tracked / "summary.json").write_text(json.dumps(summary))
    (tracked / "stray.parquet").write_bytes((tracked / "msd.parquet").read_bytes())
    found = repeat(tracked)
    assert not found.equal
    told = "; ".join(found.differences)
    assert "summary.json: n_tracks is 4, not 5" in told
    assert "stray.parquet is only in" in told

    tifffile.imwrite(movie, shuffled(drifting_discs(26, step=(0.8, 0.3))))
    found = repeat(tracked)
    assert any("masks.tif (SHA-256" in text for text in found.changes)
    assert any("tracks.parquet: column x (" in text for text in found.differences)
    movie.unlink()
    with pytest.raises(InputError, match=r"masks\.tif is gone"):
        repeat(tracked)


def test_a_study_and_one_of_its_stacks(movie: Path, tmp_path: Path) -> None:
    (tmp_path / "e.toml").write_text(
        "[calibration]\npixel_size = 0.65\nframe_interval = 10\n"
        '[observables]\nonly = ["shape_index"]\n[[condition]]\nname = "<script>alert(1)<"\n'
        '[[condition.trial]]\nname = "day 1"\nstacks = ["masks.tif"]\n'
    )
    out = tmp_path / "study"
    assert run_experiment(tmp_path / "e.toml", out).failures == {}
    for page in out.rglob("report.html"):
        assert "<script>alert" not in page.read_text()
        assert "&lt;script&gt;alert" in page.read_text()
    whole = repeat(out)
    assert (whole.commands, whole.equal) == (("run",), True)
    one = repeat(out / "stacks" / "<script>alert(1)<" / "day 1" / "masks", tmp_path / "again")
    assert (one.equal, one.compared) == (True, 5)
    assert pd.read_parquet(tmp_path / "again" / "tracks.parquet")["track_id"].nunique() == 4


def test_a_sweep_one_of_its_runs_and_a_simulation(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        "[scene]\ncells = 9\ntransient = 1\nduration = 10\n[grid]\nphi = [0.9, 0.95]\n"
        '[observables]\nonly = ["shape_index"]\n'
    )
    out = tmp_path / "sweep"
    run_sweep(tmp_path / "s.toml", out)
    assert repeat(out).equal
    run = sorted((out / "runs").iterdir())[0]
    assert repeat(run).equal
    assert repeat(run / "run.zarr").commands == ("simulate",)
    config = SceneConfig(cells=9, transient=1, duration=4)
    simulated = simulate_scene(config, tmp_path / "r.zarr")
    assert repeat(tmp_path / "r.zarr").equal
    simulated._group["position"][2, 3, 0] += 1e-9
    found = repeat(tmp_path / "r.zarr")
    assert found.differences[0].startswith("position: 1 of 90 values, by up to")


def test_what_cannot_be_repeated_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        repeat(tmp_path)
    (tmp_path / "run.json").write_text('{"command": "demo", "settings": {}}')
    with pytest.raises(InputError, match="records 'demo'"):
        repeat(tmp_path)
    (tmp_path / "run.json").write_text("[1]")
    with pytest.raises(InputError, match="no record of a run"):
        repeat(tmp_path)
