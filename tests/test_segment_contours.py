"""Contours, moments and neighbours of labelled cells against closed forms and other programs."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial import cKDTree
from skimage.measure import label as connected
from skimage.measure import regionprops_table

from cellquant.segment import FrameCells, measure_frame


def disc(radius: float, *, x: float = 0.3, y: float = 0.1) -> np.ndarray:
    half = int(radius) + 4
    down, across = np.mgrid[-half : half + 1, -half : half + 1]
    return (np.hypot(across - x, down - y) < radius).astype(np.int32)


def voronoi(n_cells: int, size: int, seed: int) -> np.ndarray:
    seeds = np.random.default_rng(seed).random((n_cells, 2)) * size
    pixels = np.stack(np.mgrid[:size, :size], axis=-1).reshape(-1, 2)
    return cKDTree(seeds).query(pixels)[1].reshape(size, size).astype(np.int32) + 1


def blobs(seed: int) -> np.ndarray:
    """Touching cells with background between some of them, lines too, of one part each."""
    labels = voronoi(12, 50, seed)
    centres = np.random.default_rng(seed).random((4, 2)) * 50
    down, across = np.mgrid[:50, :50]
    for y, x in centres:
        labels[np.hypot(across - x, down - y) < 6] = 0
    if seed % 2:
        labels[cut_by_lines(labels)] = 0
    for label in np.unique(labels)[1:]:
        parts = connected(labels == label, connectivity=2)
        sizes = np.bincount(parts.ravel())[1:]
        largest = 1 + np.flatnonzero(sizes == sizes.max())
        labels[(parts > 0) & ((parts != largest[0]) | (len(largest) > 1))] = 0
    return labels


def cut_by_lines(labels: np.ndarray) -> np.ndarray:
    """Pixels to the left of or above another label: lines of one pixel between all cells."""
    line = np.zeros(labels.shape, bool)
    line[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    line[:-1] |= labels[:-1] != labels[1:]
    return line


def hexagonal(radius: float, rng: np.random.Generator, *, line: float = 0.0) -> np.ndarray:
    """A hexagonal tissue at a random turn and offset, with background lines between the cells."""
    row, column = np.divmod(np.arange(400), 20)
    lattice = np.stack([row * np.sqrt(3) / 2, column + 0.5 * (row % 2)], axis=-1)
    spacing = radius * np.sqrt(2 * np.pi / np.sqrt(3))
    size = int(12 * spacing)
    turn = rng.random() * np.pi
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    seeds = spacing * (lattice - lattice.mean(axis=0)) @ rotation + size / 2 + rng.random(2)
    pixels = np.stack(np.mgrid[:size, :size], axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(seeds).query(pixels, k=2)
    # Distance to the edge shared with the second nearest seed.
    edge = (distance[:, 1] ** 2 - distance[:, 0] ** 2) / (2 * spacing)
    labels = np.where(edge < line / 2, 0, nearest[:, 0] + 1)
    return labels.reshape(size, size).astype(np.int32)


def measures(cells: FrameCells) -> np.ndarray:
    o = cells.outlines
    return np.stack([o.area, o.perimeter, o.aspect_ratio, o.n_neighbours, o.touches_border], axis=1)


@pytest.mark.parametrize("radius", [8, 10, 15, 20, 40])
def test_disc_has_the_perimeter_of_a_circle(radius: float) -> None:
    rng = np.random.default_rng(0)
    p = []
    for x, y in rng.random((40, 2)):
        outlines = measure_frame(disc(radius, x=x, y=y)).outlines
        p.append(outlines.perimeter[0] / np.sqrt(outlines.area[0]))
    assert np.mean(p) / (2 * np.sqrt(np.pi)) == pytest.approx(1, abs=0.01)


def test_area_has_no_bias() -> None:
    rng = np.random.default_rng(1)
    area = [measure_frame(disc(12, x=x, y=y)).outlines.area[0] for x, y in rng.random((400, 2))]
    assert np.mean(area) / (np.pi * 12**2) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("line", [0.0, 1.0, 2.0])
def test_bias_in_a_tissue_does_not_depend_on_the_size_of_cells(line: float) -> None:
    """A hexagonal tissue is exact within 0.3 % at every size, with and without background lines.

    Lines leave regular hexagons. A rough estimate of the length of a contour is not exact.
    """
    exact = 6 / np.sqrt(1.5 * np.sqrt(3))
    rng = np.random.default_rng(2)
    bias, rough = [], []
    for radius in (8, 9, 12, 16, 20):
        p, q = [], []
        for _ in range(3):
            labels = hexagonal(radius, rng, line=line)
            cells = measure_frame(labels)
            outlines, inner = cells.outlines, ~cells.outlines.touches_border
            inner &= outlines.area > 0.5 * np.median(outlines.area)
            p.append((outlines.perimeter / np.sqrt(outlines.area))[inner])
            table = regionprops_table(labels, properties=("label", "perimeter", "area"))
            inner = np.isin(table["label"], cells.label[inner])
            q.append((table["perimeter"] / np.sqrt(table["area"]))[inner])
        bias.append(np.concatenate(p).mean() / exact - 1)
        rough.append(np.concatenate(q).mean() / exact - 1)
    assert np.abs(bias).max() < 0.003
    assert np.ptp(bias) < 0.003
    assert np.ptp(rough) > 0.02  # the test can tell


@pytest.mark.parametrize("slope", [0.0, 0.1, 0.37, 0.5, 1.0])
def test_straight_edge_between_two_cells(slope: float) -> None:
    """The halves of a disc cut by a line: the border they share is a diameter."""
    down, across = np.mgrid[-40:41, -40:41]
    inside = np.hypot(across, down) < 35.2
    labels = np.where(down > slope * across + 0.3, 1, 2).astype(np.int32) * inside
    whole = measure_frame(inside.astype(np.int32)).outlines.perimeter[0]
    halves = measure_frame(labels).outlines.perimeter
    shared = (halves.sum() - whole) / 2
    assert shared == pytest.approx(70.4, rel=0.02)


def test_moments_agree_with_skimage() -> None:
    for seed in range(5):
        labels = voronoi(80, 200, seed)
        cells = measure_frame(labels)
        names = ("label", "area", "centroid", "axis_major_length", "axis_minor_length")
        table = regionprops_table(labels, properties=(*names, "orientation", "num_pixels"))
        single = np.isin(table["label"], cells.label)
        oracle = {name: values[single] for name, values in table.items()}
        o = cells.outlines
        whole = o.area == oracle["area"]  # labels of one part
        assert whole.mean() > 0.9
        np.testing.assert_allclose(o.x[whole], oracle["centroid-1"][whole], atol=1e-9)
        np.testing.assert_allclose(o.y[whole], oracle["centroid-0"][whole], atol=1e-9)
        # skimage takes pixels for points; a square adds 1/12 to each variance.
        major, minor = ((oracle[f"axis_{n}_length"] / 4) ** 2 + 1 / 12 for n in ("major", "minor"))
        ratio = np.sqrt(major / minor)
        np.testing.assert_allclose(o.aspect_ratio[whole], ratio[whole], rtol=1e-9)
        # skimage measures the angle from the row axis to the major axis.
        turned = o.orientation - (np.pi / 2 - oracle["orientation"])
        turned = (turned + np.pi / 2) % np.pi - np.pi / 2
        np.testing.assert_allclose(turned[whole], 0, atol=1e-9)


def test_orientation_points_along_the_long_axis() -> None:
    labels = np.zeros((40, 40), np.int32)
    labels[5:8, 5:35] = 1  # along x
    labels[10:38, 5:8] = 2  # along y
    for k in range(20):
        labels[15 + k, 12 + k : 16 + k] = 3  # x and y grow together
    orientation = measure_frame(labels).outlines.orientation
    np.testing.assert_allclose(orientation, [0, np.pi / 2, np.pi / 4], atol=0.1)
    assert orientation[1] == np.pi / 2


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_neighbours_by_brute_force(seed: int) -> None:
    """Labels met within three background pixels along rows and columns, found naively."""
    labels = blobs(seed)
    for label in np.unique(labels)[1:]:  # keep the first part of each
        parts = connected(labels == label, connectivity=2)
        labels[parts > 1] = 0
    expected: dict[int, set[int]] = {int(label): set() for label in np.unique(labels)[1:]}
    for lines in (labels, labels.T):
        for line in lines:
            seen = [(k, int(label)) for k, label in enumerate(line) if label]
            for (k, a), (m, b) in pairwise(seen):
                if a != b and m - k <= 4:
                    expected[a].add(b)
                    expected[b].add(a)
    cells = measure_frame(labels)
    assert cells.faults["fragments"] == cells.faults["specks"] == 0
    counts = dict(zip(cells.label.tolist(), cells.outlines.n_neighbours.tolist(), strict=True))
    assert counts == {label: len(others) for label, others in expected.items()}


@pytest.mark.parametrize(("gap", "n"), [(0, 1), (3, 1), (4, 0)])
def test_gap_between_neighbours(gap: int, n: int) -> None:
    labels = np.zeros((20, 30), np.int32)
    labels[5:15, 3:10] = 1
    labels[5:15, 10 + gap : 20 + gap] = 2
    assert measure_frame(labels).outlines.n_neighbours.tolist() == [n, n]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), turns=st.integers(1, 3), down=st.integers(0, 9))
def test_invariance(seed: int, turns: int, down: int) -> None:
    """Translation, quarter turns and new numbers change nothing but place and name."""
    labels = np.pad(blobs(seed), 2)
    before = measure_frame(labels)
    numbers = np.random.default_rng(seed).permutation(np.arange(1, 200))[: labels.max() + 1]
    renumbered = np.where(labels > 0, numbers[labels], 0)
    after = measure_frame(renumbered)
    order = np.argsort(numbers[before.label])
    assert after.label.tolist() == numbers[before.label][order].tolist()
    np.testing.assert_array_equal(measures(after), measures(before)[order])

    moved = measure_frame(np.pad(labels, ((down, 1), (1, 4))))
    np.testing.assert_allclose(measures(moved), measures(before), rtol=1e-12)
    np.testing.assert_allclose(moved.outlines.y - down, before.outlines.y, atol=1e-9)

    turned = measures(measure_frame(np.ascontiguousarray(np.rot90(labels, turns))))
    np.testing.assert_allclose(turned, measures(before), rtol=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    hnp.arrays(
        np.int64,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.sampled_from([0, 0, 1, 2, 4_000_000_000, 2**62]),
    )
)
def test_any_mask_gives_sane_measures(labels: np.ndarray) -> None:
    given_labels = labels.copy()
    cells = measure_frame(labels)
    np.testing.assert_array_equal(labels, given_labels)
    o = cells.outlines
    assert np.all(o.area >= 2)
    for label, area in zip(cells.label, o.area, strict=True):
        assert area <= labels.size
        assert label in labels
    coarse = np.isnan(o.perimeter)
    assert np.all(coarse[o.area < 10])
    assert cells.faults["too_small_for_contour"] == coarse.sum()
    # No contour is shorter than a circle of the same area less what a pixel rounds off, and none
    # is longer than the cracks.
    assert np.all(o.perimeter[~coarse] > 0.9 * 2 * np.sqrt(np.pi * o.area[~coarse]))
    assert np.all(o.perimeter[~coarse] <= 4 * o.area[~coarse] + 4)
    assert np.all(o.aspect_ratio >= 1)
    assert np.all((o.orientation > -np.pi / 2) & (o.orientation <= np.pi / 2))


def test_broken_masks_change_the_measure() -> None:
    """A notch and a tooth of a few pixels lengthen the contour: the estimator is not blind."""
    whole = disc(15)
    notched = whole.copy()
    notched[17:21, :15] = 0
    tooth = np.pad(whole, 12)
    tooth[30:33, 44:54] = 1
    before = measure_frame(whole).outlines.perimeter[0]
    assert measure_frame(notched).outlines.perimeter[0] > before + 8
    assert measure_frame(tooth).outlines.perimeter[0] > before + 8


def test_long_straight_edges_are_cheap_and_exact() -> None:
    labels = np.zeros((1200, 1300), np.int32)
    labels[100:1100, 100:1200] = 7
    outlines = measure_frame(labels).outlines
    assert outlines.perimeter[0] == pytest.approx(4200, abs=4)
    assert outlines.area[0] == 1_100_000


def test_cells_of_a_few_pixels() -> None:
    labels = np.zeros((30, 40), np.int64)
    labels[2, 2] = 1  # a speck
    labels[5, 5:7] = 2  # two pixels
    labels[8, 2:30] = 3  # one pixel wide
    labels[12:15, 5:8] = 4  # nine pixels
    labels[12:16, 12:16] = 5  # sixteen
    cells = measure_frame(labels)
    assert cells.label.tolist() == [2, 3, 4, 5]
    assert np.isnan(cells.outlines.perimeter).tolist() == [True, True, True, False]
    assert cells.faults["too_small_for_contour"] == 3
    assert cells.faults["specks"] == 1
    assert cells.outlines.area.tolist() == [2, 28, 9, 16]
    assert 10 < cells.outlines.perimeter[3] < 16


def test_cell_that_fills_the_image() -> None:
    outlines = measure_frame(np.full((30, 50), 3, np.int32)).outlines
    assert outlines.touches_border.tolist() == [True]
    assert outlines.area.tolist() == [1500]
    assert outlines.n_neighbours.tolist() == [0]
    assert outlines.perimeter[0] == pytest.approx(160, abs=3)
