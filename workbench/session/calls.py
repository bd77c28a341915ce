"""A question to a worker has a number, and what comes back says which question it belongs to."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, ForwardRef, Generic, TypeVar, get_args, get_origin

from workbench.authoring.problem import Problem

Value = TypeVar("Value", covariant=True)


class Question(Generic[Value]):
    """What a worker can be asked in a `Call`; its answer is a `Value`."""


@dataclass(frozen=True)
class Call:
    """Request to a worker: an `Answer` with this number comes back, after any count of `Progress`."""

    number: int
    request: Question[Any]


@dataclass(frozen=True)
class Cancel:
    """Request to a worker: nobody waits for what was asked before. What takes long ends early at any request."""


@dataclass(frozen=True)
class Progress:
    """How far a `Call` is."""

    number: int
    done: int
    total: int
    part: Any = None
    """What is known of the answer since the last one."""


@dataclass(frozen=True)
class Answer:
    """The end of a `Call`."""

    number: int
    value: Any = None
    why: str = ""
    """Why there is no value, for the reader; empty where there is one."""
    problem: Problem | None = None
    """What the author's code raised, if that is why."""


class CannotAnswer(Exception):
    """In a worker: a question has no answer here; a sentence."""


def fits(value: object, question: Question[Any]) -> bool:
    """Whether it can be the answer: the author's code runs where it comes from."""
    (base,) = type(question).__orig_bases__  # type: ignore[attr-defined]
    (kind,) = get_args(base)
    if isinstance(kind, ForwardRef):
        kind = vars(sys.modules[type(question).__module__])[kind.__forward_arg__]
    return isinstance(value, get_origin(kind) or kind)
