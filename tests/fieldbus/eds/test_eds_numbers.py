"""Numbers and sums as EDS files write them (CiA 306-1, "General structure"), against Python's own notation."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.fieldbus.eds.numbers import parse_integer, parse_sum
from canprobe.fieldbus.eds.values import SIGNED_BITS, UNSIGNED_BITS, convert

WORDS = st.integers(0, 2**64 - 1)


def silent(remark):
    pytest.fail(f"not expected: {remark}")


@given(WORDS, st.sampled_from(["{:d}", "0x{:x}", "0X{:X}", "0x{:08X}"]))
def test_usual_forms_need_no_remark(number, form):
    assert parse_integer(form.format(number), silent) == number


@given(WORDS)
def test_a_leading_zero_means_octal_and_is_told_where_it_matters(number):
    remarks = []
    assert parse_integer(f"0{number:o}", remarks.append) == number
    assert len(remarks) == (int(f"{number:o}") != number)


@given(WORDS, st.integers(1, 127), st.permutations([0, 1]), st.sampled_from(["$NODEID", "$nodeid", "$NodeId"]))
def test_sums_in_any_order_and_case(number, node_id, order, word):
    terms = [word, f"0x{number:X}"]
    text = " + ".join(terms[n] for n in order)
    assert parse_sum(text, node_id, silent) == (number + node_id, True)
    assert parse_sum(text.replace(" ", ""), node_id, silent) == (number + node_id, True)
    assert parse_sum(terms[1], node_id, silent) == (number, False)


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("0.0", 0), ("12.", 12), ("-3.00", -3), ("0x1234LL", 0x1234), ("100UL", 100), ("7u", 7), ("0xFFul", 0xFF),
        ("0x00 00 01 00", 256), ("0x0001_0000", 0x10000), ("1_000_000", 10**6), ("0x10+NODEID", 21),
        ("($NODEID + 0x180)", 0x185), ("${NODEID}+1", 6), ("$(NODEID)+1", 6), ("Node-ID + 1", 6), ("+5", 5),
    ],
)  # fmt: skip
def test_numbers_as_other_tools_write_them_are_taken_with_a_remark(text, number):
    remarks = []
    assert parse_sum(text, 5, remarks.append)[0] == number
    assert bool(remarks) == (text != "+5")


@pytest.mark.parametrize("text", ["0.5", "1_", "0x1__", "0x 1", "L", "UL", "1.0.0", "(1", "NODE", "1 000"])
def test_what_other_tools_do_not_write_is_no_number(text):
    with pytest.raises(ValueError):
        parse_sum(text, 1, silent)


@pytest.mark.parametrize("text", ["", "x", "1A", "0x", "--1", "1 2", "$NODEID+", "+$NODEID", "0xG", "1e3", "٣"])
def test_what_is_no_number(text):
    with pytest.raises(ValueError):
        parse_sum(text, 1, silent)


@given(st.sampled_from([*SIGNED_BITS, *UNSIGNED_BITS]), st.integers(-(2**65), 2**65))
def test_a_value_fits_its_type_or_is_refused(data_type, number):
    """Independent: Python's own conversion to bytes of that length and sign."""
    bits = SIGNED_BITS.get(data_type) or UNSIGNED_BITS[data_type]
    signed = data_type in SIGNED_BITS
    try:
        value = convert(str(number), data_type, 1, lambda _: None)
    except ValueError:
        assert not -(2 ** (bits - 1)) <= number < 2**bits
        return
    data = value.to_bytes(bits // 8, "little", signed=signed)
    assert int.from_bytes(data, "little") == number % 2**bits, "the same bits on the wire"
