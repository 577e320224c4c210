"""Shape distributions: descriptors, mode, errors, and who is left out."""

import numpy as np
import pytest
from scipy import stats

from cellquant.observables import observe
from cellquant.observables.blocks import Blocks, spatial_blocks
from cellquant.observables.ranks import at_ranks
from cellquant.observables.shape import describe
from observables_examples import tracks_of


def blocks_of(n: int, n_blocks: int = 16) -> Blocks:
    return Blocks(np.arange(n) % n_blocks, n_blocks, "blocks")


def test_descriptors_agree_with_scipy() -> None:
    values = np.random.default_rng(0).gamma(3, 0.1, 5000) + 3.6
    found = describe(values, blocks_of(values.size)).summary
    assert found["mean"] == pytest.approx(values.mean(), rel=1e-14)
    assert found["median"] == np.median(values)
    assert found["std"] == pytest.approx(values.std(ddof=1), rel=1e-12)
    assert found["skewness"] == pytest.approx(stats.skew(values), rel=1e-10)
    assert found["n"] == 5000
    assert found["std_error"] == pytest.approx(values.std() / np.sqrt(5000), rel=0.5)


def test_kernel_density_agrees_with_scipy() -> None:
    values = np.random.default_rng(1).gamma(3, 0.1, 3000) + 3.6
    found = describe(values, blocks_of(values.size))
    peer = stats.gaussian_kde(values, found.summary["bandwidth"] / values.std(ddof=1))
    x = found.table["value"].to_numpy()
    np.testing.assert_allclose(found.table["kernel_density"], peer(x), atol=0.02 * peer(x).max())
    fine = np.linspace(3.6, 4.2, 4001)
    assert found.summary["mode"] == pytest.approx(fine[np.argmax(peer(fine))], abs=2e-3)


def test_histogram_and_kernel_density_integrate_to_one() -> None:
    values = np.random.default_rng(2).normal(3.9, 0.1, 4000)
    table = describe(values, blocks_of(values.size)).table
    width = table["value"].iloc[1] - table["value"].iloc[0]
    assert table["density"].sum() * width == pytest.approx(1)
    assert table["kernel_density"].sum() * width == pytest.approx(1, abs=0.01)
    assert table["n"].sum() == 4000


def test_mode_of_a_skewed_law_within_its_error() -> None:
    rng = np.random.default_rng(3)
    found = [describe(rng.gamma(9, 0.05, 4000), blocks_of(4000)).summary for _ in range(200)]
    modes = np.array([f["mode"] for f in found])
    errors = np.array([f["mode_std_error"] for f in found])
    # The kernel shifts the mode of a skewed law by a part of its error.
    assert abs(modes.mean() - 0.4) < 0.5 * errors.mean()
    assert errors.mean() == pytest.approx(modes.std(), rel=0.15)
    # Student's quantile of 95 % with 15 degrees of freedom; the jackknife holds 0.85 of them.
    assert np.mean(abs(modes - modes.mean()) < 2.13 * errors) >= 0.9


def test_ranks_of_several_sorted_arrays_are_those_of_all_values() -> None:
    rng = np.random.default_rng(7)
    for values in (
        rng.normal(0, 1, 300),
        rng.integers(-3, 4, 300) * 0.5,
        np.array([-1e308, -0.0, 0.0, 5e-324, 1e308] * 60),
        np.zeros(300),
    ):
        parts = [np.sort(part) for part in np.split(values, [7, 120, 121])]
        everyone = np.sort(values)
        found = at_ranks(parts, np.arange(300), np.full(300, -1))
        np.testing.assert_array_equal(found, everyone)
        rest = np.sort(np.r_[values[:7], values[120:]])
        np.testing.assert_array_equal(at_ranks(parts, np.arange(187), np.full(187, 1)), rest)


def test_constant_values_and_no_values() -> None:
    same = describe(np.full(50, 3.7), blocks_of(50)).summary
    for name, value in (("mean", 3.7), ("median", 3.7), ("mode", 3.7), ("std", 0.0)):
        assert same[name] == pytest.approx(value, abs=1e-14)
    assert np.isnan(same["skewness"])
    none = describe(np.empty(0), Blocks(np.empty(0, dtype=np.int64), 0, "none")).summary
    assert none["n"] == 0
    assert none["mean"] is None
    one = describe(np.array([3.9]), blocks_of(1, 1)).summary
    assert one["mean"] == 3.9
    assert one["std_error"] is None
    assert one["reason"]


def test_border_cells_are_left_out() -> None:
    rng = np.random.default_rng(4)
    place = np.repeat(rng.uniform(0, 9, (30, 1, 2)), 3, axis=1)
    border = np.repeat((np.arange(30) % 3 == 0)[:, None], 3, axis=1)
    shape = np.where(border, 9.0, 3.8)
    tracks = tracks_of(place, shape_index=shape, touches_border=border)
    found = observe(tracks, only=["shape_index"]).summary["shape_index"]
    assert found["n"] == 60
    assert found["mean"] == pytest.approx(3.8)
    assert "border" in found["border_rule"]
    every = tracks_of(place, touches_border=True)
    nothing = observe(every, only=["shape_index"]).summary["shape_index"]
    assert nothing["mean"] is None
    assert "border" in nothing["reason"]


def test_a_cell_is_one_replicate_however_long_it_is_seen() -> None:
    # Shapes differ between cells and not in time: the error must be that of 200 values.
    rng = np.random.default_rng(5)
    shape = np.repeat(3.8 + 0.1 * rng.normal(size=(200, 1)), 50, axis=1)
    place = np.cumsum(rng.normal(0, 0.3, (200, 50, 2)), axis=1) + rng.uniform(0, 14, (200, 1, 2))
    found = observe(tracks_of(place, shape_index=shape), only=["shape_index"])
    error = found.summary["shape_index"]["std_error"]
    assert error == pytest.approx(0.1 / np.sqrt(200), rel=0.5)


@pytest.mark.parametrize("n", [1, 5, 63, 64, 399, 400, 1000])
def test_blocks_are_compact_and_of_equal_size(n: int) -> None:
    place = np.random.default_rng(n).uniform(0, 10, (n, 2))
    blocks = spatial_blocks(place)
    assert blocks.n == (n if n < 64 else 16 if n < 400 else 25)
    sizes = np.bincount(blocks.index, minlength=blocks.n)
    assert sizes.max() - sizes.min() <= 2
    if n >= 64:
        within = np.mean([np.var(place[blocks.index == b], axis=0).sum() for b in range(blocks.n)])
        assert within < 0.2 * np.var(place, axis=0).sum()
