"""What inspection says of label masks, against naive oracles and the real recordings."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage

from cellquant.io import LabelStack, inspect_labels, read_labels
from cellquant.io.faults import find_faults, same_content

EIGHT = np.ones((3, 3))


def inspect_array(array: np.ndarray, **options: object) -> dict:
    found = inspect_labels(LabelStack.from_array(array, **options))  # type: ignore[arg-type]
    assert found.as_text()
    return json.loads(json.dumps(found.as_dict(), allow_nan=False))


def naive_faults(labels: np.ndarray) -> dict[str, object]:
    """Label by label with scipy: parts, and holes of the largest part."""
    counts = {"fragments": 0, "specks": 0, "holes": 0, "border_cells": 0}
    fragmented = []
    for label in np.unique(labels[labels != 0]):
        parts, _ = ndimage.label(labels == label, EIGHT)
        sizes = np.bincount(parts.ravel())[1:]
        body = parts == 1 + np.argmax(sizes)
        extra = np.count_nonzero(sizes > 1) - (sizes.max() > 1)
        counts["fragments"] += extra
        counts["specks"] += np.count_nonzero(sizes == 1)
        if extra:
            fragmented.append(label)
        if sizes.max() > 1:
            counts["holes"] += ndimage.label(~np.pad(body, 1))[1] - 1
        edge = np.concatenate([body[0], body[-1], body[:, 0], body[:, -1]])
        counts["border_cells"] += bool(edge.any())
    return {**counts, "fragmented": fragmented}


@settings(deadline=None)
@given(
    hnp.arrays(
        st.sampled_from([np.int32, np.int64]),
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.integers(0, 3),
    )
)
def test_faults_equal_a_naive_count(labels: np.ndarray) -> None:
    found = find_faults(labels)
    expected = naive_faults(labels)
    assert {name: getattr(found, name) for name in expected if name != "fragmented"} == {
        name: count for name, count in expected.items() if name != "fragmented"
    }
    assert found.fragmented.tolist() == expected["fragmented"]
    assert found.label.tolist() == np.unique(labels[labels != 0]).tolist()
    for label, area, x, y in zip(found.label, found.area, found.x, found.y, strict=True):
        rows, columns = np.nonzero(labels == label)
        assert area == len(rows)
        np.testing.assert_allclose((x, y), (columns.mean(), rows.mean()), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("label", [1, 65_536, 2**31, 2**62])
def test_large_labels(label: int) -> None:
    labels = np.zeros((5, 6), np.int64)
    labels[1:3, 1:3] = label
    found = find_faults(labels)
    assert found.label.tolist() == [label]
    assert (found.x[0], found.y[0]) == (1.5, 1.5)


def test_each_fault_by_hand() -> None:
    labels = np.zeros((20, 20), np.int32)
    labels[2:8, 2:8] = 1
    labels[4, 4] = 0  # a hole of one pixel
    labels[6, 5] = 2  # a hole filled by another label, itself a speck
    labels[12:15, 2:5] = 3
    labels[16:18, 2:4] = 3  # a second part
    labels[0, 19] = 3  # a speck in the corner
    labels[12:16, 16:20] = 4  # on the edge
    found = find_faults(labels)
    assert (found.fragments, found.specks, found.holes, found.border_cells) == (1, 2, 2, 1)
    assert found.fragmented.tolist() == [3]


def squares(n_frames: int = 6, *, step: int = 2) -> np.ndarray:
    """Twelve squares that move to the right; a label is one square through time."""
    frames = np.zeros((n_frames, 60, 100), np.int32)
    for t in range(n_frames):
        for k in range(12):
            row, column = 5 + 18 * (k // 4), 5 + 20 * (k % 4) + step * t
            frames[t, row : row + 8, column : column + 8] = k + 1
    return frames


def test_linked_labels() -> None:
    found = inspect_array(squares())
    assert found["ids"] == "linked"
    assert found["ids_agreement"] == 1
    assert found["ids_chance"] < 0.4
    assert found["ids_pairs"] == 60
    assert found["cells_per_frame"]["each"] == [12] * 6


def test_shuffled_labels() -> None:
    frames, rng = squares(), np.random.default_rng(0)
    for frame in frames:
        frame[frame > 0] = rng.permutation(12)[frame[frame > 0] - 1] + 1
    assert inspect_array(frames)["ids"] == "per frame"


def test_labels_that_never_recur() -> None:
    frames = squares()
    for t, frame in enumerate(frames):
        frame[frame > 0] += 100 * t
    found = inspect_array(frames)
    assert (found["ids"], found["ids_agreement"]) == ("per frame", None)


def test_one_jump_in_the_numbering_is_found() -> None:
    frames = squares(20, step=1)
    later = frames[10:]
    later[later > 0] = 13 - later[later > 0]
    found = inspect_array(frames)
    assert (found["ids"], found["ids_breaks"]) == ("undecided", [10])


@pytest.mark.parametrize("n_cells", [0, 1])
def test_too_little_to_decide(n_cells: int) -> None:
    frames = np.where(squares() <= n_cells, squares(), 0)
    assert inspect_array(frames)["ids"] == "undecided"


def test_empty_and_duplicated_frames() -> None:
    frames = squares(8)
    frames[2] = 0
    frames[5] = np.where(frames[4] > 0, 13 - frames[4], 0)  # the same cells under other numbers
    frames[7] = frames[6]
    found = inspect_array(frames)
    assert found["empty_frames"] == [2]
    assert found["duplicated_frames"] == [5, 7]
    assert (found["faults"]["empty_frames"], found["faults"]["duplicated_frames"]) == (1, 2)


def test_same_content_needs_one_to_one_labels() -> None:
    before = np.array([[1, 1, 2, 2, 0]])
    for after, expected in (
        ([[2, 2, 1, 1, 0]], True),
        ([[9, 9, 7, 7, 0]], True),
        ([[1, 2, 1, 2, 0]], False),
        ([[1, 1, 1, 1, 0]], False),
        ([[1, 1, 2, 0, 2]], False),
    ):
        frame = np.array(after)
        assert same_content(before, frame, find_faults(before), find_faults(frame)) is expected
    nothing = np.zeros((2, 2), int)
    assert not same_content(nothing, nothing, find_faults(nothing), find_faults(nothing))


def test_vanished_frames(tmp_path: Path) -> None:
    for number, frame in zip((0, 1, 4, 5), squares(4), strict=True):
        tifffile.imwrite(tmp_path / f"t{number}.tif", frame)
    found = inspect_labels(read_labels(tmp_path))
    assert found.vanished_frames == (2, 3)
    assert found.faults["vanished_frames"] == 2
    assert (found.first_frame, found.last_frame) == (0, 5)


def test_calibration_is_told_or_missed() -> None:
    found = inspect_array(squares(), pixel_size=0.65, frame_interval=10)
    assert found["calibration"]["pixel_size"] == 0.65
    assert found["calibration"]["time_unit"] == "min"
    found = inspect_array(squares())
    assert found["calibration"] is None
    assert "--units pixel" in found["calibration_problem"]


def test_an_image_is_told_from_masks() -> None:
    noise = np.random.default_rng(0).integers(0, 4, (2, 64, 64))
    assert "looks like images" in inspect_array(noise)["notes"][0]


def test_progress_reaches_the_end() -> None:
    calls: list[tuple[int, int]] = []
    inspect_labels(LabelStack.from_array(squares()), progress=lambda *call: calls.append(call))
    assert calls == [(index + 1, 6) for index in range(6)]


@pytest.mark.parametrize(
    ("name", "ids", "cells"),
    [
        ("t98g_phase_contrast/masks.tif", "per frame", (69, 82, 2700)),
        ("hela_fluorescence/masks.tif", "per frame", (124, 195, 3271)),
        ("cell_migration", "linked", (218, 434, 26087)),
        ("epidermis_area1", "linked", (236, 327, 4453)),
    ],
)
def test_recordings(recordings: Path, name: str, ids: str, cells: tuple[int, int, int]) -> None:
    stack = read_labels(recordings / name)
    found = inspect_labels(stack)
    counts = [np.count_nonzero(np.bincount(frame.ravel())[1:]) for frame in stack]
    assert found.identity.ids == ids
    assert list(found.cells_per_frame) == counts
    assert (min(counts), max(counts), sum(counts)) == cells
    assert (found.empty_frames, found.duplicated_frames, found.vanished_frames) == ((), (), ())
    assert found.calibration is None


def test_faults_of_a_recording(recordings: Path) -> None:
    frame = read_labels(recordings / "t98g_phase_contrast" / "masks.tif")[2]
    expected, found = naive_faults(frame), find_faults(frame)
    assert expected["fragments"] == found.fragments > 0
    assert expected["specks"] == found.specks > 0
    assert expected["fragmented"] == found.fragmented.tolist()


@pytest.mark.parametrize("name", ["cell_migration", "epidermis_area1"])
@pytest.mark.parametrize("step", [3, 7])
def test_identity_survives_long_intervals(recordings: Path, name: str, step: int) -> None:
    frames = np.stack(list(read_labels(recordings / name))[::step])
    assert inspect_labels(LabelStack.from_array(frames)).identity.ids == "linked"
    rng = np.random.default_rng(step)
    for frame in frames:
        labels = np.unique(frame[frame > 0])
        lookup = np.zeros(frame.max() + 1, np.int32)
        lookup[labels] = rng.permutation(len(labels)) + 1
        frame[:] = lookup[frame]
    assert inspect_labels(LabelStack.from_array(frames)).identity.ids == "per frame"
