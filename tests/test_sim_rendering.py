"""Rendered runs: masks, truth and picture belong together."""

import numpy as np
import pytest

from cellquant.errors import InputError
from cellquant.io import read_images, read_labels
from cellquant.sim import Scene, render, simulate
from cellquant.tables import read_tracks


@pytest.fixture(scope="module")
def run():
    return simulate(Scene(n_cells=25, phi=0.95, v0=0.2), duration=6, dt=0.02)


@pytest.fixture(scope="module")
def rendered(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered")
    return render(
        run, folder / "masks.tif", pixel_size=0.4, phase_contrast=folder / "phase.tif"
    )  # fmt: skip


def test_masks_truth_and_picture_have_one_calibration(run, rendered):
    stack = read_labels(rendered.masks)
    assert stack.n_frames == run.n_frames
    assert stack.calibration.pixel_size == pytest.approx(0.4)
    assert stack.calibration.frame_interval == pytest.approx(1 / 6)
    assert stack.shape == rendered.shape
    picture = read_images(rendered.phase_contrast)
    assert len(picture) == run.n_frames
    frame = np.asarray(picture[0])
    assert frame.dtype == np.uint8
    assert 20 < frame.std() < 80


def test_every_label_has_its_true_row_and_area(run, rendered):
    stack = read_labels(rendered.masks)
    tracks = read_tracks(rendered.truth)
    contours = np.load(rendered.truth / "contours.npy")
    assert len(contours) == len(tracks.table)
    for frame in range(stack.n_frames):
        rows = tracks.table[tracks.table["frame"] == frame]
        labels, counts = np.unique(stack[frame], return_counts=True)
        assert set(labels[labels > 0]) == set(rows["label"])
        # Overlaps are shared out, so what is drawn of whole cells is a little less than they are.
        inner = rows[~rows["touches_border"]]
        drawn = dict(zip(labels, counts * 0.16, strict=True))
        ratio = np.array([drawn[k] for k in inner["label"]]) / inner["area"]
        assert (ratio < 1.02).all()
        assert ratio.mean() > 0.9
    centre = contours.mean(axis=1)
    assert np.abs(centre - tracks.table[["x", "y"]].to_numpy()).max() < 1.0


def test_true_tracks_move_without_jumps_and_leave_at_the_border(run, rendered):
    table = rendered.tracks.table
    step = table.groupby("track_id")[["x", "y"]].diff().abs().max().max()
    assert step < 0.5 * 10
    assert (table.groupby("track_id")["frame"].diff().dropna() == 1).all()
    assert rendered.tracks.n_tracks > 25
    assert (rendered.truth / "TRA" / "man_track.txt").is_file()
    assert table.loc[~table["touches_border"]].groupby("frame").size().min() >= 9


def test_same_run_gives_the_same_bytes(run, rendered, tmp_path):
    again = render(
        run, tmp_path / "masks.tif", pixel_size=0.4, phase_contrast=tmp_path / "phase.tif"
    )  # fmt: skip
    for a, b in ((rendered.masks, again.masks), (rendered.phase_contrast, again.phase_contrast)):
        assert a.read_bytes() == b.read_bytes()


def test_isolated_disc_is_drawn_exactly(tmp_path):
    scene = Scene(n_cells=1, box=(3, 2), radii=(0.5,), positions=((1.5, 1.0),), v0=0.0, D_r=0.0)
    run = simulate(scene, duration=1, dt=0.02)
    out = render(run, tmp_path / "disc.tif", pixel_size=0.1, stop=1)
    mask = read_labels(out.masks)[0]
    rows, columns = np.nonzero(mask)
    expected = (columns * 0.01 - 1.5) ** 2 + (rows * 0.01 - 1.0) ** 2
    assert expected.max() < 0.25
    assert len(rows) * 0.01**2 == pytest.approx(np.pi * 0.25, rel=5e-3)


def test_with_a_margin_the_layer_is_seen_once_more_and_each_cell_whole(run, rendered, tmp_path):
    wide = render(run, tmp_path / "masks.tif", pixel_size=0.4, margin=1.5)
    height, width = rendered.shape
    assert wide.shape == tuple(int((side + 1.5) / 0.04) for side in run.box[::-1])
    first, narrow = read_labels(wide.masks)[0], read_labels(rendered.masks)[0]
    # What is drawn is the same layer, the strip beyond the box that on the other side.
    assert np.array_equal(first[:height, :width] > 0, narrow > 0)
    side = run.box[0] / 0.04
    strip = first[:height, round(side) : round(side) + 30] > 0
    assert (strip == (narrow[:, :30] > 0)).mean() > 0.97
    whole = wide.tracks.table.query("frame == 0 and not touches_border")
    assert len(whole) >= run.scene.n_cells
    assert len(rendered.tracks.table.query("frame == 0 and not touches_border")) < 20
    box = np.array(run.box) * 10
    places = np.round(whole[["x", "y"]].to_numpy() % box, 3)
    assert len(np.unique(places, axis=0)) == run.scene.n_cells


def test_wrong_options_are_refused(run, tmp_path):
    for options in (
        {"pixel_size": 0.0}, {"pixel_size": 5.0}, {"pixel_size": 0.4, "start": 99},
        {"pixel_size": 0.4, "margin": -1.0}, {"pixel_size": 0.4, "margin": 99.0},
    ):  # fmt: skip
        with pytest.raises(InputError):
            render(run, tmp_path / "masks.tif", **options)
