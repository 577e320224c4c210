"""Masks to the table of cells: rules of repair, faults, units, occupied area."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage as ndi

from cellquant.errors import InputError
from cellquant.io import LabelStack, read_labels
from cellquant.io.faults import find_faults
from cellquant.segment import FAULTS, measure_cells, measure_frame, repair
from cellquant.segment.occupied import OccupiedArea
from cellquant.tables import CELL_COLUMNS, Cells

EIGHT = np.ones((3, 3), int)


def stack(*frames: np.ndarray, pixel_size: float = 0.5) -> LabelStack:
    return LabelStack.from_array(np.stack(frames), pixel_size=pixel_size, frame_interval=10)


def spread(body: np.ndarray) -> int:
    """n^2 times the spread of the pixels about their centroid, in integers."""
    y, x = np.nonzero(body)
    return int(len(x) * (x @ x + y @ y) - x.sum() ** 2 - y.sum() ** 2)


def square(row: int = 5, column: int = 5, label: int = 1, *, side: int = 10) -> np.ndarray:
    labels = np.zeros((40, 50), np.int64)
    labels[row : row + side, column : column + side] = label
    return labels


def check(cells: Cells) -> None:
    """What holds for every table of cells."""
    table = cells.table
    assert {name: str(dtype) for name, dtype in table.dtypes.items()} == dict(CELL_COLUMNS)
    assert list(table.index) == list(range(len(table)))
    assert table[["frame", "label"]].apply(tuple, axis=1).is_monotonic_increasing
    assert not table.duplicated(["frame", "label"]).any()
    assert set(cells.faults) == set(FAULTS)
    assert len(cells.occupied_area) == cells.n_frames


def test_units_and_columns() -> None:
    cells = measure_cells(stack(square(), square(column=8)))
    check(cells)
    first = cells.table.iloc[0]
    assert (first["x"], first["y"], first["area"]) == (9.5 * 0.5, 9.5 * 0.5, 100 * 0.25)
    assert first["shape_index"] == pytest.approx(first["perimeter"] / np.sqrt(first["area"]))
    assert first["aspect_ratio"] == pytest.approx(1)
    assert cells.units.length == "um"
    assert (cells.pixel_size, cells.frame_interval) == (0.5, 10)
    assert cells.field_of_view == (25, 20)
    pixels = measure_cells(LabelStack.from_array(np.stack([square()] * 1), units="pixel"))
    assert pixels.units.length == "px"
    assert pixels.table["area"].tolist() == [100]
    assert pixels.table["shape_index"][0] == first["shape_index"]


def test_without_calibration_nothing_is_measured() -> None:
    with pytest.raises(InputError):
        measure_cells(LabelStack.from_array(square()))


def test_progress_is_reported() -> None:
    calls: list[tuple[int, int]] = []
    measure_cells(stack(square(), square(9)), progress=lambda *done: calls.append(done))
    assert calls == [(1, 2), (2, 2)]


def test_fragments_and_specks_are_left_out() -> None:
    labels = square()
    labels[30:32, 30:33] = 1  # a fragment of six pixels
    labels[20, 20] = 1  # a speck
    labels[25, 40] = 6  # a label of one pixel
    labels[35:37, 5:8] = 7  # two parts of equal size: the first counts
    labels[35:37, 15:18] = 7
    given_labels = labels.copy()
    cells = measure_cells(stack(labels))
    check(cells)
    np.testing.assert_array_equal(labels, given_labels)
    assert cells.table["label"].tolist() == [1, 7]
    assert cells.table["area"].tolist() == [25, 1.5]
    assert cells.table["x"].tolist() == [4.75, 3.0]
    assert (cells.faults["fragments"], cells.faults["specks"]) == (2, 2)
    assert np.isnan(cells.table["shape_index"]).tolist() == [False, True]
    assert cells.faults["too_small_for_contour"] == 1


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_of_equal_parts_the_most_compact_is_the_cell(turns: int) -> None:
    """Whatever comes first in reading order: turning the image changes nothing."""
    labels = np.zeros((40, 50), np.int64)
    labels[5:8, 5:17] = 1  # 3 x 12
    labels[20:26, 30:36] = 1  # 6 x 6
    outlines = measure_frame(np.rot90(labels, turns)).outlines
    assert outlines.area.tolist() == [36]
    assert outlines.aspect_ratio[0] == pytest.approx(1)


def test_parts_that_touch_by_a_corner_are_one_cell() -> None:
    labels = square()
    labels[15:20, 15:20] = 1
    cells = measure_cells(stack(labels))
    assert cells.table["area"].tolist() == [125 / 4]
    assert cells.faults["fragments"] == 0


def test_left_out_parts_are_nobodys_neighbours() -> None:
    labels = square()
    labels[5:10, 15:18] = 2  # a fragment that touches cell 1
    labels[25:38, 25:38] = 2
    cells = measure_cells(stack(labels))
    assert cells.table["n_neighbours"].tolist() == [0, 0]


def test_holes_are_filled() -> None:
    labels = square()
    labels[8:11, 8:11] = 0
    cells = measure_cells(stack(labels))
    whole = measure_cells(stack(square()))
    assert cells.faults["holes"] == 1
    np.testing.assert_array_equal(cells.table, whole.table)


def test_a_cell_inside_another() -> None:
    labels = square()
    labels[8:12, 8:12] = 2
    cells = measure_cells(stack(labels))
    assert cells.table["area"].tolist() == [25, 4]
    assert (cells.faults["enclosed_cells"], cells.faults["holes"]) == (1, 1)
    assert cells.table["n_neighbours"].tolist() == [0, 1]


def test_repeated_and_empty_frames_are_missing_frames() -> None:
    renumbered = np.where(square() > 0, 9, 0)
    frames = [square(), square(), renumbered, np.zeros_like(square()), square(), square(9)]
    cells = measure_cells(stack(*frames))
    check(cells)
    assert cells.table["frame"].tolist() == [0, 4, 5]
    assert (cells.faults["duplicated_frames"], cells.faults["empty_frames"]) == (2, 1)
    assert cells.n_frames == 6


def test_a_frame_that_differs_by_one_pixel_is_measured() -> None:
    other = square()
    other[5, 15] = 1
    assert measure_cells(stack(square(), other)).table["frame"].tolist() == [0, 1]


def test_background_only_movie() -> None:
    cells = measure_cells(stack(np.zeros((9, 8), np.uint8), np.zeros((9, 8), np.uint8)))
    check(cells)
    assert cells.table.empty
    assert cells.faults["empty_frames"] == 2
    assert cells.faults["duplicated_frames"] == 0


def test_cells_that_all_touch_the_border() -> None:
    labels = np.arange(1, 5).reshape(2, 2).repeat(15, axis=0).repeat(20, axis=1)
    cells = measure_cells(stack(labels))
    assert cells.table["touches_border"].all()
    assert cells.faults["border_cells"] == 4
    assert cells.table["n_neighbours"].tolist() == [2, 2, 2, 2]
    assert np.isfinite(cells.table["shape_index"]).all()


@pytest.mark.parametrize("label", [1, 70_000, 4_000_000_000, 2**62])
def test_large_labels(label: int) -> None:
    cells = measure_cells(stack(square(label=label)))
    assert cells.table["label"].tolist() == [label]
    np.testing.assert_array_equal(
        cells.table.drop(columns="label"),
        measure_cells(stack(square())).table.drop(columns="label"),
    )


def test_frame_numbers_of_the_stack_are_kept() -> None:
    movie = stack(square(), square(9))
    movie.frame_numbers = (3, 7)
    assert measure_cells(movie).table["frame"].tolist() == [3, 7]


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(
        np.int64,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=14),
        elements=st.sampled_from([0, 0, 1, 1, 2]),
    )
)
def test_rules_by_brute_force(labels: np.ndarray) -> None:
    """Body of each label, filled holes and the edge of the image by scipy, label by label."""
    areas, borders, holes = {}, {}, 0
    for label in np.unique(labels[labels > 0]):
        parts, _ = ndi.label(labels == label, structure=EIGHT)
        sizes = np.bincount(parts.ravel())[1:]
        if sizes.max() == 1:
            continue
        # Least spread about the centroid among equals, then the first in reading order.
        largest = 1 + np.flatnonzero(sizes == sizes.max())
        body = min((parts == k for k in largest), key=spread)
        filled = ndi.binary_fill_holes(body)
        holes += ndi.label(filled & ~body)[1]
        areas[int(label)] = int(filled.sum())
        framed = np.pad(body, 1)
        framed[2:-2, 2:-2] = False
        borders[int(label)] = bool(framed.any())
    cells = measure_frame(labels)
    assert dict(zip(cells.label.tolist(), cells.outlines.area.tolist(), strict=True)) == areas
    touches = cells.outlines.touches_border.tolist()
    assert dict(zip(cells.label.tolist(), touches, strict=True)) == borders
    assert cells.faults["holes"] == holes
    left = repair(labels, find_faults(labels)).labels
    for label in np.unique(left[left > 0]):
        assert ndi.label(left == label, structure=EIGHT)[1] == 1
    assert np.all((left == labels) | (left == 0))


def test_equal_input_gives_equal_tables() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 5, (60, 60)).repeat(4, 0).repeat(4, 1) for _ in range(3)]
    first, second = measure_cells(stack(*frames)), measure_cells(stack(*frames))
    assert first.table.to_csv() == second.table.to_csv()


def dots(height: int, width: int, *, rows: slice, spacing: int = 20) -> np.ndarray:
    labels = np.zeros((height, width), np.int32)
    labels[rows][spacing // 2 :: spacing, spacing // 2 :: spacing] = 1
    grown = ndi.maximum_filter(labels, 5)
    return ndi.label(grown)[0].astype(np.int32)


def test_occupied_area_of_a_full_layer_is_the_field() -> None:
    labels = dots(300, 400, rows=slice(None))
    cells = measure_cells(stack(labels, np.roll(labels, 1, axis=0), pixel_size=2.0))
    assert cells.occupied_area.tolist() == [480_000, 480_000]


def test_masked_margins_are_not_occupied() -> None:
    labels = np.zeros((340, 400), np.int32)
    labels[40:] = dots(300, 400, rows=slice(None))
    area = OccupiedArea((340, 400))
    area.add(labels, labels.max())
    assert area.areas()[0] == pytest.approx(400 * 300, rel=0.04)


def test_voids_are_not_occupied() -> None:
    labels = dots(600, 600, rows=slice(300, 600))
    area = OccupiedArea(labels.shape)
    area.add(labels, labels.max())
    assert area.areas()[0] == pytest.approx(600 * 300, rel=0.03)
    hole = dots(600, 600, rows=slice(None))
    y, x = np.mgrid[:600, :600]
    hole[np.hypot(x - 300, y - 300) < 100] = 0
    area = OccupiedArea(hole.shape)
    area.add(hole, len(np.unique(hole)) - 1)
    area.add(np.zeros_like(hole), 0)
    assert area.areas()[0] == pytest.approx(600**2 - np.pi * 105**2, rel=0.02)
    assert area.areas()[1] == 600**2


def test_random_layers_keep_their_field() -> None:
    """Chance gaps between cells at random are no voids."""
    rng = np.random.default_rng(4)
    ratio = []
    for _ in range(20):
        labels = np.zeros((400, 400), np.int32)
        labels[tuple(rng.integers(0, 400, (2, 200)))] = 1
        area = OccupiedArea(labels.shape)
        area.add(labels, 200)
        ratio.append(area.areas()[0] / labels.size)
    assert np.mean(ratio) > 0.985


@pytest.mark.parametrize(
    ("name", "n_cells", "n_frames"),
    [("t98g_phase_contrast/masks.tif", 73, 3), ("hela_fluorescence/masks.tif", 140, 3)],
)
def test_recorded_masks(recordings, name: str, n_cells: int, n_frames: int) -> None:
    movie = read_labels(recordings / name, pixel_size=0.65, frame_interval=10)
    movie.frame_numbers = movie.frame_numbers[:n_frames]
    cells = measure_cells(movie)
    check(cells)
    assert len(cells.table) / n_frames == pytest.approx(n_cells, rel=0.15)
    inner = cells.table[~cells.table["touches_border"]]
    assert inner["shape_index"].min() > 3.5
