"""A whole study: nothing done twice, nothing lost, one bad stack does not stop the others."""

import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile

from cellquant.batch import run_experiment
from cellquant.errors import InputError
from examples import drifting_discs, shuffled

HEAD = """
[calibration]
pixel_size = 0.65
frame_interval = 10
"""
TRIAL = """
[[condition]]
name = "{condition}"
[[condition.trial]]
name = "{trial}"
stacks = ["{stacks}"]
"""


def write_stack(path: Path, *, seed: int, step: float = 0.5) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, shuffled(drifting_discs(26, step=(step, 0.3)), seed))


@pytest.fixture
def full_study(tmp_path: Path) -> Path:
    """Two conditions with a trial each, two stacks in the first."""
    for name, seed in (("a/one", 1), ("a/two", 2), ("b/three", 3)):
        write_stack(tmp_path / f"{name}.tif", seed=seed)
    text = HEAD
    text += TRIAL.format(condition="untreated", trial="day 1", stacks="a/*.tif")
    text += TRIAL.format(condition="inhibitor", trial="day 1", stacks="b/*.tif")
    (tmp_path / "experiment.toml").write_text(text)
    return tmp_path / "experiment.toml"


@pytest.fixture
def study(full_study: Path) -> Path:
    """The same with few observables."""
    full_study.write_text(full_study.read_text() + '\n[observables]\nonly = ["shape_index", "msd"]')
    return full_study


def tables(folder: Path) -> dict[str, bytes]:
    """Content of every table and summary, which must not depend on time, machine or workers."""
    kinds = ("*.parquet", "summary.json", "statistics.json", "stacks/**/report.html")
    files = sorted(path for kind in kinds for path in folder.rglob(kind))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_a_study_is_worked_through_once(full_study: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = run_experiment(full_study, out)
    assert (first.done, first.skipped, first.failures) == (3, 0, {})
    stacks = pd.read_parquet(out / "stacks.parquet")
    assert stacks["stack"].tolist() == ["one", "two", "three"]
    assert stacks["condition"].tolist() == ["untreated", "untreated", "inhibitor"]
    assert np.allclose(stacks["shape_index_mean"], 2 * np.sqrt(np.pi), rtol=0.015)
    assert (out / "report.html").is_file()
    by_bin = pd.read_parquet(out / "shape_by_bin.parquet")
    assert by_bin["stack"].tolist() == ["one", "two", "three"]
    assert np.allclose(by_bin["mean"], stacks["shape_index_mean"], rtol=1e-3)
    assert (by_bin["n_windows"] == 1).all()
    times = pd.read_parquet(out / "relaxation_times.parquet")
    assert {"condition", "trial", "bin_centre", "density", "tau_alpha", "censored"} <= set(times)
    statistics = json.loads((out / "statistics.json").read_text())
    assert {"mixed_model", "mann_whitney"} <= set(statistics)
    assert json.loads((out / "run.json").read_text())["counts"] == {"failed": 0, "stacks": 3}
    before = {path: path.stat().st_mtime_ns for path in (out / "stacks").rglob("*.parquet")}

    again = run_experiment(full_study, out)
    assert (again.done, again.skipped) == (0, 3)
    assert before == {p: p.stat().st_mtime_ns for p in (out / "stacks").rglob("*.parquet")}


def test_changed_input_and_configuration_are_worked_on_again(study: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_experiment(study, out)
    write_stack(tmp_path / "b" / "three.tif", seed=9, step=0.9)
    assert run_experiment(study, out).done == 1
    study.write_text(study.read_text().replace("pixel_size = 0.65", "pixel_size = 0.7"))
    assert run_experiment(study, out).done == 3


def test_other_observables_are_measured_on_the_tracks_that_are_there(
    full_study: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run_experiment(full_study, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("tracks.parquet")}
    full_study.write_text(full_study.read_text() + '\n[observables]\nonly = ["shape_index"]\n')
    assert run_experiment(full_study, out).done == 3
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("tracks.parquet")}
    assert not list((out / "stacks").rglob("msd.parquet"))
    run_experiment(full_study, tmp_path / "fresh")
    assert tables(out) == tables(tmp_path / "fresh")


def test_parts_of_a_job_array_and_the_gathering(study: Path, tmp_path: Path) -> None:
    """The lines of the script run here as SLURM would run them on its nodes."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "cellquant", "run", str(study), "-o", str(out)]
    emitted = subprocess.run(
        [*command, "--emit", "slurm-array", "--parts", "2"],
        capture_output=True,
        text=True,
        check=True,
    )
    script = out / "slurm_array.sh"
    assert emitted.stdout == f"submit with: sbatch {script}\n"
    assert "#SBATCH --array=0-1" in script.read_text()
    for part, stacks in (("1", 1), ("0", 3)):
        subprocess.run([str(script)], check=True, env={**os.environ, "SLURM_ARRAY_TASK_ID": part})
        assert len(list(out.glob("stacks/*/*/*/run.json"))) == stacks
        assert not (out / "run.json").exists()
    gathered = subprocess.run([str(script), "gather"], check=True, capture_output=True, text=True)
    assert "0 done, 3 finished before" in gathered.stdout
    run_experiment(study, tmp_path / "whole")
    assert tables(out) == tables(tmp_path / "whole")


@pytest.mark.parametrize("part", ["2/2", "-1/2", "1", "a/b", "0/0"])
def test_a_wrong_part_is_refused(study: Path, tmp_path: Path, part: str) -> None:
    with pytest.raises(InputError, match="--part takes I/N"):
        run_experiment(study, tmp_path / "out", part=part)


def test_one_bad_stack_does_not_stop_the_others(study: Path, tmp_path: Path) -> None:
    (tmp_path / "a" / "one.tif").write_bytes(b"no TIFF")
    outcome = run_experiment(study, tmp_path / "out")
    assert outcome.done == 2
    assert list(outcome.failures) == ["untreated/day 1/one"]
    assert "one.tif" in outcome.failures["untreated/day 1/one"]
    assert outcome.only_input_errors
    stacks = pd.read_parquet(tmp_path / "out" / "stacks.parquet")
    assert stacks["stack"].tolist() == ["two", "three"]

    write_stack(tmp_path / "a" / "one.tif", seed=1)
    mended = run_experiment(study, tmp_path / "out")
    assert (mended.done, mended.skipped, mended.failures) == (1, 2, {})


def test_workers_do_not_change_a_byte(full_study: Path, tmp_path: Path) -> None:
    run_experiment(full_study, tmp_path / "one")
    run_experiment(full_study, tmp_path / "two", workers=2)
    one, two = tables(tmp_path / "one"), tables(tmp_path / "two")
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def test_a_killed_run_is_finished_by_the_same_command(study: Path, tmp_path: Path) -> None:
    run_experiment(study, tmp_path / "whole")
    killed = tmp_path / "killed"
    # The process ends itself, without clean-up, when the second stack writes its tracks.
    code = f"""
        import os
        from cellquant import batch, tables
        write, calls = tables.Tracks.write, []
        def write_or_die(self, path):
            calls.append(path)
            write(self, path)
            if len(calls) == 2:
                os.kill(os.getpid(), 9)
        tables.Tracks.write = write_or_die
        batch.run_experiment({str(study)!r}, {str(killed)!r})
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False)
    assert done.returncode == -9
    assert not (killed / "run.json").exists()
    outcome = run_experiment(study, killed)
    assert (outcome.done, outcome.skipped) == (2, 1)
    assert tables(killed) == tables(tmp_path / "whole")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("a/*.tif", "c/*.tif"), "nothing matches 'c/\\*.tif'"),
        (('["a/*.tif"]', '["a/*.tif", "a/one.tif"]'), "two stacks named 'one'"),
        (('["b/*.tif"]', '["b/*.tif"]\nraw = ["a/*.tif"]'), "1 mask stacks and 2 raw movies"),
    ],
)
def test_a_wrong_experiment_is_refused_before_any_work(
    study: Path, tmp_path: Path, change: tuple[str, str], says: str
) -> None:
    study.write_text(study.read_text().replace(*change))
    with pytest.raises(InputError, match=says):
        run_experiment(study, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_command_reports_failures_by_its_exit_code(study: Path, tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "b")
    write_stack(tmp_path / "b" / "three.tif", seed=3)
    (tmp_path / "a" / "two.tif").write_bytes(b"")
    command = [sys.executable, "-m", "cellquant", "run", str(study), "-o", str(tmp_path / "out")]
    command += ["--progress", "json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    assert done.returncode == 2
    assert "stacks: 2 done, 0 finished before, 1 failed" in done.stdout
    assert "failed: untreated/day 1/two" in done.stdout
    events = [json.loads(line) for line in done.stderr.splitlines()]
    assert [event["event"] for event in events[:2]] == ["start", "progress"]
    moves = [event for event in events if event["event"] == "progress"]
    assert moves[-1].items() >= {"step": "stacks", "unit": "stacks", "done": 3, "total": 3}.items()
    assert moves[-1]["elapsed_s"] > 0
    assert moves[-1]["left_s"] == 0
