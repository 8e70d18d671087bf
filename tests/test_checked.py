"""Values that come from a browser: each is brought into its bounds, or replaced."""

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from viewer.checked import flag, has_type_of, option, vector, within

anything = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.floats()), st.binary(),
    st.sampled_from([10**400, -(10**400), np.float32(0.5), np.array(0.5), np.zeros((3, 2)), np.ones(3), {}, object()]),
)  # fmt: skip


@given(anything, st.floats(-1e6, 1e6), st.floats(0.0, 1e6))
@example(math.nan, 0.5, 1.5)
@example(math.inf, 0.5, 1.5)
def test_a_number_lies_within_its_bounds(value: object, low: float, width: float) -> None:
    number = within(value, low, low + width)
    assert isinstance(number, float) and low <= number <= low + width
    if isinstance(value, float) and low <= value <= low + width:
        assert number == value
    if not isinstance(value, int | np.floating) and not (isinstance(value, float) and math.isfinite(value)):
        assert number == low


@pytest.mark.parametrize(("value", "expected"), [(3, 2.0), (-1, 0.5), (1, 1.0), (10**400, 2.0), (-math.inf, 0.5)])
def test_a_number_out_of_bounds_goes_to_the_nearest(value: float, expected: float) -> None:
    assert within(value, 0.5, 2.0) == expected


@given(st.one_of(anything, st.lists(anything, min_size=3, max_size=3)))
def test_a_vector_lies_in_its_box(value: object) -> None:
    low, high = (-1.0, 0.0, 2.0), (1.0, 0.5, 2.0)
    inside = vector(value, low, high)
    assert inside.shape == (3,) and inside.dtype == float
    assert (inside >= low).all() and (inside <= high).all()
    parts = value if isinstance(value, list) and len(value) == 3 else low
    if not isinstance(value, np.ndarray):
        np.testing.assert_array_equal(inside, [within(*part) for part in zip(parts, low, high, strict=True)])


@pytest.mark.parametrize("kind", [tuple, list, np.array])
def test_a_vector_in_its_box_is_kept(kind: Callable[[Any], object]) -> None:
    np.testing.assert_array_equal(vector(kind((0.5, -9.0, 9.0)), (-1, -1, -1), (1, 1, 1)), (0.5, -1.0, 1.0))


@given(anything, st.lists(st.text(), min_size=1))
def test_an_option_is_one_of_those_offered(value: object, offered: list[str]) -> None:
    assert option(value, offered) == (value if isinstance(value, str) and value in offered else offered[0])
    assert all(option(text, offered) == text for text in offered)


@given(anything)
def test_a_flag_is_true_only_where_it_is_true(value: object) -> None:
    assert flag(value) is (isinstance(value, bool) and value)


@given(anything, st.sampled_from([True, 1, 1.0, "text", (0.0, 0.0), (), None]))
def test_what_may_stand_for_a_value_is_of_its_kind_and_can_be_sent_to_all(value: object, current: object) -> None:
    kinds = {bool: bool, int: (int, float), float: (int, float), str: str, tuple: list}
    if has_type_of(value, current):
        assert isinstance(value, kinds[type(current)])  # type: ignore[arg-type]
        msgspec.msgpack.encode(int(value) if type(current) is int else value)  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("value", "current"), [(False, True), (2.5, 1), (2, 1.0), ("", "text"), ([1, 2.5], (0.0, 0.0)), ([], ())]
)
def test_what_a_browser_sends_of_a_control_may_stand_for_its_value(value: object, current: object) -> None:
    assert has_type_of(value, current)
