"""Folders of frames, patterns, and the folders of the Cell Tracking Challenge."""

from pathlib import Path

import numpy as np
import pytest
import tifffile

from cellquant.errors import InputError
from cellquant.io import read_images, read_labels


def write_frames(folder: Path, names: list[str]) -> None:
    """One frame per name; its first pixel tells which."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        frame = np.zeros((6, 7), np.uint16)
        frame[0, 0] = index + 1
        tifffile.imwrite(folder / name, frame)


def order(path: Path | str) -> list[int]:
    return [int(frame[0, 0]) - 1 for frame in read_labels(path)]


SPELLINGS = {
    "3 digits": "man_track{:03d}.tif",
    "4 digits": "man_track{:04d}.tif",
    "no padding": "man_track{}.tif",
    "result": "mask{:03d}.tif",
    "4-digit result": "mask{:04d}.tif",
    "capitals": "MASK{:03d}.TIF",
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("place", ["", "TRA", "01_GT/TRA", "01_RES"])
def test_tracking_folders(tmp_path: Path, spelling: str, place: str) -> None:
    names = [SPELLINGS[spelling].format(index) for index in range(12)]
    write_frames(tmp_path / place, names)
    stack = read_labels(tmp_path)
    assert order(tmp_path) == list(range(12))
    assert stack.frame_numbers == tuple(range(12))
    assert stack.path == tmp_path / place
    assert stack.axes == "TYX"
    assert stack.notes == ()


@pytest.mark.parametrize("table", ["man_track.txt", "res_track.txt"])
def test_numbers_beside_a_table_are_kept(tmp_path: Path, table: str) -> None:
    write_frames(tmp_path, [f"man_track{number:03d}.tif" for number in (3, 5, 7, 9)])
    (tmp_path / table).write_text("1 3 9 0\n")
    stack = read_labels(tmp_path)
    assert stack.frame_numbers == (3, 5, 7, 9)
    assert stack.notes == ("3 frames are missing: 4, 6, 8",)


def test_gaps_are_found_and_numbers_kept(tmp_path: Path) -> None:
    write_frames(tmp_path, [f"t{number}.tif" for number in (0, 1, 2, 5, 6, 9, 10)])
    stack = read_labels(tmp_path)
    assert order(tmp_path) == list(range(7))
    assert stack.frame_numbers == (0, 1, 2, 5, 6, 9, 10)
    assert stack.notes == ("4 frames are missing: 3 to 4, 7 to 8",)


def test_numbering_from_one(tmp_path: Path) -> None:
    write_frames(tmp_path, [f"img_{number:02d}_c1.tif" for number in (1, 2, 3, 5)])
    stack = read_labels(tmp_path)
    assert stack.frame_numbers == (0, 1, 2, 4)
    assert stack.notes[0].startswith("numbering starts at 1")
    assert stack.notes[1] == "1 frames are missing: 3"


def test_regular_steps_are_one_frame_each(tmp_path: Path) -> None:
    write_frames(tmp_path, [f"t{number:03d}.tif" for number in range(0, 50, 10)])
    stack = read_labels(tmp_path)
    assert stack.frame_numbers == (0, 1, 2, 3, 4)
    assert "steps of 10" in stack.notes[0]


def test_names_without_numbers(tmp_path: Path) -> None:
    write_frames(tmp_path, ["alpha.tif", "beta.tif", "gamma.tiff"])
    stack = read_labels(tmp_path)
    assert order(tmp_path) == [0, 1, 2]
    assert "carry no number" in stack.notes[0]


def test_pattern(tmp_path: Path) -> None:
    write_frames(tmp_path, [f"a{number}.tif" for number in range(11)])
    write_frames(tmp_path, [f"b{number}.tif" for number in range(3)])
    assert order(f"{tmp_path}/a*.tif") == list(range(11))
    with pytest.raises(InputError, match=r"mixes names such as a0\.tif and b0\.tif"):
        read_labels(tmp_path)
    with pytest.raises(InputError, match="no TIFF file matches"):
        read_labels(f"{tmp_path}/c*.tif")


def test_pattern_for_one_stack(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", np.ones((5, 6, 7), np.uint16))
    assert read_labels(f"{tmp_path}/*.tif").n_frames == 5
    assert read_labels(tmp_path).n_frames == 5


def test_masks_beside_images(tmp_path: Path) -> None:
    write_frames(tmp_path, [f"mask{number}.tif" for number in range(3)])
    write_frames(tmp_path, [f"t{number}.tif" for number in range(5)])
    assert read_labels(tmp_path).n_frames == 3
    assert read_images(f"{tmp_path}/t*.tif").n_frames == 5


def test_two_sets_of_masks(tmp_path: Path) -> None:
    write_frames(tmp_path / "01_GT" / "TRA", ["man_track000.tif"])
    write_frames(tmp_path / "01_RES", ["mask000.tif"])
    with pytest.raises(InputError, match=r"01_GT/TRA, 01_RES"):
        read_labels(tmp_path)
    write_frames(tmp_path / "both", ["mask000.tif", "man_track000.tif"])
    with pytest.raises(InputError, match="two sets of masks"):
        read_labels(tmp_path / "both")


def test_folder_without_tiff(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match="holds no TIFF file"):
        read_labels(tmp_path)


def test_frames_of_different_size(tmp_path: Path) -> None:
    write_frames(tmp_path, ["t0.tif", "t1.tif"])
    tifffile.imwrite(tmp_path / "t2.tif", np.zeros((6, 8), np.uint16))
    with pytest.raises(InputError, match=r"t2\.tif \(frame 2\) is 6 x 8 pixels, t0\.tif is 6 x 7"):
        read_labels(tmp_path)


def test_a_stack_among_frames(tmp_path: Path) -> None:
    write_frames(tmp_path, ["t0.tif", "t1.tif"])
    tifffile.imwrite(tmp_path / "t2.tif", np.zeros((5, 6, 7), np.uint16))
    with pytest.raises(InputError, match=r"t2\.tif \(frame 2\) holds 5 pages"):
        read_labels(tmp_path)


def test_a_truncated_frame_is_named_at_open(tmp_path: Path) -> None:
    write_frames(tmp_path, ["t0.tif", "t1.tif"])
    content = (tmp_path / "t1.tif").read_bytes()
    (tmp_path / "t1.tif").write_bytes(content[:-10])
    with pytest.raises(InputError, match=r"t1\.tif is truncated"):
        read_labels(tmp_path)


def test_mixed_types(tmp_path: Path) -> None:
    write_frames(tmp_path, ["t0.tif", "t1.tif"])
    tifffile.imwrite(tmp_path / "t2.tif", np.full((6, 7), 3, np.uint32))
    stack = read_labels(tmp_path)
    assert order(tmp_path) == [0, 1, 2]
    assert stack.dtype == np.uint32
    assert any("different types" in note for note in stack.notes)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a1_2.tif", "a2_1.tif"], "2 numbers change"),
        (["t01.tif", "t1.tif"], "frame number 1 more than once"),
        (["t20260301120000.tif", "t20260301121000.tif", "t20260301131000.tif"], "too far apart"),
        (["a.tif", "a.tiff"], "two files named a"),
        (["man_track12345678.tif"], "too large"),
    ],
)
def test_unclear_numbers(tmp_path: Path, names: list[str], words: str) -> None:
    write_frames(tmp_path, names)
    (tmp_path / "man_track.txt").write_text("1 0 0 0\n")
    with pytest.raises(InputError, match=words):
        read_labels(tmp_path)


def test_a_pattern_over_several_folders(tmp_path: Path) -> None:
    for name in ("p1", "p2"):
        write_frames(tmp_path / name, ["t0.tif", "t1.tif"])
    with pytest.raises(InputError, match="two files named t0"):
        read_labels(f"{tmp_path}/*/t*.tif")


def test_micro_sam_tracking_output(tmp_path: Path) -> None:
    for index in range(3):
        frame = np.full((6, 7), index + 1, np.uint32)
        tifffile.imwrite(tmp_path / f"man_track{index:04d}.tif", frame, compression="zstd")
    (tmp_path / "man_track.txt").write_text("1 0 0 0\n2 1 1 1\n3 2 2 2\n")
    assert order(tmp_path) == [0, 1, 2]


@pytest.mark.parametrize(
    ("name", "n_frames", "shape", "numbers"),
    [
        ("t98g_phase_contrast/masks.tif", 37, (1022, 1024), (0, 36)),
        ("hela_fluorescence/masks.tif", 20, (700, 1100), (0, 19)),
        ("cell_migration", 86, (1024, 1024), (0, 85)),
        ("epidermis_area1/TRA", 15, (460, 460), (0, 14)),
    ],
)
def test_recordings(
    recordings: Path, name: str, n_frames: int, shape: tuple[int, int], numbers: tuple[int, int]
) -> None:
    stack = read_labels(recordings / name)
    assert (stack.n_frames, stack.shape, stack.axes) == (n_frames, shape, "TYX")
    assert (stack.frame_numbers[0], stack.frame_numbers[-1]) == numbers
    for index in (0, n_frames // 2, n_frames - 1):
        if name.endswith(".tif"):
            expected = tifffile.imread(recordings / name, key=index)
        else:
            (file,) = [
                path
                for path in (recordings / name).rglob("*.tif")
                if int("".join(filter(str.isdigit, path.stem))) == index
            ]
            expected = tifffile.imread(file)
        np.testing.assert_array_equal(stack[index], expected)
    with pytest.raises(InputError, match="carries no calibration"):
        _ = stack.calibration
