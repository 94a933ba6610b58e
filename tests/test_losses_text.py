"""How a summary tells of contact that a scan lost."""

import pytest

from canprobe.results import _losses

FOUND = {"searched_mm": 0.93, "regained_after_ms": 465.0}
GONE = {"searched_mm": 2.0, "regained_after_ms": None}


@pytest.mark.parametrize(
    ("losses", "text"),
    [
        ([FOUND], "contact lost 1 time: regained after 465 ms and 0.9 mm"),
        ([FOUND, GONE], "contact lost 2 times: regained after 465 ms and 0.9 mm, not regained within 2.0 mm"),
    ],
)
def test_each_loss_is_told(losses, text):
    assert _losses(losses) == text
