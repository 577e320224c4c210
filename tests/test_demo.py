"""The demo: the embedded recording, and the closed loop whose truth is known."""

import html
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from cellquant.closed_loop import (
    QUANTITIES,
    SMOOTHED,
    STAGES,
    STEPS,
    close_loop,
    closed_loop_table,
)
from cellquant.demo import demo_scene, run_demo


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


def numbers_in(content: object) -> list[float]:
    """Every number of a JSON document."""
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list):
        return [number for item in content for number in numbers_in(item)]
    return [float(content)] if isinstance(content, int | float) else []


def test_every_number_of_the_tables_stands_in_a_file_beside_the_page(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    tables = re.findall(r"<table.*?</table>", page, flags=re.DOTALL)
    assert len(tables) == 3
    checked = 0
    for table, source in zip(
        tables, ("layer/closed_loop.json",) * 2 + ("recording/summary.json",), strict=True
    ):
        known = np.array(numbers_in(json.loads((demo / source).read_text())))
        # Shares are shown in per cent, densities per million square pixels.
        known = np.concatenate([known, 100 * known, 1e6 * known])
        for cell in re.findall(r'<td[^>]*class="number"[^>]*>(.*?)</td>', table, flags=re.DOTALL):
            text = html.unescape(re.sub("<.*?>", "", cell)).replace("\N{MINUS SIGN}", "-")
            for number in re.findall(r"-?\d+(?:\.\d+)?", text):
                digits = len(number.partition(".")[2])
                distance = np.abs(known - float(number)).min()
                assert distance <= 0.501 * 10.0**-digits, (source, text)
                checked += 1
    assert checked > 60


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
        row = table.loc[name]
        assert abs(row["measured"] - row["truth"]) < row["measured_std_error"], name
    steps = [name for name in table.columns if name.startswith("from_")]
    shares = np.prod(1 + table[steps].to_numpy(), axis=1) - 1
    assert shares == pytest.approx(table["error"].to_numpy(), abs=1e-12)
    assert (table["from_linking"].abs() < 1e-3).all()
    # Smoothing changes motion by more than the loop is off, but by the same on both sides.
    assert table.loc["mean speed", "smoothing_adds"] < -0.2
    assert table.loc["MSD at the relaxation time", "smoothing_adds"] < -0.02
    assert table.loc["relaxation time", "smoothing_adds"] > 0.01
    for name in ("MSD at the relaxation time", "relaxation time"):
        assert abs(table.loc[name, "error_smoothed"]) < 1.3 * LIMITS[name], name
    assert (table.loc[["mean shape index", "mean diameter"], "smoothing_adds"] == 0).all()


def test_the_closed_loop_recovers_the_truth(demo: Path) -> None:
    table = pd.DataFrame(json.loads((demo / "layer" / "closed_loop.json").read_text()))
    check_loop(table.set_index("quantity"))


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
@pytest.mark.parametrize("seed", [1, 3])
def test_a_larger_layer_is_recovered_closely(tmp_path: Path, seed: int) -> None:
    scene = demo_scene(seed).model_copy(update={"cells": 400, "duration": 420})
    check_loop(close_loop(scene, tmp_path).table.set_index("quantity"))
