"""Numbers and sums as EDS files write them (CiA 306-1, "General structure"), against Python's own notation."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.eds.sections import parse_integer, parse_sum
from canprobe.eds.variables import SIGNED, UNSIGNED, convert

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


@pytest.mark.parametrize("text", ["", "x", "1A", "0x", "--1", "1 2", "$NODEID+", "+$NODEID", "0xG", "1e3", "٣"])
def test_what_is_no_number(text):
    with pytest.raises(ValueError):
        parse_sum(text, 1, silent)


@given(st.sampled_from([*SIGNED, *UNSIGNED]), st.integers(-(2**65), 2**65))
def test_a_value_fits_its_type_or_is_refused(data_type, number):
    """Independent: Python's own conversion to bytes of that length and sign."""
    bits = SIGNED.get(data_type) or UNSIGNED[data_type]
    signed = data_type in SIGNED
    try:
        value = convert(str(number), data_type, 1, lambda _: None)
    except ValueError:
        assert not -(2 ** (bits - 1)) <= number < 2**bits
        return
    data = value.to_bytes(bits // 8, "little", signed=signed)
    assert int.from_bytes(data, "little") == number % 2**bits, "the same bits on the wire"
