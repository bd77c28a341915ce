"""Whatever a client claims, a panel gets a value that its control can have, or a sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from workbench.ui.server.control_values import (
    check_value,
    checked_choice,
    checked_int,
    checked_number,
    limit_text,
    name_control,
)

anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.just(10**400),
    st.floats(),
    st.complex_numbers(),
    st.text(),
    st.binary(),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.text(), st.floats(), max_size=2),
    st.floats(width=32).map(np.float32),
    st.integers(-(2**31), 2**31 - 1).map(np.int32),
    st.just(np.zeros(3)),
    st.just(np.bool_(True)),
)
bounds = st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)).map(sorted)


def outcome(check: Callable[[], object]) -> object:
    """What ``check`` gives, or the sentence with which it refuses; any other error fails the test."""
    try:
        return check()
    except ValueError as error:
        return error


@given(anything, bounds)
def test_a_number_is_within_its_bounds_or_refused(value, limits):
    low, high = limits
    got = outcome(lambda: checked_number(value, low, high, "speed"))
    if isinstance(got, ValueError):
        assert "speed" in str(got)
    else:
        assert type(got) is float
        assert low <= got <= high


@given(bounds, st.floats(0, 1))
def test_a_number_within_its_bounds_is_kept(limits, part):
    low, high = limits
    value = min(max(low + part * (high - low), low), high)
    assert checked_number(value, low, high, "speed") == value


@given(bounds.filter(lambda limits: limits[1] - limits[0] > 1e-3), st.sampled_from((-1, 1)))
def test_a_number_beyond_a_bound_is_refused_and_rounding_at_a_bound_is_not(limits, side):
    low, high = limits
    edge = low if side < 0 else high
    with pytest.raises(ValueError, match="goes from"):
        checked_number(edge + side * 0.01 * (high - low), low, high, "speed")
    assert checked_number(edge + side * 1e-7 * (high - low), low, high, "speed") == edge


@pytest.mark.parametrize(
    "value", [math.nan, np.float32("nan"), math.inf, -math.inf, True, "5", None, [5], 10**400]
)
def test_what_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match="speed"):
        checked_number(value, 0.0, 10.0, "speed")


@given(anything, st.tuples(st.integers(-100, 100), st.integers(-100, 100)).map(sorted))
def test_an_int_is_within_its_bounds_or_refused(value, limits):
    low, high = limits
    got = outcome(lambda: checked_int(value, low, high, "env"))
    if isinstance(got, ValueError):
        assert "env" in str(got)
    else:
        assert type(got) is int
        assert low <= got <= high
        assert got == value


def test_a_browsers_whole_number_is_an_int_and_a_fraction_is_not():
    assert checked_int(3.0, 0, 15, "env") == 3
    with pytest.raises(ValueError, match="whole"):
        checked_int(3.5, 0, 15, "env")


def test_an_int_of_an_empty_range_does_not_exist():
    with pytest.raises(ValueError, match="There is no env"):
        checked_int(0, 0, -1, "env")


@given(anything, st.lists(st.text(), max_size=4))
def test_a_choice_is_one_of_the_options_or_refused(value, options):
    got = outcome(lambda: checked_choice(value, options, "camera"))
    if isinstance(got, ValueError):
        assert not isinstance(value, str) or value not in options
    else:
        assert got in options


def test_true_is_not_the_option_one():
    with pytest.raises(ValueError, match="not one of the choices"):
        checked_choice(True, (0, 1), "camera")


@pytest.fixture(scope="module")
def texts() -> Iterator[dict[bool, viser.GuiTextHandle]]:
    """A short text of one line, and of several."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    made = {several: server.gui.add_text("policy", "", multiline=several) for several in (False, True)}
    for text in made.values():
        limit_text(text, 5)
    yield made
    server.stop()


@given(anything)
def test_a_limited_text_is_short_and_can_be_read_or_is_refused(texts, value):
    for several, text in texts.items():
        got = outcome(lambda text=text: check_value(text, value))
        if isinstance(got, ValueError):
            assert str(got).startswith("The policy ")
        else:
            assert isinstance(value, str)
            assert len(value) <= 5 and "\0" not in value
            assert several or value.isprintable()


@pytest.mark.parametrize("value", ["abcdef", "a\nb", "a\0", "\x1b[m", "a\u202eb", "a\u2028b"])
def test_a_limited_line_takes_nothing_that_is_not_seen(texts, value):
    with pytest.raises(ValueError, match="^The policy (takes|has characters)"):
        check_value(texts[False], value)
    assert check_value(texts[False], "abcdé") is None
    assert check_value(texts[True], "a\nb") is None


def test_a_control_without_a_label_is_named_in_a_refusal(server: viser.ViserServer) -> None:
    slider = server.gui.add_slider("", min=-3, max=0, step=1, initial_value=0)
    name_control(slider, "step of the past")
    with pytest.raises(ValueError, match="^The step of the past goes from -3 to 0"):
        check_value(slider, 7)
