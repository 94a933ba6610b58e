"""How a summary tells of contact that a scan lost."""

import pytest

from canprobe.cell.tasks.regain import Loss, losses_text, summarise_losses

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
    assert losses_text(losses) == text


def test_a_loss_is_summed_up_in_the_units_of_the_summary():
    (found, gone) = summarise_losses([Loss(900, 0.93e-3, 0.465), Loss(1400, 2e-3)])
    assert found == pytest.approx(FOUND)
    assert gone == GONE
