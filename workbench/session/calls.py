"""A question to a worker has a number, and what comes back says which question it belongs to."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, ClassVar, ForwardRef, Generic, TypeVar, get_args

from workbench.authoring.problem import Problem

Value = TypeVar("Value", covariant=True)


class Question(Generic[Value]):
    """What a worker can be asked in a `Call`; its answer is a `Value`."""

    part: ClassVar[Any] = None
    """The type of `Progress.part`."""


@dataclass(frozen=True)
class Cancel:
    """Request to a worker: nobody waits for what was asked before. What takes long ends early at any request."""


@dataclass(frozen=True)
class Progress:
    """How far a `Call` is."""

    number: int
    done: int
    total: int
    part: bytes = b""
    """What is known of the answer since the last one, packed; see `Question.part`."""


@dataclass(frozen=True)
class Answer:
    """The end of a `Call`."""

    number: int
    value: bytes = b""
    """Packed (`wire`): only who asked knows of what kind it is to be."""
    why: str = ""
    """Why there is no value, for the reader; empty where there is one."""
    problem: Problem | None = None
    """What the author's code raised, if that is why."""


class CannotAnswer(Exception):
    """In a worker: a question has no answer here; a sentence."""


def value_type(question: type[Question[Any]]) -> Any:
    """What its answer is to be."""
    (base,) = question.__orig_bases__  # type: ignore[attr-defined]
    (kind,) = get_args(base)
    if isinstance(kind, ForwardRef):
        kind = vars(sys.modules[question.__module__])[kind.__forward_arg__]
    return kind
