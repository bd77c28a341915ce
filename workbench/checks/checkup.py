"""What the checks look at: envs of one version of a task, and what was seen of them, each seen once."""

from __future__ import annotations

import linecache
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, wraps
from typing import Any, TypeVar

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.authoring.loading.blamed import blamed
from workbench.authoring.loading.load import LoadedTask
from workbench.authoring.problem import TaskError
from workbench.checks.places import Places
from workbench.checks.tensor_watch import NUM_ENVS, TensorUses, TensorWatch
from workbench.core.broken_rule import Place
from workbench.core.capture.inspect_env import list_contacts
from workbench.core.env import actions
from workbench.core.env.evaluate_entries import flat_entries
from workbench.core.env.keywords import constructor_arguments
from workbench.core.env.step_result import StepResult
from workbench.core.env.task_env import EnvOptions, TaskEnv, make_env
from workbench.core.rules import Degree, Finding
from workbench.core.scene.scene_index import scene_index

ROLLOUT_STEPS = 50
"""Most control steps of an episode that is rolled out."""
STILL_SECONDS = 1.0
"""How long the robot holds still."""
MOST_OBS = 4096
"""Leaves of an observation with more numbers per env are pictures."""


@dataclass(frozen=True)
class Found:
    """A breach of a rule, before its degree is known."""

    message: str
    """What is wrong, with numbers, and what to write instead, in one or two sentences."""
    place: Place | None
    """File, line and function; None if no line is at fault."""
    count: int = 1
    """In how many envs, seeds or steps."""


@dataclass(frozen=True)
class Note:
    """Something worth knowing that breaks no rule."""

    message: str


Check = Callable[["Checkup"], Iterator[Found | Note]]
"""Looks whether one rule is kept."""
_Value = TypeVar("_Value")


class CannotCheck(Exception):
    """Why a rule cannot be looked at for this task, as a sentence: it has no dense reward, say."""


def evidence(see: Callable[[Checkup], _Value]) -> cached_property[_Value]:
    """A property of a `Checkup` that is seen once; if the task raises there, it raises the same error each time."""

    @wraps(see)
    def once(self: Checkup) -> _Value:
        if (known := self.failed.get(see.__name__)) is not None:
            raise known
        try:
            return see(self)
        except TaskError as error:
            self.failed[see.__name__] = error
            raise

    return cached_property(once)


@dataclass(frozen=True)
class Overlap:
    """Two bodies inside each other."""

    bodies: tuple[str, str]
    """As in `SceneIndex.names`."""
    depth: float
    """Metres."""


@dataclass
class Episodes:
    """What was seen of K episodes over T control steps; episode k began with seed ``seeds[k]``. Leading dimension T + 1 for
    states, T for rewards. An episode that has ended goes on, as in stock ManiSkill: `length` says where it ended."""

    seeds: list[int] = field(default_factory=list)
    poses: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0, 0, 7), np.float32))
    """(T + 1, K, B, 7) position in metres, quaternion wxyz; bodies as `Checkup.bodies`."""
    qpos: NDArray[np.float32] | None = None
    """(T + 1, K, J); None without joints."""
    evaluate: dict[str, NDArray] = field(default_factory=dict)
    """(T + 1, K, ...) each."""
    reward: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(T, K)"""
    obs: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """(T + 1, K, D) by leaf, pictures left out."""
    length: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) control steps until the episode ended; T if it did not."""


class Checkup:
    """One version of a task under check. Close it in the end.

    All that calls the author's code raises `TaskError` with their line.
    """

    def __init__(
        self,
        loaded: LoadedTask,
        env_kwargs: Mapping[str, Any] | None = None,
        *,
        num_envs: int = 8,
        seeds: int = 32,
        first_seed: int = 0,
        keep_going: Callable[[], None] = lambda: None,
    ) -> None:
        """
        Args:
            keep_going: called between steps; raises to end the checks.
        """
        self.loaded = loaded
        self.env_kwargs = dict(env_kwargs or {})
        self.num_envs = num_envs
        self.seeds = list(range(first_seed, first_seed + seeds))
        self.places = Places(loaded)
        self.findings: list[Finding] = []
        """Breaches of the rules of GPU simulation, seen in all that ran so far."""
        self.failed: dict[str, TaskError] = {}
        """What raised, by the name of the evidence."""
        self._keep_going = keep_going
        self._open: list[TaskEnv] = []

    def close(self) -> None:
        while self._open:
            self._open.pop().close()
        for name in ("task", "starts", "overlaps", "still", "random"):
            self.__dict__.pop(name, None)

    # --- envs ---------------------------------------------------------------------------------------------

    @contextmanager
    def env(
        self, num_envs: int | None = None, *, render: bool = False, rules: Degree = "off", **kwargs: Any
    ) -> Iterator[TaskEnv]:
        """Another env of the task, for a `with`.

        Args:
            render: False makes no renderer, unless the task needs one to be built.
            kwargs: keyword arguments of the task class in place of the given ones.
        """
        task = self._made(num_envs or self.num_envs, render, rules, kwargs)
        try:
            yield task
        finally:
            task.close()

    @evidence
    def task(self) -> TaskEnv:
        """`num_envs` envs without a renderer, which check the rules of GPU simulation. Whoever uses it resets it first."""
        made = self._made(self.num_envs, False, "warn", {})
        self._open.append(made)
        return made

    def _made(self, num_envs: int, render: bool, rules: Degree, kwargs: Mapping[str, Any]) -> TaskEnv:
        given = constructor_arguments(self.loaded.cls, {**self.env_kwargs, **kwargs}, BaseEnv)
        options = EnvOptions(
            num_envs, "cpu", render=render, rules=rules, on_finding=self.findings.append, kwargs=given
        )
        with blamed("build", self.loaded):
            env = make_env(
                self.loaded.cls,
                options,
                asset_ids=self.loaded.asset_ids,
                default_kwargs=self.loaded.default_kwargs,
            )
            return TaskEnv(env, self.loaded.max_episode_steps)

    def reset(
        self, task: TaskEnv, seed: int | list[int] | None, env_idx: list[int] | None = None
    ) -> StepResult:
        """As `TaskEnv.reset`."""
        self._keep_going()
        with blamed("reset", self.loaded, task):
            return task.reset(seed, env_idx)

    def step(self, task: TaskEnv, action: NDArray[np.float32] | None) -> StepResult:
        """As `TaskEnv.step`."""
        self._keep_going()
        with blamed("step", self.loaded, task):
            return task.step(action)

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """(B,) names of the bodies, as in `SceneIndex.names`."""
        return scene_index(self.task.env).names

    # --- what was seen ------------------------------------------------------------------------------------

    def batches(self) -> Iterator[list[int]]:
        """The seeds, `num_envs` at a time; the last ones go on counting so that every batch is full."""
        count, n = len(self.seeds), self.num_envs
        for first in range(0, count, n):
            yield [self.seeds[0] + first + i for i in range(n)]

    @evidence
    def starts(self) -> Episodes:
        """All seeds, right after their reset (T = 0)."""
        return self._episodes(lambda task, step: None, 0)

    @evidence
    def still(self) -> Episodes:
        """All seeds, while the robot holds the pose of the reset for `STILL_SECONDS`."""
        held: dict[int, NDArray[np.float32]] = {}

        def hold(task: TaskEnv, step: int) -> NDArray[np.float32]:
            # Of the pose at the reset: the present one would follow a robot that sags.
            if step == 0:
                held[0] = actions.hold_action(task.parts, task.num_envs)
            return held[0]

        return self._episodes(hold, max(1, round(STILL_SECONDS / self.task.control_dt)))

    @evidence
    def random(self) -> Episodes:
        """All seeds, under random actions, to the end of the episode or `ROLLOUT_STEPS`."""
        rng = np.random.default_rng(0)
        return self._episodes(
            lambda task, step: actions.random_action(task.parts, task.num_envs, rng),
            min(self.loaded.max_episode_steps or ROLLOUT_STEPS, ROLLOUT_STEPS),
        )

    @evidence
    def overlaps(self) -> dict[int, tuple[Overlap, ...]]:
        """The bodies that are inside each other right after a reset, for each seed."""
        found: dict[int, tuple[Overlap, ...]] = {}
        for seeds in self.batches():
            self.reset(self.task, seeds)
            self.first_substep(self.task)
            found |= {seed: overlaps_of(self.task, env) for env, seed in enumerate(seeds)}
        return found

    @evidence
    def tensor_uses(self) -> TensorUses:
        """What the author's lines do with tensors: at a build, a reset and three steps."""
        watch = TensorWatch({str(file) for file in self.loaded.source_files})
        with watch, self.env(NUM_ENVS) as task:
            self.reset(task, self.seeds[0])
            rng = np.random.default_rng(0)
            for _ in range(3):
                action = actions.random_action(task.parts, NUM_ENVS, rng)
                with watch.step():
                    self.step(task, action)
        return watch.uses

    def first_substep(self, task: TaskEnv) -> None:
        """One substep of physics: the contacts that it finds are those of the state before it."""
        with blamed("step", self.loaded, task):
            task.env.scene.step()

    def _episodes(self, choose: Callable[[TaskEnv, int], Any], steps: int) -> Episodes:
        together: list[Episodes] = []
        for seeds in self.batches():
            states = [self.reset(self.task, seeds)]
            obs = [read_obs(self.task)]
            rewards: list[NDArray[np.float32]] = []
            length = np.full(len(seeds), steps)
            over = np.zeros(len(seeds), bool)
            for step in range(steps):
                now = self.step(self.task, choose(self.task, step))
                rewards.append(now.reward)
                states.append(now)
                obs.append(read_obs(self.task))
                ended = (now.terminated | now.truncated) & ~over
                length[ended] = step + 1
                over |= ended
            together.append(_stacked(seeds, states, rewards, obs, length))
        return _joined(together)


def read_obs(task: TaskEnv) -> dict[str, NDArray[np.float64]]:
    """(N, D) of each leaf of the present observation that is no picture; of a flat one, a single leaf ``obs``."""
    read: dict[str, NDArray[np.float64]] = {}
    for name, value in flat_entries(task.obs):
        if not isinstance(value, torch.Tensor) or value.ndim == 0 or len(value) != task.num_envs:
            continue
        if value.numel() <= MOST_OBS * task.num_envs and not value.is_complex():
            read[name or "obs"] = value.reshape(task.num_envs, -1).double().numpy(force=True).copy()
    return read


def overlaps_of(task: TaskEnv, env: int) -> tuple[Overlap, ...]:
    """The bodies that were inside each other at the begin of the last substep, deepest first. Links of one articulation
    that touch are left out: its joints hold them."""
    deepest: dict[tuple[str, str], float] = {}
    for contact in list_contacts(task.env, env):
        first, second = sorted(contact.bodies)
        if first.split("/")[0] == second.split("/")[0] and "/" in first:
            continue
        depth = -float(contact.separations.min(initial=0.0))
        if depth > deepest.get((first, second), 0.0):
            deepest[first, second] = depth
    return tuple(Overlap(pair, depth) for pair, depth in sorted(deepest.items(), key=lambda item: -item[1]))


def finding_of(rule: str, degree: Degree, found: Found) -> Finding:
    """The finding, with the text of its line."""
    file, line, function = found.place or (None, None, "")
    code = "" if file is None or line is None else linecache.getline(file, line).strip()
    return Finding(rule, degree, found.message, file, line, code, function, found.count, 0)


def _stacked(
    seeds: list[int],
    states: list[StepResult],
    rewards: list[NDArray[np.float32]],
    obs: list[dict[str, NDArray[np.float64]]],
    length: NDArray[np.int64],
) -> Episodes:
    names = [name for name in states[0].evaluate if all(name in state.evaluate for state in states)]
    # The reward's terms exist from the first step on.
    late = [name for name in states[-1].evaluate if name not in names]
    leaves = [name for name in obs[0] if all(name in one for one in obs)]
    return Episodes(
        seeds=list(seeds),
        poses=np.stack([state.poses for state in states]),
        qpos=None if states[0].qpos is None else np.stack([s.qpos for s in states if s.qpos is not None]),
        evaluate={
            **{name: np.stack([state.evaluate[name] for state in states]) for name in names},
            **{
                name: np.stack([state.evaluate[name] for state in [states[1], *states[1:]]])
                for name in late
                if all(name in state.evaluate for state in states[1:])
            },
        },
        reward=np.stack(rewards) if rewards else np.zeros((0, len(seeds)), np.float32),
        obs={name: np.stack([one[name] for one in obs]) for name in leaves},
        length=length,
    )


def _joined(parts: list[Episodes]) -> Episodes:
    names = [name for name in parts[0].evaluate if all(name in part.evaluate for part in parts)]
    leaves = [name for name in parts[0].obs if all(name in part.obs for part in parts)]
    qpos = [part.qpos for part in parts if part.qpos is not None]
    return Episodes(
        seeds=[seed for part in parts for seed in part.seeds],
        poses=np.concatenate([part.poses for part in parts], axis=1),
        qpos=np.concatenate(qpos, axis=1) if len(qpos) == len(parts) else None,
        evaluate={name: np.concatenate([part.evaluate[name] for part in parts], axis=1) for name in names},
        reward=np.concatenate([part.reward for part in parts], axis=1),
        obs={name: np.concatenate([part.obs[name] for part in parts], axis=1) for name in leaves},
        length=np.concatenate([part.length for part in parts]),
    )
