"""The demo: the embedded recording, and the closed loop whose truth is known."""

import html
import io
import json
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import cKDTree

import cellquant as cq
from cellquant.closed_loop import (
    LENGTH,
    QUANTITIES,
    SMOOTHED,
    STAGES,
    STEPS,
    close_loop,
    closed_loop_table,
)
from cellquant.demo import demo_scene, run_demo
from cellquant.tables import read_tracks


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_demo(tmp_path_factory.mktemp("demo") / "out", seed=2).parent


def test_the_demo_writes_one_page_without_links_to_the_network(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    assert len(page) < 3_000_000
    assert page.count("<svg") >= 8
    assert not re.findall(r"(?:src|href)=[\"']https?://", page)
    assert "closed loop" in page


def test_what_the_demo_says_of_the_recording_is_true(demo: Path) -> None:
    inspection = json.loads((demo / "recording" / "inspection.json").read_text())
    assert (inspection["n_frames"], inspection["ids"]) == (37, "per frame")
    summary = json.loads((demo / "recording" / "summary.json").read_text())
    assert (summary["length_unit"], summary["time_unit"]) == ("px", "frame")
    cells = pd.read_parquet(demo / "recording" / "cells.parquet")
    assert cells.groupby("frame").size().between(55, 70).all()
    assert (
        summary["n_tracks"]
        == pd.read_parquet(demo / "recording" / "tracks.parquet")["track_id"].nunique()
    )


def test_names_on_the_page_are_unique(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    for names in (re.findall(r' id="([^"]*)"', page), re.findall(r' download="([^"]*)"', page)):
        assert len(names) > 8
        assert len(names) == len(set(names))


def numbers_in(content: object) -> list[float]:
    """Every number of a JSON document, those within its texts included."""
    if isinstance(content, dict):
        content = [*content, *content.values()]
    if isinstance(content, list):
        return [number for item in content for number in numbers_in(item)]
    if isinstance(content, str):
        return [float(text) for text in re.findall(NUMBER, content)]
    return [float(content)] if isinstance(content, int | float) else []


NUMBER = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"
FILES = (
    "run.json",
    "layer/closed_loop.json",
    "layer/run.zarr/zarr.json",
    "layer/found/summary.json",
    "layer/truth/summary.json",
    "recording/inspection.json",
    "recording/run.json",
    "recording/summary.json",
)
# What the texts say of shapes, rules and drawings, not of these layers.
GENERAL = {
    "3.54 for a disc", "3.72 for a regular hexagon", "The area under each curve is 1",
    "the area under the curve is 1", "falls from 1 to 0", "The dotted line is 1/e",
    "the line 1/e", "reaches 1/e", "τα) = 1/e", "q = 2π/d", "⟨√(4A/π)⟩", "MSD/(4t)", "exp(−r2/σ2)",
    "third standardised moment", "A square of 8 by 8 cell diameters", "one half",
    "below 1/e", "drawing counts from 1", "nowhere exceeds 1", "phi0", "t0", "v0", "L0", "σ2", "d2",
    "χ4", "α2", "px2", "T98G", "SHA-256",
}  # fmt: skip


def visible_lines(page: str) -> list[str]:
    """The text of the page, one piece a line, without drawings, downloads and scripts."""
    body = page[page.index("<body") : page.index("<script", page.index("<body"))]
    body = re.sub(r"<svg.*?</svg>", "", body, flags=re.DOTALL)
    body = re.sub(r"</(?:p|li|h\d|tr|dt|dd|div|td|th|span)>", "\n", body)
    text = html.unescape(re.sub(r"<[^>]*>", "", body)).replace("\N{MINUS SIGN}", "-")
    return [line.strip() for line in text.splitlines() if line.strip()]


def in_tables_of(demo: Path, tracks: pd.DataFrame) -> list[float]:
    """What the captions count or average over the tables of the recording."""
    cells = pd.read_parquet(demo / "recording" / "cells.parquet")
    steps = tracks.groupby("track_id")[["frame", "x", "y"]].diff().query("frame == 1")
    step = float(np.median(np.hypot(steps["x"], steps["y"])))
    apart = float(np.median(np.concatenate([
        cKDTree(frame[["x", "y"]]).query(frame[["x", "y"]], k=2)[0][:, 1]
        for _, frame in tracks.groupby("frame")
    ])))  # fmt: skip
    return [*cells.groupby("frame").size().astype(float), step, apart, step / apart]


def test_every_number_of_the_text_stands_in_a_file_beside_the_page(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    known = np.array([n for f in FILES for n in numbers_in(json.loads((demo / f).read_text()))])
    known = np.unique(np.concatenate([known, -known]))
    # Shares are shown in per cent, densities per million square pixels.
    known = np.concatenate([known, 100 * known, 1e6 * known])
    tracks = read_tracks(demo / "recording" / "tracks.parquet")
    made = numbers_in(json.loads(json.dumps(dict(tracks.provenance))))
    known = np.concatenate([known, made, in_tables_of(demo, tracks.table)])
    missing = []
    checked = 0
    for line in visible_lines(page):
        for phrase in GENERAL:
            line = line.replace(phrase, "")
        for number in re.findall(NUMBER, line.replace("\N{NARROW NO-BREAK SPACE}", "")):
            digits = len(number.partition("e")[0].partition(".")[2])
            checked += 1
            if np.abs(known - float(number)).min() > 0.501 * 10.0**-digits:
                missing.append((number, line[:120]))
    assert missing == []
    assert checked > 200


def test_every_number_behind_a_drawing_stands_in_a_table_beside_the_page(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    numbers = {
        name: pd.read_csv(io.StringIO(unquote(html.unescape(data))))
        for name, data in re.findall(
            r'download="([^"]*)\.csv" href="data:text/csv[^,]*,([^"]*)"', page
        )
    }
    sides = {"Experiment: measured on masks": "found", "Simulation: known truth": "truth"}
    summaries = {
        stage: json.loads((demo / "layer" / stage / "summary.json").read_text())
        for stage in sides.values()
    }

    def same(shown: pd.Series, told: pd.Series) -> None:
        np.testing.assert_allclose(shown, told, rtol=1e-5)

    # The closed loop: each side's table, in units of its own relaxation time and diameter.
    for name, file, column, axis in (
        ("loop-shape-index", "shape_index", "shape_index", None),
        ("loop-self-intermediate-scattering", "self_intermediate_scattering", "lag_time", "tau"),
        ("loop-mean-square-displacement", "msd", "lag_time", "tau"),
        ("loop-van-hove", "van_hove", "r", None),
    ):
        for side, stage in sides.items():
            shown = numbers[name][numbers[name]["result"] == side]
            table = pd.read_parquet(demo / "layer" / stage / f"{file}.parquet")
            if "scope" in table:
                table = table[table["scope"] == "all"]
            tau = summaries[stage]["tau_alpha"]["value"] if axis else 1.0
            d = summaries[stage]["wave_number"]["mean_diameter"] if file == "msd" else 1.0
            shown = shown.set_index(shown.columns[1]).dropna(subset=["value"])
            table = table.set_index(table[column] / tau)
            assert len(shown) > 5
            places = np.abs(table.index.to_numpy()[None] - shown.index.to_numpy()[:, None])
            row = table.iloc[places.argmin(axis=1)]
            assert (places.min(axis=1) <= 1e-5 * np.abs(shown.index)).all()
            same(shown["value"], row["value"] / d**2)
            same(shown["std_error"].fillna(0), (row["std_error"] / d**2).fillna(0))
    run = cq.open_run(demo / "layer" / "run.zarr")
    truth = run.to_tracks().table
    found = read_tracks(demo / "layer" / "found" / "tracks.parquet").table
    for drawing, (stage, table) in enumerate((("found", found), ("truth", truth)), start=1):
        d = summaries[stage]["wave_number"]["mean_diameter"]
        for name in ("loop-paths-whole", "loop-paths-close"):
            shown = numbers[name][numbers[name]["drawing"] == drawing]
            told = shown.merge(table, on=["track_id", "frame"], suffixes=("", "_told"))
            assert len(told) == len(shown) > 100
            for axis, side in zip("xy", run.box, strict=True):
                away = told[axis] - told[f"{axis}_told"] / d
                # Both are drawn in one period of the layer.
                period = side / d * (LENGTH if stage == "found" else 1)
                away -= np.round(away / period) * period
                np.testing.assert_allclose(away, 0, atol=6e-4)
    # The recording: its own tables as they are.
    folder = demo / "recording"
    for name, file in (
        ("self-intermediate-scattering", "self_intermediate_scattering"),
        ("mean-square-displacement", "msd"),
    ):
        table = pd.read_parquet(folder / f"{file}.parquet")
        if "scope" in table:
            table = table[table["scope"] == "all"]
        for column in ("lag_time", "value", "std_error"):
            same(numbers[name][column], table[column].reset_index(drop=True))
    tracks = read_tracks(folder / "tracks.parquet").table
    for name in ("trajectories", "segmented-frame"):
        told = numbers[name].merge(tracks, on=["track_id", "frame"], suffixes=("", "_told"))
        assert len(told) > 40
        same(told["x"], told["x_told"])
    cells = tracks.groupby("frame").size()
    assert numbers["density"]["n_cells"].tolist() == cells.tolist()


LIMITS = {
    "mean shape index": 0.003,
    "mean diameter": 0.01,
    "mean speed": 0.02,
    "MSD at the relaxation time": 0.03,
    "relaxation time": 0.05,
}


def check_loop(table: pd.DataFrame) -> None:
    """The limits within which a layer must be recovered at 15 px radius, 10 frames per tau."""
    for name, limit in LIMITS.items():
        assert abs(table.loc[name, "error"]) < limit, name
    for name in ("van Hove core σ²", "van Hove tail ξ"):
        assert abs(table.loc[name, "error_in_std_errors"]) < 1, name
    told = (table["measured"] - table["truth"]) / table["measured_std_error"]
    assert table["error_in_std_errors"].to_numpy() == pytest.approx(told.to_numpy(), rel=1e-12)
    steps = [name for name in table.columns if name.startswith("from_")]
    shares = np.prod(1 + table[steps].to_numpy(), axis=1) - 1
    assert shares == pytest.approx(table["error"].to_numpy(), abs=1e-12)
    assert (table["from_linking"].abs() < 1e-3).all()
    # Smoothing changes motion by more than the loop is off, but by the same on both sides.
    assert table.loc["mean speed", "smoothing_adds"] < -0.2
    assert table.loc["MSD at the relaxation time", "smoothing_adds"] < -0.02
    assert table.loc["relaxation time", "smoothing_adds"] > 0.01
    for name in ("MSD at the relaxation time", "relaxation time"):
        shift = table.loc[name, "error_smoothed"] - table.loc[name, "error"]
        assert abs(shift) < 0.02, name
    assert (table.loc[["mean shape index", "mean diameter"], "smoothing_adds"] == 0).all()


def test_the_closed_loop_recovers_the_truth(demo: Path) -> None:
    table = pd.DataFrame(json.loads((demo / "layer" / "closed_loop.json").read_text()))
    check_loop(table.set_index("quantity"))


def test_every_cell_of_the_layer_is_followed_once(demo: Path) -> None:
    cell = {  # of the run, by frame and label
        (frame, label): cell
        for frame, label, cell in pd.read_parquet(
            demo / "layer" / "masks_truth" / "tracks.parquet", columns=["frame", "label", "cell"]
        ).itertuples(index=False)
    }
    tracks = read_tracks(demo / "layer" / "found" / "tracks.parquet").table
    first = tracks[tracks["frame"] == 0]
    seen = sorted(cell[key] for key in zip(first["frame"], first["label"], strict=True))
    assert seen == list(range(demo_scene(2).cells))
    # Nearly all of them are seen to the end.
    assert (tracks["frame"] == tracks["frame"].max()).sum() > 0.95 * len(seen)


def test_the_table_splits_the_error() -> None:
    stages = {
        stage: {quantity.label: (value, 0.1) for quantity in QUANTITIES}
        for stage, value in zip(
            [*STAGES, *SMOOTHED], (1.0, 2.0, 3.0, 6.0, 3.0, 4.0, 2.0), strict=True
        )
    }
    stages["found"]["relaxation time"] = (float("nan"), float("nan"))
    table = closed_loop_table(stages).set_index("quantity")
    row = table.loc["mean diameter"]
    assert row[["truth", "measured", "error"]].tolist() == [1.0, 3.0, 2.0]
    assert row[[f"from_{step.replace(' ', '_')}" for step in STEPS.values()]].tolist() == [
        1.0, 0.5, 1.0, -0.5,
    ]  # fmt: skip
    assert row[["smoothing_adds", "error_smoothed"]].tolist() == [2 / 3 - 1, -0.5]
    # The speed is the displacement over one frame interval: sampling cannot change it.
    assert table.loc["mean speed", ["truth", "from_frame_interval", "error"]].tolist() == [
        2,
        0,
        0.5,
    ]
    assert np.isnan(table.loc["relaxation time", "error"])
    assert np.isnan(table.loc["relaxation time", "from_linking"])
    assert table.loc["relaxation time", "from_pixels"] == 1.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", [1, 3, 4, 5, 6])
def test_other_layers_are_recovered(tmp_path: Path, seed: int) -> None:
    check_loop(close_loop(demo_scene(seed), tmp_path).table.set_index("quantity"))
