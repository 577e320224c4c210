"""Comparisons, means and whole studies, with bounds that are not values."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from cellquant.statistics import (
    compare_conditions,
    holm,
    log_rank,
    mann_whitney,
    mean_over_trials,
    means_by_bin,
    study_statistics,
    tau_alpha_trend,
)


def test_mann_whitney_agrees_with_scipy_and_carries_effect_sizes() -> None:
    rng = np.random.default_rng(0)
    groups = {"a": rng.normal(0, 1, 12), "b": rng.normal(1, 1, 9), "c": rng.normal(0, 1, 7)}
    table = mann_whitney(groups)
    assert list(zip(table["first"], table["second"], strict=True)) == [
        ("a", "b"), ("a", "c"), ("b", "c"),
    ]  # fmt: skip
    for row in table.itertuples():
        peer = stats.mannwhitneyu(groups[row.first], groups[row.second])
        assert row.p_value == pytest.approx(peer.pvalue)
        assert row.u == peer.statistic
        assert row.superiority == pytest.approx(row.u / (row.n_first * row.n_second))
        assert row.rank_biserial == pytest.approx(2 * row.superiority - 1)
        assert row.p_holm >= row.p_value


def test_three_against_three_cannot_be_significant_and_says_so() -> None:
    row = mann_whitney({"a": [1, 2, 3], "b": [7, 8, 9]}).iloc[0]
    assert row["p_value"] == pytest.approx(0.1)
    assert row["smallest_p"] == pytest.approx(0.1)
    assert row["rank_biserial"] == -1


def test_equal_values_and_empty_groups() -> None:
    assert mann_whitney({"a": [2, 2], "b": [2, 2, 2]}).iloc[0]["p_value"] == 1
    row = mann_whitney({"a": [1.0, np.nan], "b": [np.nan]}).iloc[0]
    assert np.isnan(row["p_value"])
    assert row["reason"] == "b has no value"
    assert len(mann_whitney({"a": [1.0]})) == 0


def test_holm_of_a_known_case() -> None:
    found = holm(np.array([0.01, 0.04, np.nan, 0.03]))
    np.testing.assert_allclose(found, [0.03, 0.06, np.nan, 0.06])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_is_monotone_and_never_smaller(p: list[float]) -> None:
    p_values = np.array(p)
    found = holm(p_values)
    assert (found >= p_values).all()
    assert (found <= 1).all()
    order = np.argsort(p_values, kind="stable")
    assert (np.diff(found[order]) >= 0).all()


def test_log_rank_takes_bounds_for_bounds() -> None:
    rng = np.random.default_rng(1)
    short, long = rng.exponential(1, 40), rng.exponential(4, 40)
    limit = 3.0
    p = log_rank(
        np.minimum(short, limit), np.minimum(long, limit),
        first_censored=short > limit, second_censored=long > limit,
    )  # fmt: skip
    assert p < 0.01
    same = log_rank(short, short, first_censored=short > 9, second_censored=short > 9)
    assert same == pytest.approx(1)
    none = np.ones(3, dtype=bool)
    assert np.isnan(log_rank(short[:3], long[:3], first_censored=none, second_censored=none))
    assert np.isnan(log_rank(short[:0], long[:3], first_censored=none[:0], second_censored=~none))


def test_mean_over_trials() -> None:
    found = mean_over_trials([1.0, 2.0, np.nan, 6.0])
    assert found["mean"] == 3
    assert found["std_error"] == pytest.approx(np.std([1, 2, 6], ddof=1) / np.sqrt(3))
    assert found["n"] == 3
    assert mean_over_trials([4.0])["std_error"] is None
    assert mean_over_trials([4.0])["reason"]
    assert mean_over_trials([np.nan])["mean"] is None


def study(n_trials: int = 8, *, slope: float = 0.01, seed: int = 0) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    rows = [
        {
            "condition": "untreated", "trial": f"t{k}", "bin_centre": c,
            "density": c + rng.uniform(-100, 100), "censored_at": np.nan, "below": np.nan,
        }
        for k in range(n_trials)
        for c in (1100.0, 1600.0, 2100.0, 2600.0)
    ]  # fmt: skip
    table = pd.DataFrame(rows)
    table["tau_alpha"] = 20 + slope * table["density"] + rng.normal(0, 2, len(table))
    return table


def test_a_planted_trend_is_found() -> None:
    found = tau_alpha_trend(study())["untreated"]
    assert found["slope"] == pytest.approx(0.01, abs=3 * found["std_error"])
    assert found["p_value"] < 0.001
    assert found["n_groups"] == 8
    assert found["n_censored"] == 0
    assert "at_bound" not in found


def test_censored_points_are_counted_and_enter_as_bounds() -> None:
    table = study()
    high = table["tau_alpha"] > 42
    table.loc[high, "censored_at"] = 42.0
    table.loc[high, "tau_alpha"] = np.nan
    found = tau_alpha_trend(table)["untreated"]
    assert found["n_censored"] == high.sum()
    assert found["n"] == len(table)
    assert "Tobit" in found["method"]
    assert found["slope"] == pytest.approx(0.01, abs=3 * found["std_error"])
    assert found["without_bounds"]["n"] == (~high).sum()
    assert max(found[k]["slope"] for k in ("without_bounds", "at_bound")) < found["slope"]
    means = means_by_bin(table)
    dense = means[means["bin_centre"] == 2600].iloc[0]
    assert dense["n_censored"] > 0
    assert np.isnan(dense["mean"])
    assert dense["lower_bound"] > 38
    whole = means[means["bin_centre"] == 1100].iloc[0]
    assert whole["mean"] == pytest.approx(31, abs=2)
    assert whole["n"] == 8


def test_conditions_are_compared_by_trial() -> None:
    rng = np.random.default_rng(2)
    rows = [
        {"condition": c, "trial": k, "quantity": q, "value": rng.normal(m, 0.1)}
        for c, m in (("untreated", 1.0), ("low nutrient", 0.7))
        for k in range(6)
        for q in ("speed", "shape_index")
    ]
    found = compare_conditions(pd.DataFrame(rows))
    assert [row["quantity"] for row in found] == ["speed", "shape_index"]
    assert all(row["test"] == "Mann-Whitney" for row in found)
    assert all(row["p_value"] < 0.01 for row in found)
    assert all((row["n_first"], row["n_second"]) == (6, 6) for row in found)


def test_censored_values_are_compared_by_the_log_rank_test() -> None:
    rng = np.random.default_rng(3)
    rows = [
        {"condition": c, "trial": k, "quantity": "tau_alpha", "value": v, "censored": v >= 3}
        for c, m in (("a", 1.0), ("b", 4.0), ("c", 0.2), ("d", 0.2))
        for k, v in enumerate(np.minimum(rng.exponential(m, 12), 3.0))
    ]
    for row in rows[36:]:
        row["value"] = min(row["value"], 2.9)
    found = {(r["first"], r["second"]): r for r in compare_conditions(pd.DataFrame(rows))}
    row = found["a", "b"]
    assert row["test"] == "log-rank"
    assert row["n_censored"] > 0
    assert row["rank_biserial"] is None
    assert 0 < row["p_value"] < 0.1
    assert "bounds" in row["reason"]
    # One family of six pairs, one of them without a bound.
    assert found["c", "d"]["test"] == "Mann-Whitney"
    p_values = np.array([r["p_value"] for r in found.values()])
    np.testing.assert_allclose([r["p_holm"] for r in found.values()], holm(p_values))
    assert min(r["p_holm"] for r in found.values()) == pytest.approx(6 * p_values.min())


def test_conditions_that_are_all_bounds_say_so() -> None:
    rows = [
        {"condition": c, "trial": k, "quantity": "tau_alpha", "value": 3.0, "censored": True}
        for c in "ab"
        for k in range(3)
    ]
    (row,) = study_statistics(study(2), pd.DataFrame(rows))["mann_whitney"]
    assert row["p_value"] is row["p_holm"] is None
    assert "fewer than two values are known" in row["reason"]


def test_a_study_is_json_ready_and_says_its_rules() -> None:
    import json

    table = study(2)
    table["condition"] = pd.array([None] * len(table), dtype="string")
    table["trial"] = pd.array(table["trial"], dtype="string")
    found = study_statistics(table)
    text = json.dumps(found, allow_nan=False)
    assert "at_bound" in found["censoring"]
    assert json.loads(text)["mixed_model"]["all"]["n_groups"] == 2
    alone = study_statistics(table.iloc[:4])
    assert "two trials" in alone["mixed_model"]["all"]["reason"]
    nothing = study_statistics(table.iloc[:0])
    assert nothing["mixed_model"] == {}
    assert nothing["tau_alpha_by_bin"] == []
