"""A background process that the test plays: it answers the questions of a job at once."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from workbench.live.messages import Load


@dataclass
class ScriptedBackground:
    """Stands in for `Background`: `answer` returns the answer to a question; an error is raised instead."""

    answer: Callable[[Any], Any]
    num_envs: int = 3
    asked: list[Any] = field(default_factory=list)
    """All questions, oldest first."""
    ensured: list[tuple[Any, ...]] = field(default_factory=list)
    """Arguments of `ensure`: the load, the placed cameras, and what to load instead."""
    priorities: list[str] = field(default_factory=list)
    ended: int = 0
    loaded: Load | None = None

    async def in_turns(
        self, job: object, work: Callable[[], Awaitable[Any]], priority: str = "person"
    ) -> Any:
        self.priorities.append(priority)
        return await work()

    async def ensure(self, job: object, load: Load, placed: Any = (), or_else: Load | None = None) -> int:
        self.ensured.append((load, placed, or_else))
        self.loaded = load
        return self.num_envs

    def has_loaded(self, load: Load) -> bool:
        return load.level == "auto" and self.loaded == load

    async def ask(self, question: Any, on_progress: object = None) -> Any:
        await asyncio.sleep(0)  # so that a job can be stopped here
        self.asked.append(question)
        answer = self.answer(question)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def of(self, kind: type) -> list[Any]:
        """The questions of this kind."""
        return [question for question in self.asked if isinstance(question, kind)]

    def end(self) -> None:
        self.ended += 1

    def close(self) -> None:
        """Does nothing: it has no process."""
