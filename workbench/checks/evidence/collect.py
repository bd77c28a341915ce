"""Envs of one version of a task, and the evidence that checks read from them. Each piece of evidence is collected once."""

from __future__ import annotations

import linecache
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from typing import Any, TypeVar

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from numpy.typing import NDArray

from workbench.checks.evidence.builds import (
    Built,
    Merged,
    PoseSet,
    noting_builds,
    noting_poses,
    shapes_of_env,
)
from workbench.checks.evidence.places import Places
from workbench.checks.evidence.rolled_episodes import Actor, Episodes, SeenOutliers, joined, stacked
from workbench.checks.evidence.tensor_watch import NUM_ENVS, TensorUses, TensorWatch
from workbench.checks.results import Silenced
from workbench.envs import action_vector as actions
from workbench.envs.assets import MissingAssets
from workbench.envs.backends import find_renderer
from workbench.envs.broken_rule import BrokenRules, Place
from workbench.envs.cpu_scene import BatchedCpuMixin
from workbench.envs.evaluate_entries import flat_entries
from workbench.envs.gpu_rules import Degree, Finding
from workbench.envs.inspection import Overlap
from workbench.envs.keywords import constructor_arguments
from workbench.envs.maniskill_private import apply_and_fetch
from workbench.envs.outliers import OutlierWatch
from workbench.envs.overlaps import first_substep, overlaps_of
from workbench.envs.scene.read_scene import read_geometry
from workbench.envs.scene.scene_index import scene_index
from workbench.envs.scene.shapes import SceneGeometry
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
from workbench.task.blame import blamed, returns_check
from workbench.task.load import LoadedTask
from workbench.task.problem import Problem, TaskError

ROLLOUT_STEPS = 50
"""Maximum number of control steps of a random episode."""
STILL_SECONDS = 1.0
"""Simulated seconds for which the robot holds still."""
PICTURED_ENVS = 2
"""Number of envs that observe pictures; small because a reset renders all of their cameras."""
FIRST_BUILT_SEED = 2022
"""Seed with which BaseEnv's constructor builds env 0; env i has this seed plus i."""
SEEDS_ALONE = 2
"""Number of seeds for which a single env is built."""
MAX_LEAF_NUMBERS = 4096
"""Maximum number of values per env in a leaf of the observation; a larger leaf counts as a picture."""


@dataclass(frozen=True)
class Found:
    """A breach of a rule, before its degree is known."""

    message: str
    """What is wrong, with numbers, and what to write instead, in one or two sentences."""
    place: Place | None
    """File, line and function; None if no line is at fault."""
    count: int = 1
    """Number of envs, seeds or steps with the breach."""


@dataclass(frozen=True)
class Note:
    """Something worth knowing that breaks no rule."""

    message: str


Check = Callable[["Checkup"], Iterator[Found | Note]]
"""Yields the breaches of one rule. If there are none, the rule is kept, unless the check raises NotApplicable
or NotKnown, at its start or at its end."""
_Value = TypeVar("_Value")


class NotApplicable(Exception):
    """The rule says nothing about this task. The text is the reason, such as "the task has no reward"."""


class NotKnown(Exception):
    """The rule was not tried, or not to the end. The text is the reason, such as "no tried episode succeeds"."""


class CheckEnded(Exception):
    """No result is needed any more. `keep_going` of a `Checkup` raises this."""


def evidence(see: Callable[[Checkup], _Value]) -> cached_property[_Value]:
    """A property of a `Checkup` that is computed once; if it raises, it raises the same error each time."""

    @wraps(see)
    def once(self: Checkup) -> _Value:
        return self._once(see)

    return cached_property(once)


@dataclass(frozen=True)
class Alone:
    """What a single env builds."""

    shapes: dict[int, tuple[Any, ...]]
    """`shapes_of_env` by seed."""
    rebuilds: bool
    """Whether the env is rebuilt at resets."""
    overlaps: tuple[Overlap, ...]
    """Overlaps of the bodies as they are built, before the first reset."""
    seeds: tuple[int, ...]
    """Seeds with which the env was built."""


class Checkup:
    """One version of a task under check. The caller closes it.

    Every method that calls the author's code raises `TaskError` with the author's line. If `num_envs` is 1,
    the checkup makes no batch of several envs.
    """

    def __init__(
        self,
        loaded: LoadedTask,
        env_kwargs: Mapping[str, Any] | None = None,
        *,
        num_envs: int = 8,
        seeds: int = 32,
        first_seed: int = 0,
        actors: Sequence[Actor] = (),
        keep_going: Callable[[], None] = lambda: None,
    ) -> None:
        """
        Args:
            seeds: number of seeds.
            actors: actors of further episodes, in addition to random actions.
            keep_going: called between steps; raises CheckEnded to end the checks.
        """
        self.loaded = loaded
        self.env_kwargs = dict(env_kwargs or {})
        self.num_envs = num_envs
        self.seeds = list(range(first_seed, first_seed + seeds))
        self.actors = tuple(actors)
        self.places = Places(loaded)
        self.findings: list[Finding] = []
        """Breaches of the rules of GPU simulation so far."""
        self.failed: dict[Callable[[Checkup], Any], Exception] = {}
        """Error of each piece of evidence that raised."""
        self.files = frozenset(str(file) for file in loaded.source_files)
        self.builds: list[Built] = []
        """Bodies that `task` has built."""
        self.merges: list[Merged] = []
        self.picture_seconds = 0.0
        """Seconds that the first pictures of the process took."""
        self._keep_going = keep_going
        self._open: list[TaskEnv] = []
        self._built_with_renderer = False
        self._rules: BrokenRules | None = None
        self._silenced_before: list[Silenced] = []
        self._looked: dict[Callable[[Checkup], Any], Any] = {}

    def close(self) -> None:
        while self._open:
            # An error while closing changes no result: all results are known.
            with suppress(TaskError):
                self._close(self._open.pop())
        self._looked.clear()
        for name, member in vars(Checkup).items():
            if isinstance(member, cached_property):
                self.__dict__.pop(name, None)

    def go_on_with_one_env(self) -> None:
        """Continue with one env, for a task that uses something that exists for one env only. All evidence
        from several envs is forgotten, except breaches of the rules of GPU simulation."""
        self._silenced_before = self.silenced
        self.close()
        self.num_envs, self._rules = 1, None
        for seen in (self.failed, self.builds, self.merges):
            seen.clear()

    def _once(self, see: Callable[[Checkup], _Value]) -> _Value:
        """The value of `see`; if it raised before, raises the same error."""
        if (known := self.failed.get(see)) is not None:
            raise known
        try:
            return see(self)
        except CheckEnded:
            raise
        except Exception as error:
            self.failed[see] = error
            raise

    # --- envs ---------------------------------------------------------------------------------------------

    def require_several(self) -> None:
        """Raise NotKnown if there is one env only."""
        if self.num_envs == 1:
            raise NotKnown("the rule needs several envs, and one was checked")

    def require_source(self) -> None:
        """Raise NotKnown for a class without a file: from a notebook, or shipped as bytecode."""
        if not self.places.modules:
            raise NotKnown("the source of the task is not known")

    def require_task(self) -> None:
        """Raise NotApplicable for a robot that is shown in a scene of ManiSkill: the author wrote no task."""
        if self.loaded.robot is not None:
            raise NotApplicable("the class is a robot in one of ManiSkill's scenes, not a task")

    def at_most(self, wanted: int) -> int:
        """Number of envs to make: `wanted`, or 1 if the checkup has one env."""
        return wanted if self.num_envs > 1 else 1

    @contextmanager
    def env(
        self, num_envs: int | None = None, *, render: bool = False, rules: Degree = "off", **kwargs: Any
    ) -> Iterator[TaskEnv]:
        """Context with another env of the task.

        Args:
            render: whether to make a renderer. It is made in any case if the task cannot be built without
                one.
            kwargs: keyword arguments of the task class, which replace those of `env_kwargs`.
        """
        task = self._made(num_envs or self.num_envs, render or self._needs_renderer, rules, kwargs)
        try:
            yield task
        except BaseException:
            with suppress(TaskError):  # the first error is raised
                self._close(task)
            raise
        self._close(task)

    def _close(self, task: TaskEnv) -> None:
        with blamed("step", self.loaded, task):
            task.close()

    @evidence
    def task(self) -> TaskEnv:
        """`num_envs` envs that check the rules of GPU simulation. They have a renderer only if the task
        cannot be built without one. Reset them before use."""
        with noting_builds(self.builds, self.merges, self.files):
            made = self._without_renderer()
            # Not inside an `except`: an error of this build would name the error of the build without a
            # renderer as its cause.
            if made is None:
                for noted in (self.findings, self.builds, self.merges):
                    noted.clear()
                made = self._made(self.num_envs, True, "warn", {})
                self._built_with_renderer = True
        self._open.append(made)
        self._rules = made.broken_rules
        return made

    def _without_renderer(self) -> TaskEnv | None:
        """The envs without a renderer; None if the build fails and may succeed with one."""
        try:
            return self._made(self.num_envs, False, "warn", {})
        except TaskError as error:
            # A missing renderer raises errors of many kinds: only a second try, with a renderer, shows
            # whether the task needs one.
            if isinstance(error.__cause__, (MissingAssets, ImportError)):
                raise
            if not self._may_render:
                why = f"{error.problem.message} ({self._why_no_renderer})"
                raise TaskError(replace(error.problem, message=why)) from error
        return None

    @property
    def silenced(self) -> list[Silenced]:
        """Breaches of the rules of GPU simulation so far that a comment silences."""
        known = () if self._rules is None else self._rules.silenced
        of_task = [Silenced(finding, silence.reason, silence.line) for finding, silence in known]
        return [*self._silenced_before, *of_task]

    @property
    def _needs_renderer(self) -> bool:
        """Whether the task cannot be built without a renderer."""
        return bool(self.task) and self._built_with_renderer

    @property
    def _may_render(self) -> bool:
        """Whether a failed build can be tried again with a renderer: a renderer is found, and no argument
        chooses a render backend."""
        return self._render_backend == "found" and find_renderer() is not None

    @property
    def _why_no_renderer(self) -> str:
        if self._render_backend == "none":
            return "built with render_backend=none: leave this argument out if the task needs a renderer"
        return "built without a renderer: none was found on this machine, see `workbench doctor`"

    @property
    def _render_backend(self) -> Any:
        """The given render backend: ``none`` or a name; ``found`` if none was given."""
        given = {**self.loaded.default_kwargs, **self.env_kwargs}
        # ManiSkill also takes None for "none".
        return given.get("render_backend", "found") or "none"

    @evidence
    def pictured(self) -> TaskEnv:
        """`PICTURED_ENVS` envs that observe pictures. Reset them before use.

        Raises:
            NotApplicable: the task has no observation mode with pictures.
            NotKnown: there is no renderer.
        """
        modes = self.loaded.cls.SUPPORTED_OBS_MODES
        wanted = [m for m in ("rgb", "rgbd", "depth") if m in modes or "any_textures" in modes]
        if not wanted:
            raise NotApplicable("the task has no observation mode with pictures")
        if self._render_backend == "none":
            raise NotKnown("the task is made without a renderer (render_backend=none)")
        if find_renderer() is None:
            raise NotKnown("no renderer was found on this machine, see `workbench doctor`")
        began = time.monotonic()
        made = self._made(self.at_most(PICTURED_ENVS), True, "off", {"obs_mode": wanted[0]})
        self._open.append(made)
        self.picture_seconds = time.monotonic() - began
        return made

    def look(self, see: Callable[[Checkup], _Value]) -> _Value:
        """The value of `see`, which is evidence that a module of rules defines. It is computed once; if `see`
        raised, the same error is raised again."""
        if see not in self._looked:
            self._looked[see] = self._once(see)
        return self._looked[see]

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
            if isinstance(env, BatchedCpuMixin):
                # Without this, earlier episodes change the last bits of the physics, and a touch sensor reads
                # the contacts of the episode before.
                env.begins_anew = True
            return TaskEnv(env, self.loaded.max_episode_steps, check=returns_check(self.loaded, num_envs))

    def reset(
        self, task: TaskEnv, seed: int | list[int] | None, env_idx: list[int] | None = None
    ) -> StepResult:
        """Reset envs, as `TaskEnv.reset`."""
        self._keep_going()
        with blamed("reset", self.loaded, task):
            return task.reset(seed, env_idx)

    def step(self, task: TaskEnv, action: NDArray[np.float32] | None) -> StepResult:
        """Make a control step, as `TaskEnv.step`."""
        self._keep_going()
        with blamed("step", self.loaded, task):
            return task.step(action)

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        """(B,) names of the bodies, as in `SceneIndex.names`."""
        return scene_index(self.task.env).names

    # --- what was seen ------------------------------------------------------------------------------------

    def batches(self) -> Iterator[list[int]]:
        """The seeds, `num_envs` at a time; the last batch is filled up with further seeds."""
        count, n = len(self.seeds), self.num_envs
        for first in range(0, count, n):
            yield [self.seeds[0] + first + i for i in range(n)]

    @evidence
    def starts(self) -> Episodes:
        """Episodes of all seeds, right after their reset (T = 0)."""
        hold = _FromSeeds(self, "still", 0, lambda task, step: actions.hold_action(task.parts, task.num_envs))
        return self._episodes(hold)

    @evidence
    def still(self) -> Episodes:
        """Episodes of all seeds in which the robot holds the pose of the reset for `STILL_SECONDS`."""
        held: dict[int, NDArray[np.float32]] = {}

        def hold(task: TaskEnv, step: int) -> NDArray[np.float32]:
            # Computed once, for the pose of the reset: an action for the current pose would follow a robot
            # that sags.
            if step == 0:
                held[0] = actions.hold_action(task.parts, task.num_envs)
            return held[0]

        steps = max(1, round(STILL_SECONDS / self.task.control_dt))
        return self._episodes(_FromSeeds(self, "still", steps, hold))

    @evidence
    def random(self) -> Episodes:
        """Episodes of all seeds with random actions, up to the time limit but at most `ROLLOUT_STEPS`."""
        rng = np.random.default_rng(0)
        steps = min(self.loaded.max_episode_steps or ROLLOUT_STEPS, ROLLOUT_STEPS)
        actor = _FromSeeds(
            self, "random", steps, lambda task, step: actions.random_action(task.parts, task.num_envs, rng)
        )
        return self._episodes(actor, watched=True)

    @evidence
    def acted(self) -> tuple[Episodes, ...]:
        """The episodes of each of the actors."""
        return tuple(self._episodes(actor) for actor in self.actors)

    @property
    def rollouts(self) -> Iterator[Episodes]:
        """The random episodes, then those of each actor."""
        yield self.random
        yield from self.acted

    @evidence
    def overlaps(self) -> dict[int, tuple[Overlap, ...]]:
        """Overlapping bodies right after a reset, by seed."""
        found: dict[int, tuple[Overlap, ...]] = {}
        for seeds in self.batches():
            self.reset(self.task, seeds)
            self.first_substep(self.task)
            found |= {
                seed: overlaps_of(self.task.env, env) for env, seed in enumerate(seeds) if seed in self.seeds
            }
        return found

    @evidence
    def tensor_uses(self) -> TensorUses:
        """Uses of tensors in the author's lines, in a build, a reset and three steps."""
        count = self.at_most(NUM_ENVS)
        watch = TensorWatch({str(file) for file in self.loaded.source_files}, count)
        render = self._needs_renderer  # outside the watch: this builds `task`
        with watch, self.env(count, render=render) as task:
            self.reset(task, self.seeds[0])
            rng = np.random.default_rng(0)
            for _ in range(3):
                action = actions.random_action(task.parts, count, rng)
                with watch.step():
                    self.step(task, action)
        return watch.uses

    @evidence
    def alone(self) -> Alone:
        """Builds of a single env, for the seeds with which the first envs of `task` were built."""
        seeds = [FIRST_BUILT_SEED + i for i in range(SEEDS_ALONE)]
        built: list[Built] = []
        shapes: dict[int, tuple[Any, ...]] = {}
        render = self._needs_renderer  # before the builds are noted: this builds `task`
        with noting_builds(built, [], self.files), self.env(1, render=render) as task:
            rebuilds = task.env.reconfiguration_freq != 0
            for seed in seeds:
                if shapes:
                    built.clear()
                    with blamed("reset", self.loaded, task):
                        task.reset(seed, options={"reconfigure": True})
                shapes[seed] = shapes_of_env(built, 0)
            put_where_built(task)
            self.first_substep(task)
            return Alone(shapes, rebuilds, overlaps_of(task.env, 0), tuple(seeds))

    @evidence
    def fails_with_several(self) -> Problem | None:
        """The error that several envs raise in a reset and three steps; None if they raise none, or if one
        env alone raises too."""
        several, alone = (self._raises_early(count) for count in (self.num_envs, 1))
        return several if alone is None and self.num_envs > 1 else None

    def _raises_early(self, num_envs: int) -> Problem | None:
        rng, task = np.random.default_rng(0), None
        built = "task" in self.__dict__
        try:
            # Not with `env`, which builds `task` first: that may fail with several envs.
            task = self._made(num_envs, self._built_with_renderer if built else self._may_render, "off", {})
            self.reset(task, self.seeds[0])
            for _ in range(3):
                self.step(task, actions.random_action(task.parts, num_envs, rng))
        except TaskError as error:
            return error.problem
        finally:
            if task is not None:
                with suppress(TaskError):
                    self._close(task)
        return None

    @evidence
    def placed(self) -> list[PoseSet]:
        """Poses that a reset of the first seeds sets."""
        placed: list[PoseSet] = []
        task = self.task
        with noting_poses(placed, self.files):
            self.reset(task, next(self.batches()))
        return placed

    def first_substep(self, task: TaskEnv) -> None:
        """Make one substep of physics. Its contacts are those of the state before the substep."""
        with blamed("step", self.loaded, task):
            first_substep(task.env)

    def _episodes(self, actor: Actor, watched: bool = False) -> Episodes:
        together: list[Episodes] = []
        geometry: SceneGeometry | None = None
        task, n, steps = self.task, self.num_envs, max(actor.lengths)
        for first in range(0, len(actor.seeds), n):
            chosen = range(first, min(first + n, len(actor.seeds)))
            seeds, lengths = ([of[k] for k in chosen] for of in (actor.seeds, actor.lengths))
            self._keep_going()
            # Every env needs an episode. Envs that are left over run the last episode too, and are ignored.
            states = [actor.begin(task, [min(first + i, chosen[-1]) for i in range(n)])]
            seen = None
            if watched:
                if geometry is None or task.env.reconfiguration_freq:
                    geometry = read_geometry(task.env)
                watch = OutlierWatch(geometry, states[0], task.control_dt, task.env.reward_mode)
                seen = SeenOutliers(watch, seeds)
            obs = [read_obs(task)]
            rewards: list[NDArray[np.float32]] = []
            ends, over = np.full(n, steps), np.arange(n) >= len(chosen)
            for step in range(max(lengths)):
                now = self.step(task, actor.next_action(task, step))
                rewards.append(now.reward)
                states.append(now)
                obs.append(read_obs(task))
                ended = (now.terminated | now.truncated) & ~over
                ends[ended] = step + 1
                over |= ended
                if seen is not None:
                    seen.take(step + 1, now, over)
            outliers = () if seen is None else seen.all()
            together.append(stacked(actor.kind, seeds, lengths, steps, states, rewards, obs, ends, outliers))
        return joined(together)


@dataclass(frozen=True)
class _FromSeeds:
    """Actor that runs an episode of each seed, with the same kind of actions in all envs."""

    checkup: Checkup
    kind: str
    steps: int
    choose: Callable[[TaskEnv, int], NDArray[np.float32]]

    @property
    def seeds(self) -> list[int]:
        return self.checkup.seeds

    @property
    def lengths(self) -> list[int]:
        return [self.steps] * len(self.seeds)

    def begin(self, task: TaskEnv, episodes: Sequence[int]) -> StepResult:
        return self.checkup.reset(task, [self.seeds[k] for k in episodes])

    def next_action(self, task: TaskEnv, step: int) -> NDArray[np.float32]:
        return self.choose(task, step)


def put_where_built(task: TaskEnv) -> None:
    """Put all bodies where their builders put them, with joints at zero, as at the start of a GPU
    simulation."""
    scene: Any = task.env.scene
    for actor in scene.actors.values():
        if actor.px_body_type != "static":
            actor.set_pose(actor.initial_pose)
    for articulation in scene.articulations.values():
        articulation.set_pose(articulation.initial_pose)
        articulation.set_qpos(articulation.get_qpos() * 0)
    apply_and_fetch(task.env)


def read_obs(task: TaskEnv) -> dict[str, NDArray[np.float64]]:
    """`leaf_rows` of the present observation; a flat observation is a single leaf ``obs``."""
    return leaf_rows(task.obs, task.num_envs)


def leaf_rows(value: Any, num_envs: int) -> dict[str, NDArray[np.float64]]:
    """(N, D) values by name, of each leaf that has a row for each env and is not a picture."""
    read: dict[str, NDArray[np.float64]] = {}
    for name, leaf in flat_entries(value):
        if not isinstance(leaf, torch.Tensor) or leaf.ndim == 0 or len(leaf) != num_envs:
            continue
        if leaf.numel() <= MAX_LEAF_NUMBERS * num_envs and not leaf.is_complex():
            read[name or "obs"] = leaf.reshape(num_envs, -1).double().numpy(force=True).copy()
    return read


def finding_of(rule: str, degree: Degree, found: Found) -> Finding:
    """A finding with the text of its line."""
    file, line, function = found.place or (None, None, "")
    code = "" if found.place is None else code_of(found.place)
    return Finding(rule, degree, found.message, file, line, code, function, found.count, 0)


def code_of(place: Place) -> str:
    """The text of the line of a place, stripped."""
    return linecache.getline(place[0], place[1]).strip()
