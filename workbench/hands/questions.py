"""Questions to a worker about resets: where the bodies are afterwards, and the numbers that were drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from workbench.envs.inspection import Overlap
from workbench.machine.processes.wire import Question
from workbench.source.parsed import Place, TracedValue


@dataclass(frozen=True, eq=False)
class Operand:
    """A number, or one for each sampled column, that an operator combines with the sampled numbers."""

    at: Place
    """The expression where the operand is used."""
    numbers: tuple[float, ...]
    """Its value; empty if it is not known."""
    value: TracedValue | None
    """None if it could not be traced to the source."""
    why: str = ""
    """Reason why `value` is None."""


@dataclass(frozen=True, eq=False)
class Operation:
    """An arithmetic operation on drawn numbers."""

    sign: Literal["+", "-", "from", "*", "/", "negated"]
    """``from``: the drawn number is subtracted from the operand."""
    operand: Operand | None
    """None for ``negated``."""


@dataclass(frozen=True, eq=False)
class Draw:
    """A call that drew uniform numbers in 0 to 1, in the author's files, and what the expression around it makes of them.

    A call of ManiSkill's ``uniform(low, high)`` is such a call too.
    """

    at: Place
    """The call."""
    whole: Place
    """The whole arithmetic expression; the call itself without one."""
    numbers: NDArray[np.float32]
    """(N, M) drawn numbers in 0 to 1, M for each env."""
    bounds: tuple[Operand, ...] = ()
    """Operands that state the lowest and the highest number: ``low, high`` of ``uniform``, and ``low, high, low`` of
    ``torch.rand(b) * (high - low) + low``. Empty without them."""
    operations: tuple[Operation, ...] = ()
    """Operations after `bounds` are applied, innermost first."""
    simple: bool = True
    """Whether the call and `operations` are the whole way to `whole`; False for a call of another function that draws."""


@dataclass(frozen=True, eq=False)
class EpisodeStart:
    """The first moment after a reset of all envs."""

    poses: NDArray[np.float32]
    """(N, B, 7), as in `StepResult.poses`."""
    qpos: NDArray[np.float32] | None
    """(N, J), as in `StepResult.qpos`."""
    draws: tuple[Draw, ...]
    """In the order in which they were drawn."""


@dataclass(frozen=True)
class ReadStart(Question[EpisodeStart]):
    """Reset all envs with this seed, and record what is drawn."""

    seed: int
    texts: Mapping[str, str]
    """The author's files by path, in which calls that draw are looked for. They may differ from the executed texts in
    their line ends."""


@dataclass(frozen=True)
class FirstStates:
    """The first states of all N envs after a reset."""

    poses: NDArray[np.float32]
    """(N, B, 7) as in `StepResult.poses`."""
    overlaps: tuple[tuple[Overlap, ...], ...] | None = None
    """For each env, bodies inside each other, deepest first (`overlaps_to_report`); None in GPU simulation,
    where contacts cannot be read."""
    reach_of: tuple[int, ...] = ()
    """Bodies for which `out_of_reach` was computed; empty if no robot has an arm."""
    out_of_reach: NDArray[np.bool_] | None = None
    """(N, len(reach_of)) whether no arm of the env reaches the origin of the body, in any rotation. Collisions are
    not considered."""


@dataclass(frozen=True)
class SampleReset(Question[FirstStates]):
    """Reset all envs. Only a process that does not play answers it, since the envs make a substep of physics."""

    seed: int
