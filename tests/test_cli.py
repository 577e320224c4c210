"""The program as users run it: exit codes, one-sentence errors, nothing half-written."""

import contextlib
import inspect
import io
import json
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile

from cellquant.cli import main
from cellquant.cli.movies import observe
from cellquant.config import ObservablesConfig
from cellquant.observables.settings import Settings
from examples import drifting_discs, shuffled

CALIBRATED = ("--pixel-size", "0.65", "--frame-interval", "10")
HEAVY = ("numba", "statsmodels", "matplotlib", "trackpy", "pandas", "numpy", "scipy", "cv2")


def program(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The program as a process of its own."""
    command = [sys.executable, "-m", "cellquant", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


def cellquant(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The same in this process, which has loaded everything already."""
    written, told, code = io.StringIO(), io.StringIO(), 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    command = ["cellquant", *map(str, arguments)]
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(written),
        contextlib.redirect_stderr(told),
    ):
        patch.setattr(sys, "argv", command)
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return subprocess.CompletedProcess(command, code, written.getvalue(), told.getvalue())


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    path = tmp_path / "masks.tif"
    tifffile.imwrite(
        path, shuffled(drifting_discs(30, side=4, step=(0.5, 0.2))), compression="zlib"
    )
    return path


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from cellquant.cli import app\n"
        "try:\n    app(['--help'])\n"
        "except SystemExit as stop:\n    assert stop.code == 0\n"
        f"loaded = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for command in ("inspect", "segment", "track", "evaluate", "observe", "export", "demo"):
        assert command in done.stdout


def test_version_and_unknown_option() -> None:
    from cellquant import __version__

    assert program("--version").stdout.strip() == f"cellquant {__version__}"
    wrong = program("track", "--no-such-option")
    assert wrong.returncode == 2
    assert "Traceback" not in wrong.stderr


def test_inspect_prints_what_is_there(movie: Path) -> None:
    text = cellquant("inspect", movie)
    assert text.returncode == 0, text.stderr
    found = json.loads(cellquant("inspect", movie, "--json").stdout)
    assert found["n_frames"] == 30
    assert found["cells_per_frame"]["min"] == found["cells_per_frame"]["max"] == 16
    assert found["calibration"] is None
    assert found["ids"] == "per frame"


def test_track_observe_export(movie: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    tracked = program("track", movie, "-o", out, *CALIBRATED, "--export", "ctc")
    assert tracked.returncode == 0, tracked.stderr
    tracks = pd.read_parquet(out / "tracks.parquet")
    assert tracks["track_id"].nunique() == 16
    assert set(tracks.groupby("track_id").size()) == {30}
    assert np.allclose(tracks.groupby("track_id")["x"].diff().mean(), 0.5 * 0.65, atol=0.02)
    assert tracks["time"].max() == pytest.approx(290.0)
    assert (out / "ctc" / "man_track.txt").is_file() or (out / "ctc" / "res_track.txt").is_file()
    manifest = json.loads((out / "run.json").read_text())
    assert manifest["settings"]["pixel_size"] == 0.65
    assert str(movie) in manifest["inputs"]

    observed = program("observe", out, "-o", tmp_path / "obs")
    assert observed.returncode == 0, observed.stderr
    summary = json.loads((tmp_path / "obs" / "summary.json").read_text())
    assert summary["length_unit"] == "um"
    assert summary["time_unit"] == "min"
    assert summary["n_tracks"] == 16
    # Discs of 7 px radius: the circle's shape index is 2 sqrt(pi).
    assert summary["shape_index"]["mean"] == pytest.approx(2 * np.sqrt(np.pi), rel=0.015)

    exported = program("export", out, "--to", "csv", "-o", tmp_path / "tracks.csv")
    assert exported.returncode == 0, exported.stderr
    assert (tmp_path / "tracks.csv").is_file()


def test_a_single_frame_is_enough_for_shapes(tmp_path: Path) -> None:
    path = tmp_path / "one.tif"
    tifffile.imwrite(path, drifting_discs(1)[0])
    done = cellquant("observe", path, "-o", tmp_path / "out", "--only", "shape_index", *CALIBRATED)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["shape_index"]["n"] == 4
    assert "tau_alpha" not in summary


def test_only_takes_several_names(movie: Path, tmp_path: Path) -> None:
    cellquant("track", movie, "-o", tmp_path / "t", *CALIBRATED)
    done = cellquant(
        "observe", tmp_path / "t", "--only", "shape_index", "msd", "-o", tmp_path / "out"
    )
    assert done.returncode == 0, done.stderr
    written = {p.name for p in (tmp_path / "out").iterdir()}
    assert {"summary.json", "shape_index.parquet", "msd.parquet", "run.json"} <= written
    assert "self_intermediate_scattering.parquet" not in written


def missing(folder: Path) -> Path:
    return folder / "absent.tif"


def not_a_tiff(folder: Path) -> Path:
    (folder / "text.tif").write_text("no TIFF at all")
    return folder / "text.tif"


def truncated(folder: Path) -> Path:
    tifffile.imwrite(folder / "whole.tif", drifting_discs())
    content = (folder / "whole.tif").read_bytes()
    (folder / "cut.tif").write_bytes(content[: len(content) // 2])
    return folder / "cut.tif"


def empty_file(folder: Path) -> Path:
    (folder / "empty.tif").write_bytes(b"")
    return folder / "empty.tif"


def empty_folder(folder: Path) -> Path:
    (folder / "frames").mkdir()
    return folder / "frames"


def rgb(folder: Path) -> Path:
    tifffile.imwrite(folder / "rgb.tif", np.zeros((32, 32, 3), np.uint8), photometric="rgb")
    return folder / "rgb.tif"


def fractions(folder: Path) -> Path:
    tifffile.imwrite(folder / "float.tif", drifting_discs().astype(np.float32) + 0.5)
    return folder / "float.tif"


def negative(folder: Path) -> Path:
    tifffile.imwrite(folder / "negative.tif", -drifting_discs().astype(np.int32))
    return folder / "negative.tif"


def all_background(folder: Path) -> Path:
    tifffile.imwrite(folder / "background.tif", np.zeros((5, 32, 32), np.uint16))
    return folder / "background.tif"


def different_sizes(folder: Path) -> Path:
    (folder / "sizes").mkdir()
    for frame, size in enumerate((64, 64, 48)):
        labels = np.zeros((size, size), np.uint16)
        labels[10:20, 10:20] = 1
        tifffile.imwrite(folder / "sizes" / f"t{frame}.tif", labels)
    return folder / "sizes"


def single_frame(folder: Path) -> Path:
    tifffile.imwrite(folder / "single.tif", drifting_discs(1)[0])
    return folder / "single.tif"


def a_pickle(folder: Path) -> Path:
    (folder / "masks_seg.npy").write_bytes(pickle.dumps({"masks": 1}))
    return folder / "masks_seg.npy"


WRONG_INPUT = [
    missing,
    not_a_tiff,
    truncated,
    empty_file,
    empty_folder,
    rgb,
    fractions,
    negative,
    all_background,
    different_sizes,
    single_frame,
    a_pickle,
]


def assert_one_sentence(done: subprocess.CompletedProcess[str], *, names: str) -> None:
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("cellquant: error:")]
    assert len(errors) == 1, done.stderr
    assert names in errors[0]
    assert errors[0].endswith(".")


@pytest.mark.parametrize("make", WRONG_INPUT, ids=lambda f: f.__name__)
def test_wrong_input_is_one_sentence(make: Callable[[Path], Path], tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    path = make(tmp_path / "in")
    done = cellquant("track", path, "-o", tmp_path / "out", *CALIBRATED)
    assert_one_sentence(done, names=path.name)
    assert not (tmp_path / "out").exists()
    assert {p.name for p in tmp_path.iterdir()} == {"in"}


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ((), "pixel"),
        (("--pixel-size", "0.65"), "frame"),
        (("--pixel-size", "0", "--frame-interval", "10"), "0"),
        (("--pixel-size", "nan", "--frame-interval", "10"), "nan"),
        (("--pixel-size", "0.65", "--frame-interval", "-1"), "-1"),
        ((*CALIBRATED, "--max-distance", "-3"), "-3"),
    ],
)
def test_wrong_calibration(
    movie: Path, tmp_path: Path, options: tuple[str, ...], names: str
) -> None:
    done = cellquant("track", movie, "-o", tmp_path / "out", *options)
    assert_one_sentence(done, names=names)
    assert not (tmp_path / "out").exists()


def test_units_pixel_needs_no_calibration(movie: Path, tmp_path: Path) -> None:
    done = cellquant("track", movie, "-o", tmp_path / "out", "--units", "pixel")
    assert done.returncode == 0, done.stderr
    assert "px" in done.stdout


def one_cell(movie: np.ndarray) -> np.ndarray:
    return np.where(movie == 1, movie, 0)


def empty_frame_inside(movie: np.ndarray) -> np.ndarray:
    movie[12] = 0
    return movie


def large_labels(movie: np.ndarray) -> np.ndarray:
    return np.where(movie > 0, movie.astype(np.uint32) + 70_000, 0).astype(np.uint32)


def all_at_the_border(movie: np.ndarray) -> np.ndarray:
    stripes = np.zeros_like(movie)
    for label, left in enumerate((0, 24, 48, 72), start=1):
        stripes[::2, :, left + 1 : left + 23] = label
        stripes[1::2, :, left + 1 : left + 22] = label
    return stripes


@pytest.mark.parametrize(
    ("make", "tracks"),
    [(one_cell, 1), (empty_frame_inside, 4), (large_labels, 4), (all_at_the_border, 4)],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_unusual_but_good_input(
    make: Callable[[np.ndarray], np.ndarray], tracks: int, tmp_path: Path
) -> None:
    path = tmp_path / "masks.tif"
    tifffile.imwrite(path, make(drifting_discs(30, step=(0.5, 0.2))))
    out = tmp_path / "out"
    done = cellquant("track", path, "-o", out, *CALIBRATED)
    assert done.returncode == 0, done.stderr
    table = pd.read_parquet(out / "tracks.parquet")
    assert table["track_id"].nunique() == tracks
    assert len(table) == tracks * (29 if make is empty_frame_inside else 30)
    if make is empty_frame_inside:
        # The gap is bridged, and the missing frame keeps its place in time.
        assert 12 not in set(table["frame"])
        assert "1 empty frame" in done.stdout
    if make is large_labels:
        assert set(table["label"]) == {70_001, 70_002, 70_003, 70_004}
    if make is all_at_the_border:
        assert table["touches_border"].all()
    observed = cellquant("observe", out, "-o", out)
    assert observed.returncode == 0, observed.stderr
    summary = json.loads((out / "summary.json").read_text())
    if make is all_at_the_border:
        assert summary["shape_index"]["mean"] is None
        assert summary["shape_index"]["reason"]


def test_unwritable_output(movie: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    done = cellquant("track", movie, "-o", tmp_path / "file", *CALIBRATED)
    assert_one_sentence(done, names="file")
    done = cellquant("track", movie, "-o", tmp_path / "file" / "below", *CALIBRATED)
    assert_one_sentence(done, names="file")
    assert (tmp_path / "file").read_text() == "in the way"


def test_equal_input_gives_byte_equal_tables(movie: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert cellquant("track", movie, "-o", tmp_path / name, *CALIBRATED).returncode == 0
    for table in ("tracks.parquet", "cells.parquet"):
        assert (tmp_path / "a" / table).read_bytes() == (tmp_path / "b" / table).read_bytes()


def test_shell_and_file_offer_every_option_of_the_observables() -> None:
    options = {field.name for field in fields(Settings)}
    assert set(ObservablesConfig.model_fields) == options - {"condition", "trial"} | {"only"}
    assert options - {"condition", "trial"} <= set(inspect.signature(observe).parameters)


def test_options_of_observe_reach_the_result(movie: Path, tmp_path: Path) -> None:
    tracks, out = tmp_path / "tracks", tmp_path / "out"
    assert cellquant("track", movie, "-o", tracks, *CALIBRATED).returncode == 0
    options = ("--only", "msd", "--no-drift", "--stride", "2", "--lags", "1,3")
    done = cellquant("observe", tracks, "-o", out, *options)
    assert done.returncode == 0, done.stderr
    assert pd.read_parquet(out / "msd.parquet")["lag_time"].tolist() == [10, 30]
    processing = json.loads((out / "summary.json").read_text())["processing"]
    assert processing["drift_removed"] is False
    assert processing["time_origin_stride"] == 2
    wrong = cellquant("observe", tracks, "-o", out, "--lags", "1;3")
    assert wrong.returncode == 2
    assert "--lags takes numbers separated by commas" in wrong.stderr


def test_config_init_prints_templates() -> None:
    for kind in ("experiment", "scene", "sweep"):
        done = cellquant("config", "init", kind)
        assert done.returncode == 0
        assert done.stdout.startswith("#")
