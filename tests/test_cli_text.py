"""How values are written: as many digits as their error allows."""

import pytest

from cellquant.cli.text import with_error


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (3.91234, 0.0141, "3.912 ± 0.014 um"),
        (1234.56, 78.9, "1235 ± 79 um"),
        (3.91234, None, "3.912 um"),
        (3.91234, float("nan"), "3.912 um"),
        (1.1949, 1.6e-16, "1.195 um"),
        (None, 0.1, "not measurable"),
        (float("nan"), 0.1, "not measurable"),
    ],
)
def test_values_with_errors(value: float | None, error: float | None, text: str) -> None:
    assert with_error(value, error, "um") == text
