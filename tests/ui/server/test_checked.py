"""Whatever a client claims, a panel gets a value that its control can have, or a sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from workbench.ui.server.control_values import (
    check_value,
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


def outcome(check: Callable[[], object]) -> object:
    """What ``check`` gives, or the sentence with which it refuses; any other error fails the test."""
    try:
        return check()
    except ValueError as error:
        return error


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
