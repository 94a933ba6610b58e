"""Messages of an array become the pad's taxels, in their place."""

import numpy as np
import pytest

from canprobe.cell.master.tactile_frame import decode
from canprobe.fieldbus.protocol.tactile import TactileHeader, TactileMessage, TactileMode


@pytest.mark.parametrize("shape", [(16, 16), (12, 9)])
@pytest.mark.parametrize("side", [4, 8])
def test_the_taxels_of_a_window_lie_where_they_were(shape, side):
    pad = np.random.default_rng(side).integers(1, 256, shape, dtype=np.uint8)
    row, col = shape[0] - side, 1
    header = TactileHeader(4, 2, row, col, TactileMode.WINDOW, True, 5000, window=side)
    frame = decode(TactileMessage(header, pad[row:, col : col + side].tobytes(), 1000), shape)
    expected = np.zeros(shape, np.uint8)
    expected[row:, col : col + side] = pad[row:, col : col + side]
    assert np.array_equal(frame.taxels, expected) and frame.taxels.dtype == np.uint8
    assert frame.window == (row, col, side, side) and frame.features is None
    assert (frame.header, frame.t_ns) == (header, 1000)
    with pytest.raises(ValueError, match="read-only"):
        frame.taxels[0, 0] = 1


def test_an_image_fills_the_pad_and_what_fills_up_its_last_word_is_not_read():
    pad = np.arange(15, dtype=np.uint8).reshape(5, 3)
    frame = decode(
        TactileMessage(TactileHeader(0, 0, 0, 0, TactileMode.IMAGE, False, 0), pad.tobytes() + b"\xff", 7), (5, 3)
    )
    assert np.array_equal(frame.taxels, pad) and frame.window == (0, 0, 5, 3)
