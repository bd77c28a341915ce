"""A refusal that a task caught is noted on the error that follows from it, and on no other."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from workbench.envs.error_notes import (
    AuthorCall,
    CoreRefusal,
    ErrorNote,
    RefusedCall,
    RefusedValue,
    chain_of,
    notes_of,
)


def refuse(text: str = "not possible") -> None:
    raise RefusedCall(text)


def caught(text: str = "not possible") -> None:
    try:
        refuse(text)
    except RefusedCall:
        pass


def fails(*before: Callable[[], None]) -> list[ErrorNote]:
    """Notes on the error of a call of the author's code that does `before`, then divides by zero."""
    with pytest.raises(ZeroDivisionError) as error, AuthorCall():
        for each in before:
            each()
        raise ZeroDivisionError
    return [note for note in notes_of(error.value) if isinstance(note, ErrorNote)]


def test_a_caught_refusal_is_noted_with_its_line_and_only_in_its_call() -> None:
    for _ in range(2):
        [note] = fails(caught)
        assert "not possible" in note and note.before and note.place is not None
        file, line, function = note.place
        assert (file, function) == (__file__, "refuse") and line == refuse.__code__.co_firstlineno + 1
        assert fails() == []
    assert [note.rpartition(" ")[2] for note in fails(lambda: caught("a"), lambda: caught("b"))] == ["a", "b"]
    assert len(fails(*[lambda i=i: caught(f"refusal {i}") for i in range(9)])) == 3, "their frames stay alive"
    caught()  # outside of a call nothing is remembered
    assert fails() == []


def test_a_place_that_the_refusal_names_is_the_one_of_the_note() -> None:
    def elsewhere() -> None:
        try:
            raise RefusedValue("no", place=("task.py", 7, "evaluate"))
        except RefusedValue:
            pass

    [note] = fails(elsewhere)
    assert note.place == ("task.py", 7, "evaluate") and "task.py:7" in note


def test_in_nested_calls_the_outer_error_is_noted_too_and_once() -> None:
    def inner() -> None:
        with AuthorCall():
            caught()

    def failing() -> None:
        with AuthorCall():
            caught()
            raise ZeroDivisionError

    assert len(fails(inner)) == 1
    assert len(fails(failing)) == 1


@pytest.mark.parametrize("again", ["itself", "from", "from none", "while handling"])
def test_an_error_that_shows_the_refusal_gets_no_note(again: str) -> None:
    with pytest.raises(Exception) as error, AuthorCall():
        try:
            refuse()
        except RefusedCall as refusal:
            if again == "itself":
                raise
            if again == "from":
                raise KeyError from refusal
            if again == "from none":
                raise KeyError from None
            raise KeyError  # noqa: B904
    assert notes_of(error.value) == []


def test_the_chain_of_an_error_ends_at_a_refusal_and_follows_what_is_hidden_on_request() -> None:
    first, refusal, second, last = ValueError(), CoreRefusal(), KeyError(), TypeError()
    refusal.__cause__ = first
    second.__context__ = refusal
    last.__cause__ = second
    assert [*chain_of(last)] == [last, second, refusal]
    second.__suppress_context__ = True
    assert [*chain_of(last)] == [last, second]
    assert [*chain_of(last, suppressed=True)] == [last, second, refusal]
    first.__cause__ = first
    assert [*chain_of(first)] == [first]
