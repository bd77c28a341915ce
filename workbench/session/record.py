"""Record episodes without a page: as many envs at once as asked for, in one process or several.

Each episode is started by a reset of its env alone with a seed of its own, so that episode k of a recording is the one
that ``gym.make(...).reset(seed=seed + k)`` starts, whatever the number of envs and processes; and its actions are its
own too (`record_acting`). Which episodes there are, and which are kept, is the `Dealer`'s matter: here, or in
the process that started this one. What is here is what one process does: envs that are free take the next episode,
all make a step, and what is over waits for the word that it is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from workbench.authoring.reference import named_file
from workbench.core.broken_rule import warn_of
from workbench.core.pictures import Picture
from workbench.core.recorded_state import apart, write_states
from workbench.core.rules import Finding
from workbench.core.state_columns import read_state_columns
from workbench.core.state_names import states_of
from workbench.core.step import StepResult
from workbench.core.step_pictures import step_pictures
from workbench.machine.current_folder import CurrentFolder
from workbench.recording.episode_writer import EpisodeFiles
from workbench.recording.landing import RecordingError
from workbench.session.acting import Acting
from workbench.session.dealer import Dealer
from workbench.session.episode_files import EpisodeFinisher
from workbench.session.episodes import EpisodeGatherer, GatheredEpisode
from workbench.session.given_actions import SUFFIXES, GivenEpisode, GivenEpisodes, read_given
from workbench.session.messages import Stepped, TaskOptions
from workbench.session.open_task import OpenedTask, blamed, open_task, reset_checked, step_checked
from workbench.session.record_acting import RecordActing
from workbench.session.recorded_pictures import recorded_pictures

_STEPS_WITHOUT_LIMIT = 200
_TRIES = 100
"""For each success that is wanted."""
_ELSEWHERE = 1e-4
"""Metres, or radians: a start that is further from the demonstration's is another start."""


@dataclass(frozen=True)
class RecordOptions:
    task: str
    out: Path
    episodes: int | None = None
    """How many; None for 4, or for as many as the file of actions has."""
    successes: int | None = None
    """Record until so many succeeded, and keep no others."""
    tries: int | None = None
    """Give up after so many episodes where successes are wanted; None for 100 for each."""
    actions: str = "random"
    """``random``, ``zero``, ``hold``, a policy ``module:function`` or ``file.py:function``, or a file of actions."""
    use_env_states: bool = False
    """Put every env state of a demonstration back after its step, so that nothing drifts."""
    pictures: bool = True
    max_steps: int | None = None
    """Longest episode; None takes the task's own limit, or 200 steps where it has none."""
    workers: int = 1
    """Processes; each has its share of the envs."""
    options: TaskOptions = field(default_factory=lambda: TaskOptions(num_envs=4))


@dataclass(frozen=True)
class Written:
    """An episode that is on the disk."""

    index: int
    """Which of the recording it is."""
    path: Path
    """Its .rrd; the .h5 and .json lie beside it."""
    seed: int
    steps: int
    total_reward: float
    success: bool | None


@dataclass(frozen=True)
class Progress:
    kept: int
    """Episodes that are kept so far."""
    steps: int
    """Control steps made so far, over all envs with an episode."""


@dataclass(frozen=True)
class Recorded:
    """What came of it."""

    written: tuple[Written, ...]
    """In the order of their numbers."""
    tried: int
    """Episodes that it took."""
    stopped: bool
    """Somebody ended it before."""
    put_right: int = 0
    """Episodes whose seed gives another start than the demonstration's, and that were put to its first state."""


class Dealing(Protocol):
    """Who says which episodes are made and kept; a `Dealer`, or one in another process."""

    def next(self) -> int | None: ...

    def ended(self, index: int, success: bool) -> None: ...

    def decided(self) -> list[tuple[int, bool]]: ...

    def wait(self) -> None:
        """Until something may have been decided: nothing is under way here."""
        ...


class _OwnDealing(Dealer):
    def wait(self) -> None:
        raise AssertionError("an episode waits for others, and none is under way")


def with_given_actions(what: RecordOptions) -> tuple[RecordOptions, GivenEpisodes | None]:
    """What is asked for, with what the file of actions says of it: how many episodes, the control mode.

    Raises:
        FileNotFoundError, ValueError: as `read_given`; or the numbers asked for make no sense.
    """
    given = None
    if Path(what.actions).suffix in SUFFIXES:
        given = read_given(Path(what.actions))
        options = what.options
        options = replace(options, env_kwargs={**given.env_kwargs, **options.env_kwargs})
        what = replace(what, options=options)
    if what.use_env_states and (given is None or not all(episode.states for episode in given.episodes)):
        raise ValueError("--use-env-states needs --actions FILE.h5 with env states in it")
    if what.episodes is not None and what.successes is not None:
        raise ValueError("--episodes and --successes: name one of them")
    for name, number in (
        ("episodes", what.episodes),
        ("successes", what.successes),
        ("tries", what.tries),
        ("workers", what.workers),
        ("max-steps", what.max_steps),
    ):
        if number is not None and number < 1:
            raise ValueError(f"--{name} must be at least 1, not {number}")
    several = 0 if given is None or len(given) == 1 else len(given)
    if what.successes is None:
        episodes = what.episodes or (len(given) if given is not None else 4)
        if several and episodes > several:
            raise ValueError(f"{what.actions} has {several} episodes, and --episodes asks for {episodes}")
        return replace(what, episodes=episodes), given
    most = what.tries or _TRIES * what.successes
    return replace(what, tries=min(most, several) if several else most), given


def dealer_of(what: RecordOptions) -> Dealer:
    """Of options that went through `with_given_actions`."""
    if what.successes is None:
        assert what.episodes is not None
        return _OwnDealing(what.episodes)
    return _OwnDealing(what.successes, only_successes=True, most=what.tries)


def record(
    what: RecordOptions,
    on_activity: Callable[[str], None] = lambda activity: None,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    on_finding: Callable[[Finding], None] = warn_of,
) -> Recorded:
    """Record into ``what.out``, in this process or, with several workers, in processes of their own.

    Args:
        on_finding: called with each place where the task breaks a rule that does not stop it, once.
        stop: asked between steps; when it says yes, what is over is kept, the rest is not, and that is it.

    Raises:
        TaskError: the task cannot be opened, or fails while it runs.
        RecordingError: a file cannot be written.
        FileNotFoundError, ValueError: what is asked for makes no sense.
    """
    what, given = with_given_actions(what)
    if what.workers > 1:
        from workbench.session.record_workers import record_in_processes

        return record_in_processes(what, dealer_of(what), on_activity, on_progress, stop, on_finding)
    dealer = dealer_of(what)
    written: list[Written] = []
    steps = 0

    def on_steps(count: int) -> None:
        nonlocal steps
        steps += count
        on_progress(Progress(dealer.kept, steps))

    put_right = run_episodes(
        what,
        given,
        dealer,  # type: ignore[arg-type]
        written.append,
        on_activity,
        on_steps,
        stop,
        on_finding,
    )
    written.sort(key=lambda episode: episode.index)
    return Recorded(tuple(written), dealer.tried, stop(), put_right)


def run_episodes(
    what: RecordOptions,
    given: GivenEpisodes | None,
    dealing: Dealing,
    on_written: Callable[[Written], None],
    on_activity: Callable[[str], None],
    on_steps: Callable[[int], None],
    stop: Callable[[], bool],
    on_finding: Callable[[Finding], None],
) -> int:
    """One process's share; returns how many starts were put right. Raises as `record`.

    Args:
        on_written: called with each episode that is kept when its files are there.
        on_steps: called after each control step of the batch with the number of envs that had an episode.
    """
    torch.set_num_threads(1)  # see workbench.session.worker.work
    here = CurrentFolder()  # the task may go to another
    with here.again():
        return _run_share(what, here, given, dealing, on_written, on_activity, on_steps, stop, on_finding)


def _run_share(
    what: RecordOptions,
    here: CurrentFolder,
    given: GivenEpisodes | None,
    dealing: Dealing,
    on_written: Callable[[Written], None],
    on_activity: Callable[[str], None],
    on_steps: Callable[[int], None],
    stop: Callable[[], bool],
    on_finding: Callable[[Finding], None],
) -> int:
    folder = what.out.absolute()
    opened = open_task(what.task, what.options, on_activity=on_activity, on_finding=on_finding)
    finisher = EpisodeFinisher()
    share = _Share(opened, what, here, folder, given, dealing, finisher, on_written)
    try:
        share.run(on_steps, stop)
    finally:
        try:
            share.give_up()
            finisher.close()
            share.collect()
        finally:
            opened.env.close()
    return share.put_right


class _Share:
    """The episodes that one process makes."""

    def __init__(
        self,
        opened: OpenedTask,
        what: RecordOptions,
        here: CurrentFolder,
        folder: Path,
        given: GivenEpisodes | None,
        dealing: Dealing,
        finisher: EpisodeFinisher,
        on_written: Callable[[Written], None],
    ) -> None:
        self._opened, self._what, self._given, self._dealing = opened, what, given, dealing
        self._finisher, self._on_written = finisher, on_written
        self._envs = list(range(opened.env.num_envs))
        self._gatherer = EpisodeGatherer(opened.description, self._envs, folder, self._over, ends="reset")
        plain = given is None and what.actions != "random"
        self._acting = RecordActing(_acting(what, here) if plain else None)
        self._wanted = recorded_pictures(opened.description.cameras) if what.pictures else ()
        self._running: dict[int, int] = {}
        """Number of the episode in each env that has one."""
        self._steps: dict[int, int] = {}
        self._undecided: dict[int, GatheredEpisode] = {}
        self._made: list[tuple[int, GatheredEpisode, Future[EpisodeFiles | str]]] = []
        self.put_right = 0

    def run(self, on_steps: Callable[[int], None], stop: Callable[[], bool]) -> None:
        """Until there is nothing more to make, or somebody stops it."""
        limit = self._what.max_steps or self._opened.description.max_episode_steps or _STEPS_WITHOUT_LIMIT
        while not stop():
            self._hear()
            for env in self._envs:
                if env not in self._running and (index := self._dealing.next()) is not None:
                    self._begin(env, index)
            if not self._running:
                self._hear()
                if not self._undecided:
                    return
                self._dealing.wait()
                continue
            step = self._step()
            on_steps(len(self._running))
            for env, index in list(self._running.items()):
                self._steps[env] += 1
                given = self._given_of(index)
                if given is not None:
                    over = self._steps[env] >= min(len(given.actions), self._what.max_steps or 10**9)
                else:
                    over = step.terminated[env] or step.truncated[env] or self._steps[env] >= limit
                if over:
                    self._gatherer.end(env)
                    del self._running[env]
                    self._acting.end(env)
            self.collect()

    def give_up(self) -> None:
        """What is under way is not kept. Of what is over and undecided, the successes are."""
        for env in list(self._running):
            self._gatherer.drop(env)
        self._running.clear()
        for index in list(self._undecided):
            self._decide(index, True)

    def collect(self) -> None:
        """Tell of the episodes whose files are there.

        Raises:
            RecordingError: those of one cannot be written.
        """
        waiting = []
        for index, episode, future in self._made:
            if not future.done():
                waiting.append((index, episode, future))
                continue
            files = future.result()
            if isinstance(files, str):
                raise RecordingError(files)
            shown = self._what.out / files.rrd.name  # as the person named the folder
            self._on_written(
                Written(index, shown, episode.seed, episode.steps, episode.total_reward, episode.success)
            )
        self._made = waiting

    # --- one episode -----------------------------------------------------------------------------------

    def _given_of(self, index: int) -> GivenEpisode | None:
        return None if self._given is None else self._given.of(index)

    def _begin(self, env: int, index: int) -> None:
        task, given = self._opened.env, self._given_of(index)
        seed = self._what.options.seed + index
        if given is not None and given.seed is not None:
            seed = given.seed
        step = reset_checked(task, self._opened.loaded, seed, [env])
        if given is not None and given.states:
            step = self._put_right(env, given, step)
        self._running[env], self._steps[env] = index, 0
        self._gatherer.acted_by = self._acting.begin(env, seed, given)
        mask = np.zeros(task.num_envs, bool)
        mask[env] = True
        self._gatherer.take(self._stepped(step, mask, [env]))

    def _put_right(self, env: int, given: GivenEpisode, step: StepResult) -> StepResult:
        first = {name: values[0] for name, values in given.states.items()}
        task = self._opened.env
        if max(apart(states_of(read_state_columns(task), env), first)) <= _ELSEWHERE:
            return step
        self.put_right += 1
        with blamed("restore", self._opened.loaded, task):
            write_states(task.env, {env: first})
            return task.judge()

    def _step(self) -> StepResult:
        task, loaded = self._opened.env, self._opened.loaded
        action = self._acting.next_action(task, {env: self._steps[env] for env in self._running})
        step = step_checked(task, loaded, action)
        if self._what.use_env_states:
            states: dict[int, Mapping[str, np.ndarray]] = {}
            for env, index in self._running.items():
                given = self._given_of(index)
                assert given is not None
                states[env] = {name: values[self._steps[env] + 1] for name, values in given.states.items()}
            with blamed("restore", loaded, task):
                write_states(task.env, states)
                step = task.judge(action)
        none = np.zeros(task.num_envs, bool)
        self._gatherer.take(self._stepped(step, none, sorted(self._running)))
        return step

    def _stepped(self, step: StepResult, reset_mask: np.ndarray, pictured: list[int]) -> Stepped:
        task = self._opened.env
        pictures: tuple[Picture, ...] = ()
        for env in pictured:
            pictures += step_pictures(task, env, self._wanted)
        with blamed("step", self._opened.loaded, task):
            columns = read_state_columns(task)
        return Stepped(step, reset_mask, pictures, task.episode_seeds, columns=columns)

    def _over(self, episode: GatheredEpisode) -> None:
        index = self._running[episode.env]
        self._undecided[index] = episode
        self._dealing.ended(index, bool(episode.success))

    def _hear(self) -> None:
        for index, keep in self._dealing.decided():
            self._decide(index, keep)

    def _decide(self, index: int, keep: bool) -> None:
        episode = self._undecided.pop(index, None)
        if episode is None:
            for env in [env for env, running in self._running.items() if running == index]:
                self._gatherer.drop(env)
                del self._running[env]
                self._acting.end(env)
        elif keep:
            self._made.append((index, episode, self._finisher.finish(episode)))
        else:
            episode.writer.discard()


def _acting(what: RecordOptions, here: CurrentFolder) -> Acting:
    acting = Acting(here)
    acting.seed(what.options.seed)
    if what.actions in ("hold", "zero"):
        acting.use(what.actions, None)
    else:
        with here.again():
            file = named_file(what.task)
        acting.use("policy", what.actions, None if file is None else file.parent)
    return acting
