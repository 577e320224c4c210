"""The report page: equal for equal input, complete, escaped, small, and true to the tables."""

import base64
import dataclasses
import io
import math
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellquant.compare.figures import Curve, Scale, draw_curves
from cellquant.compare.page import Page, Section, flatten, format_value, render_page, write_page
from cellquant.compare.pictures import MaskFrame, draw_contours, draw_masks, thin_paths
from cellquant.compare.report import command_lines, experiment_report
from cellquant.compare.results import Result, read_result, read_scalars, unit_text
from cellquant.compare.svg import THEME, compact_path
from cellquant.errors import InputError
from cellquant.tables import PHYSICAL, PIXEL, REDUCED
from compare_examples import Layer, Stack, make_layer


@pytest.fixture(scope="module")
def layer() -> Layer:
    return make_layer()


def report(layer: Layer, out: Path, **changes: object) -> str:
    arguments: dict[str, object] = {
        "title": "Untreated & <b>dense</b>",
        "tracks": layer.tracks,
        "observables": Result("movie", layer.summary, layer.tables, {}),
        "settings": layer.record,
        "out": out,
        "stack": Stack(layer.masks, 1.3, 10.0),
        "cells": layer.cells,
    }
    experiment_report(**(arguments | changes))  # type: ignore[arg-type]
    return out.read_text(encoding="utf-8")


def csv_of(page: str, name: str) -> pd.DataFrame:
    match = re.search(rf'download="{name}.csv" href="data:text/csv;charset=utf-8,([^"]*)"', page)
    assert match is not None
    return pd.read_csv(io.StringIO(unquote(match[1].replace("&#39;", "'"))))


def test_equal_input_gives_equal_bytes_whatever_the_timings(layer: Layer, tmp_path: Path) -> None:
    first = report(layer, tmp_path / "a.html")
    slower = layer.record | {"stages": [{"stage": "read", "wall_s": 99.0, "cpu_s": 9.0}]}
    assert report(layer, tmp_path / "b.html", settings=slower) == first


def test_every_figure_is_there_with_its_description_and_numbers(
    layer: Layer, tmp_path: Path
) -> None:
    page = report(layer, tmp_path / "r.html")
    names = re.findall(r'<figure id="([^"]*)"', page)
    assert names == [
        "segmented-frame", "density", "shape-index", "trajectories",
        "self-intermediate-scattering", "mean-square-displacement", "linking",
    ]  # fmt: skip
    for name in names:
        assert not csv_of(page, name).empty
    alts = re.findall(r'<svg role="img" aria-label="([^"]*)"', page)
    assert len(alts) == len(names) + 1
    assert all(len(alt) > 15 for alt in alts)


def test_numbers_behind_a_figure_are_those_of_the_table(layer: Layer, tmp_path: Path) -> None:
    page = report(layer, tmp_path / "r.html")
    data = csv_of(page, "self-intermediate-scattering")
    table = layer.tables["self_intermediate_scattering"]
    np.testing.assert_allclose(data["lag_time"], table["lag_time"], rtol=1e-5)
    np.testing.assert_allclose(data["value"], table["value"], rtol=1e-5)
    density = csv_of(page, "density")
    assert (density["n_cells"] == 81).all()
    np.testing.assert_allclose(density["count_per_area"], 81e6 / layer.tracks.area, rtol=1e-5)


def test_everything_from_outside_is_escaped(layer: Layer, tmp_path: Path) -> None:
    page = report(layer, tmp_path / "r.html")
    assert "Untreated &amp; &lt;b&gt;dense&lt;/b&gt;" in page
    assert "<b>dense" not in page
    assert "Frame 3 &amp; 4 are &lt;equal&gt;." in page
    assert "movie &lt;one&gt;/tracks.parquet" in page


def test_page_loads_nothing_and_stays_small(layer: Layer, tmp_path: Path) -> None:
    page = report(layer, tmp_path / "r.html")
    assert len(page) < 1_000_000
    addresses = re.findall(r'(?:src|href|action)="([^"]*)"', page)
    assert all(a.startswith(("#", "data:")) for a in addresses)
    assert "@import" not in page
    assert not re.search(r"url\((?!#)", page)
    assert not re.search(r"\d{4}-\d\d-\d\dT", page)
    ids = re.findall(r' id="([^"]*)"', page)
    assert len(ids) == len(set(ids))


def test_warnings_tell_faults_notes_and_what_was_not_measured(layer: Layer, tmp_path: Path) -> None:
    page = report(layer, tmp_path / "r.html")
    warnings = page[page.index('id="warnings"') : page.index('id="methods"')]
    assert "3 labels in several pieces" in warnings
    assert "hole" not in warnings
    assert "IDs are per frame." in warnings
    assert "Chi4 peak: fewer than 100 tracks" in warnings


def test_censored_relaxation_time_is_shown_as_a_bound(layer: Layer, tmp_path: Path) -> None:
    summary = layer.summary | {
        "tau_alpha": {"value": None, "std_error": None, "censored_at": 600.0}
    }
    page = report(
        layer, tmp_path / "r.html", observables=Result("movie", summary, layer.tables, {})
    )
    assert "&gt; 600" in page
    assert "so this is a bound" in page


def test_report_needs_neither_masks_nor_cells_nor_tables(layer: Layer, tmp_path: Path) -> None:
    bare = Result("movie", layer.summary, {}, {})
    page = report(layer, tmp_path / "r.html", observables=bare, stack=None, cells=None, settings={})
    assert 'id="segmented-frame"' not in page
    assert 'id="shape"' not in page
    assert "3.9200 ± 0.0060" in page


def test_recorded_image_is_shown_with_outlines(layer: Layer, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    raw = [rng.integers(0, 4000, layer.masks[0].shape).astype(np.uint16)] * len(layer.masks)
    page = report(layer, tmp_path / "r.html", raw=raw)
    assert "data:image/jpeg;base64," in page
    assert "Outlines of the cells on the recorded image" in page


def test_write_leaves_nothing_half_written(tmp_path: Path) -> None:
    page = Page("x", "y", (Section("a", "A"),))
    target = tmp_path / "taken" / "r.html"
    target.parent.write_text("a file, not a folder")
    with pytest.raises(InputError, match=r"cannot write .*taken"):
        write_page(page, target)
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


@given(st.text(max_size=60))
def test_any_text_is_safe_on_the_page(text: str) -> None:
    plain = render_page(Page("t", "l", (Section("a", "A", ("",), (text,)),)))
    point = plain[plain.index('<ul class="list">') : plain.index("</ul>")]
    tags = re.findall(r"<[^>]*>", point)
    assert set(tags) <= {
        '<ul class="list">', "<li>", "</li>", "<sub>", "</sub>", "<sup>", "</sup>",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (3.91234, 0.01312, "3.912 ± 0.013"),
        (40.0, 2.4, "40.0 ± 2.4"),
        (1234.5, 96.0, "1234 ± 96"),
        (12345.6, 996.0, "12\N{NARROW NO-BREAK SPACE}300 ± 1000"),
        (-0.5, None, "−0.5"),
        (0.0, 0.0, "0"),
        (17.0, None, "17"),
        (0.25, math.nan, "0.25"),
        (1000.0, None, "1000"),
        (-0.004, 0.16, "0.00 ± 0.16"),
        (1.5e-9, None, "1.50 × 10^{−9}"),
        (float("nan"), 1.0, "–"),
        (None, None, "–"),
    ],
)
def test_numbers_are_rounded_by_their_error(
    value: float | None, error: float | None, text: str
) -> None:
    assert format_value(value, error) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-4, 1e5))
def test_rounding_stays_within_a_twentieth_of_the_error(value: float, error: float) -> None:
    shown = format_value(value, error).replace("−", "-").replace("\N{NARROW NO-BREAK SPACE}", "")
    number = float(shown.split(" ± ")[0])
    assert abs(number - value) <= 0.051 * error


def test_settings_are_shown_in_full() -> None:
    shown = dict(flatten({"a": {"b": None, "c": [1, 2]}, "d": True, "e": "", "f": [{"x": 0.1}]}))
    assert shown == {"a.b": "not set", "a.c": "1, 2", "d": "yes", "e": "–", "f 1.x": "0.1"}


def test_commands_repeat_what_was_recorded() -> None:
    track = {
        "command": "track",
        "settings": {"pixel_size": 0.65, "frame_interval": 10.0, "length_unit": "um",
                     "divisions": False, "max_distance": 12.0},
        "inputs": {"my movie.tif": "00"},
    }  # fmt: skip
    assert command_lines(track) == [
        "cellquant track 'my movie.tif' -o RESULTS --pixel-size 0.65 --frame-interval 10.0 "
        "--max-distance 12.0 --no-divisions"
    ]
    assert command_lines({"command": "unheard-of"}) == []
    observed = {
        "command": "observe",
        "settings": {"source": "RUN.zarr", "only": ["msd", "speed"], "smoothing": 1,
                     "drift": False, "stride": 1, "lags": [1, 2], "core_range": [0.0, 0.3]},
    }  # fmt: skip
    assert command_lines(observed) == [
        "cellquant observe RUN.zarr -o RESULTS --only msd --only speed --smoothing 1 --no-drift "
        "--lags 1,2 --core-range 0 0.3"
    ]
    # A stack or scene is made by the file of the whole.
    assert command_lines({"command": "sweep", "settings": {"phi": 0.9}}) == [
        "cellquant sweep SWEEP.toml -o RESULTS"
    ]
    assert command_lines({"command": "run", "inputs": {"a.tif": "", "e.toml": ""}}) == [
        "cellquant run e.toml -o RESULTS"
    ]


def test_result_is_read_back_from_its_folder(layer: Layer, tmp_path: Path) -> None:
    result = read_result(layer.write(tmp_path / "out"))
    assert result.name == "out"
    assert [s.key for s in read_scalars(result)] == [
        s.key for s in read_scalars(Result("m", layer.summary, {}, {}))
    ]
    assert set(result.tables) == set(layer.tables)
    with pytest.raises(InputError, match=r"holds no summary\.json"):
        read_result(tmp_path)
    (tmp_path / "out" / "summary.json").write_text("{")
    with pytest.raises(InputError, match="not a summary of observables"):
        read_result(tmp_path / "out")


def test_units_are_written_from_exponents() -> None:
    assert unit_text((1, -1), PHYSICAL) == "µm/min"
    assert unit_text((-2, 0), REDUCED) == "1/L_{0}^{2}"
    assert unit_text((0, 0), REDUCED) == ""


def absolute(path: str) -> np.ndarray:
    """Follow relative path data, as an SVG viewer does."""
    place, out = np.zeros(2), []
    for command, text in re.findall(r"([MmLlz])([^MmLlz]*)", path):
        numbers = [float(v) for v in re.findall(r"-?\d*\.?\d+", text)]
        if command == "z":
            continue
        place = np.array(numbers) if command == "M" else place + numbers
        out.append(place)
    return np.array(out)


@given(
    st.lists(
        st.tuples(st.floats(-999, 999), st.floats(-999, 999)), min_size=2, max_size=30, unique=True
    )
)
def test_compact_paths_do_not_drift(points: list[tuple[float, float]]) -> None:
    data = "M " + " L ".join(f"{x!r} {y!r}" for x, y in points)
    drawn = absolute(compact_path(data))
    kept = np.round(np.array(points) * 10) / 10
    distinct = np.r_[True, (np.diff(kept, axis=0) != 0).any(axis=1)]
    np.testing.assert_allclose(drawn, kept[distinct], atol=1e-6)


def test_drawings_follow_the_theme() -> None:
    x = np.linspace(0.1, 10, 50)
    svg = draw_curves([Curve("a_{b}", x, x**2)], "n", x=Scale("x", log=True), y=Scale("F_{s}"))
    assert f"var(--series-0, {THEME['series-0'][0]})" in svg
    assert 'dy="0.30em"' in svg
    assert "DejaVu" not in svg
    bare = set(re.findall(r"(?<!, )#[0-9a-f]{6}", svg))
    assert not bare
    assert set(re.findall(r' id="([^"]*)"', svg)) >= set(re.findall(r'href="#([^"]*)"', svg))


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours as WCAG 2 defines it."""

    def luminance(colour: str) -> float:
        channel = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        linear = np.where(channel <= 0.04045, channel / 12.92, ((channel + 0.055) / 1.055) ** 2.4)
        return float(linear @ (0.2126, 0.7152, 0.0722))

    light, dark = sorted((luminance(one), luminance(other)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("mode", [0, 1], ids=["light", "dark"])
def test_colours_are_readable(mode: int) -> None:
    ground = THEME["ground"][mode]
    for role, pair in THEME.items():
        if role in {"ink", "muted"}:
            assert contrast(pair[mode], ground) >= 4.5
        elif role.startswith("series"):
            assert contrast(pair[mode], ground) >= 3.0


def decode(svg: str) -> np.ndarray:
    import cv2

    data = re.search(r"base64,([^\"]*)", svg)
    assert data is not None
    return cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_UNCHANGED)


def test_mask_picture_has_one_tone_per_cell_and_a_true_scale_bar() -> None:
    labels = np.zeros((60, 100), np.int64)
    labels[10:30, 10:40] = 70000
    labels[35:55, 50:90] = 2
    svg = draw_masks([MaskFrame(labels)], pixel_size=0.5, units=PHYSICAL)
    picture = decode(svg)
    assert picture.shape == (60, 100, 4)
    assert (picture[labels == 0][:, 3] == 0).all()
    assert (picture[15:25, 15:35, :3] == picture[20, 20, :3]).all()
    assert (picture[20, 20] != picture[45, 70]).any()
    bar = re.search(r'<rect y="[\d.]*" width="([\d.]*)"', svg)
    assert bar is not None
    assert "10 µm" in svg
    assert float(bar[1]) == pytest.approx(10 / 0.5)


def test_large_masks_become_a_small_picture_with_the_same_scale() -> None:
    labels = np.kron(np.arange(1, 401).reshape(20, 20), np.ones((100, 100), np.int32))
    svg = draw_masks([MaskFrame(labels)], pixel_size=1.0, units=PHYSICAL)
    assert max(decode(svg).shape) <= 900
    assert 'viewBox="0 0 2000 ' in svg


def test_cell_across_the_edge_of_the_box_is_drawn_on_both_sides() -> None:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    disc = 0.5 * np.stack([np.cos(angle), np.sin(angle)], -1)
    inside = draw_contours(disc[None] + (5, 5), (10.0, 10.0), units=REDUCED)
    corner = draw_contours(disc[None] + (30.1, -0.1), (10.0, 10.0), units=REDUCED)
    assert [inside.count(end) for end in ("z", "zM")] == [2, 0]  # one is in "font-size"
    assert corner.count("zM") == 3


def test_moments_of_a_simulated_layer_are_drawn_alike() -> None:
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    disc = 1.5 * np.stack([np.cos(angle), np.sin(angle)], -1)
    cells = np.array(
        [disc + np.array([3, 4]), disc + np.array([9.9, 8])]
    )  # the second crosses an edge
    svg = draw_contours(cells, (10.0, 10.0), units=REDUCED, title="now", earlier=[("then", cells)])
    assert re.findall(r'data-title="(\w+)"( display="none")?', svg) == [
        ("then", ' display="none"'), ("now", ""),
    ]  # fmt: skip
    picture = decode(svg)
    height, width = picture.shape[:2]
    fills = re.findall(r'fill="#([0-9a-f]{6})"', svg)

    def seen(x: float, y: float) -> str:
        blue, green, red, alpha = picture[int(y / 10 * height), int(x / 10 * width)]
        return f"{red:02x}{green:02x}{blue:02x}" if alpha else ""

    assert seen(3, 4) in fills
    assert seen(9.5, 8) == seen(0.5, 8) in fills
    assert seen(3, 4) != seen(9.5, 8)
    assert seen(6, 1) == ""


def test_a_cell_without_a_track_is_grey() -> None:
    labels = np.kron(np.array([[1, 2]]), np.ones((8, 8), np.int32))
    picture = decode(draw_masks([MaskFrame(labels, identities={1: 5})], pixel_size=1, units=PIXEL))
    ours, strange = picture[4, 3, :3].astype(int), picture[4, 12, :3].astype(int)
    assert np.ptp(strange) < 8 < np.ptp(ours)


def test_thinned_paths_keep_ends_and_a_bound(layer: Layer) -> None:
    table = layer.tracks.table
    thin = thin_paths(table, max_points=600)
    assert len(thin) <= 600
    ends = table.groupby("track_id")["frame"].agg(["min", "max"])
    kept = thin.groupby("track_id")["frame"].agg(["min", "max"])
    pd.testing.assert_frame_equal(kept, ends.loc[kept.index])
    pd.testing.assert_frame_equal(
        thin_paths(table), table[["track_id", "frame", "x", "y"]], check_dtype=False
    )


def test_paths_of_a_finely_sampled_layer_are_thinned_in_time_not_cut_off() -> None:
    """256 cells on a grid, 100 frames: all are shown; with a third of the room, some everywhere."""
    cell, frame = np.divmod(np.arange(25_600), 100)
    x, y = cell % 16 + 0.01 * frame, cell // 16
    table = pd.DataFrame({"track_id": cell + 1, "frame": frame, "x": x, "y": y})
    thin = thin_paths(table, max_points=2560)
    assert len(thin) <= 2560
    assert thin["track_id"].nunique() == 256
    few = thin_paths(table, max_points=800)
    quarters = few.groupby("track_id").first().eval("(x >= 8) + 2 * (y >= 8)").value_counts()
    assert len(quarters) == 4
    assert quarters.min() > 0.7 * quarters.max()


def test_tracks_of_one_frame_give_a_page_without_paths(layer: Layer, tmp_path: Path) -> None:
    table = layer.tracks.table[layer.tracks.table["frame"] == 0].reset_index(drop=True)
    page = report(layer, tmp_path / "r.html", tracks=dataclasses.replace(layer.tracks, table=table))
    assert 'id="trajectories"' not in page
    assert 'id="linking"' not in page
