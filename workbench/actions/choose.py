"""Chooses actions: random, zero, hold, or from sliders, a policy, a plan or a file."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from workbench.actions.policy import Policy, find_policy, load_policy, policy_problem
from workbench.actions.sources import ActionSource
from workbench.envs import action_vector as actions
from workbench.envs.recorded_run import RecordedRun
from workbench.envs.step_result import StepResult
from workbench.envs.task_env import TaskEnv, given_arguments
from workbench.episodes.reader.reading import find_sources, read_recording
from workbench.episodes.recorded_source import run_of
from workbench.machine.files import open_regular_file
from workbench.machine.folders import CurrentFolder
from workbench.planning.options import PlanOptions
from workbench.planning.planned_episodes import EpisodeLog, PlannedEpisode
from workbench.planning.planner import Planner
from workbench.planning.rollouts import require_plannable
from workbench.task.blame import blamed
from workbench.task.load import LoadedTask
from workbench.task.problem import TaskError, is_ctrl_c
from workbench.task.reference import find_module, named_file, split_reference


class ActionChooser:
    """Chooses the action of every control step for the page's batch.

    One generator for the whole batch draws the random actions and the seeds of new episodes. `seed` restarts
    it, so that the same actions and seeds follow. The random actions of one env depend on the number of envs.
    """

    def __init__(self, folder: CurrentFolder) -> None:
        """
        Args:
            folder: folder from which a relative path of a policy is resolved.
        """
        self._folder = folder
        self._source: ActionSource = "random"
        self._policy: Policy | None = None
        self._policy_name = ""
        self._task_folder: Path | None = None
        self._rng = np.random.default_rng(0)
        self._sliders: NDArray[np.float32] | None = None
        """(N, A) slider values; NaN where no slider was set. Used for deltas and velocities; joint targets
        come from `_targets`."""
        self._targets: NDArray[np.float32] | None = None
        """(N, A) values for joint targets: each env's last action, overwritten by slider values that were set
        after that action. NaN from a reset until the first action or slider value."""

    @property
    def name(self) -> str:
        """The source's name in a recording."""
        return {"hold": "hold still", "policy": f"policy {self._policy_name}"}.get(self._source, self._source)

    def seed(self, seed: int) -> None:
        """Restart the random generator from this seed."""
        self._rng = np.random.default_rng(seed)

    def fresh_seeds(self, count: int) -> list[int]:
        # Each episode has its own seed, so that its recording can name the seed that repeats it.
        return [int(seed) for seed in self._rng.integers(2**31, size=count)]

    def use(self, source: ActionSource, policy: str | None, task_folder: Path | None = None) -> None:
        """Set the source of the actions.

        Args:
            policy: the `reference` of `load_policy`. If it is None or empty, `use` does not raise, but
                `next_action` does.
            task_folder: as in `load_policy`.

        Raises:
            TaskError: the policy cannot be imported. `next_action` tries again.
        """
        self._source, self._policy_name, self._task_folder = source, policy or "", task_folder
        self._policy = self._sliders = None
        if source != "policy" or not self._policy_name:
            return
        with self._imported():
            pass

    def next_action(self, task: TaskEnv) -> NDArray[np.float32]:
        """(N, A) action of the next control step. Only the action of a policy may be outside of the bounds.

        Raises:
            TaskError: the policy raised, returned no action, or cannot be imported. The next call imports the
                policy again.
        """
        if self._source == "random":
            return actions.random_action(task.parts, task.num_envs, self._rng)
        if self._source == "policy":
            # Never fall back to another action: the page shows that the policy acts.
            with self._imported() as policy:
                return actions.to_flat_action(task.env, task.parts, policy(task.obs))
        low, high = actions.bounds(task.parts)
        if self._source == "zero":
            return _same_for_all(np.clip(0.0, low, high), task)
        if self._source == "sliders":
            return self.slider_action(task)
        return actions.hold_action(task.parts, task.num_envs)

    def slider_action(self, task: TaskEnv) -> NDArray[np.float32]:
        """(N, A) action from the sliders. A joint target keeps its last value, from an action or a slider. A
        delta or velocity keeps its slider value. A dimension without a value holds still."""
        low, high = actions.bounds(task.parts)
        action = actions.hold_action(task.parts, task.num_envs)
        is_target = actions.is_target(task.parts)
        for values, where in ((self._targets, is_target), (self._sliders, ~is_target)):
            if values is not None:
                action = np.where(where & ~np.isnan(values), values, action)
        return np.clip(action, low, high).astype(np.float32)

    def set_sliders(
        self, task: TaskEnv, env_idx: Sequence[int], dimensions: Sequence[int], values: Sequence[float]
    ) -> None:
        """Set `dimensions` of these envs' actions to slider `values`. If `dimensions` is empty, clear the
        values of these envs, so that they hold still."""
        shape = task.num_envs, actions.width(task.parts)
        if self._sliders is None or self._targets is None:
            self._sliders = np.full(shape, np.nan, np.float32)
            self._targets = np.full(shape, np.nan, np.float32)
        if not dimensions:
            self._sliders[list(env_idx)] = self._targets[list(env_idx)] = np.nan
        for array in (self._sliders, self._targets):
            array[np.ix_(env_idx, dimensions)] = values

    def acted(self, action: NDArray[np.float32]) -> None:
        """Store the action (N, A) of a control step, from any source, as the joint targets."""
        self._targets = action.copy()

    def begin(
        self, env_idx: Sequence[int] | None, led: Mapping[int, NDArray[np.float32]] | None = None
    ) -> None:
        """Forget the joint targets of these envs (all if None), which were reset or restored. `led` maps an
        env to the action (A,) that led to its restored state; this action becomes its joint targets."""
        if self._targets is None:
            return
        self._targets[slice(None) if env_idx is None else list(env_idx)] = np.nan
        for env, action in (led or {}).items():
            self._targets[env] = action

    def new_scene(self) -> None:
        """Forget the slider values of all envs; the new scene may have another number of envs."""
        self._sliders = self._targets = None

    @property
    def by_sliders(self) -> bool:
        return self._source == "sliders"

    @contextmanager
    def _imported(self) -> Iterator[Policy]:
        """Yield the policy, and import it first if necessary. An exception of the import or of the ``with``
        block becomes a TaskError about the policy, and the next call imports the policy again."""
        try:
            if self._policy is None:
                with self._folder.again():
                    self._policy = load_policy(self._policy_name, self._task_folder)
            yield self._policy
        except BaseException as error:
            if is_ctrl_c(error):
                raise
            policy, self._policy = self._policy, None
            raise TaskError(policy_problem(error, self._policy_name, self._task_folder, policy)) from error


def _same_for_all(action: NDArray[Any], task: TaskEnv) -> NDArray[np.float32]:
    return np.broadcast_to(action, (task.num_envs, len(action))).astype(np.float32)


class RecordActionChooser:
    """Chooses the actions of a headless recording; an env without an episode holds still.

    Each episode has its own generator, seeded with the episode's seed, so that the episodes are the same with
    any number of envs and processes.
    """

    def __init__(self, chooser: ActionChooser | None, planned: PlannedActions | None = None) -> None:
        """
        Args:
            chooser: chooses the actions, unless they are random, planned or from a file; None in these three
                cases.
            planned: plans the actions; None if they are not planned.
        """
        self._chooser, self._planned = chooser, planned
        self._rng: dict[int, np.random.Generator] = {}
        self._given: dict[int, RecordedRun] = {}

    def begin(self, env: int, seed: int, given: RecordedRun | None) -> str:
        """Begin an episode in this env. Returns the name of the source of its actions, for the recording.

        Args:
            given: run of a file; its actions are replayed. None if the actions do not come from a file.
        """
        self._rng[env] = np.random.default_rng(seed)
        self._given.pop(env, None)
        if given is not None:
            self._given[env] = given
            return given.name
        if self._planned is not None:
            self._planned.begin(env, seed)
            return self._planned.name
        return "random" if self._chooser is None else self._chooser.name

    def end(self, env: int) -> None:
        """End the episode of this env."""
        self._rng.pop(env, None)

    def next_action(self, task: TaskEnv, steps: Mapping[int, int]) -> NDArray[np.float32]:
        """Actions (N, A); `steps` maps each env that has an episode to the number of steps that this episode
        has so far.

        Raises:
            TaskError: the policy raised, or returned no action; or the task raised in a rollout.
            ValueError: the file's actions have the wrong number of dimensions.
        """
        if self._planned is not None:
            return self._planned.next_action(list(steps))
        action = actions.hold_action(task.parts, task.num_envs)
        if self._chooser is not None:
            # Choose for the whole batch: a policy expects the observation of all envs.
            chosen = self._chooser.next_action(task)
            for env in steps:
                action[env] = chosen[env]
            return action
        for env, step in steps.items():
            given = self._given.get(env)
            if given is None:
                action[env] = actions.random_action(task.parts, 1, self._rng[env])[0]
                continue
            if given.action.shape[1] != action.shape[1]:
                raise ValueError(
                    f"the file's actions have {given.action.shape[1]} dimensions, but the task's have "
                    f"{action.shape[1]} ({', '.join(name for part in task.parts for name in part.names)}): "
                    "use the file's control mode and robot"
                )
            action[env] = given.action[step]
        return action


class PlannedActions:
    """Plans the actions of a batch, and records the returns of the rollouts. Each episode is planned
    independently of the others."""

    def __init__(
        self, loaded: LoadedTask, task: TaskEnv, env_kwargs: Mapping[str, Any], plan: PlanOptions
    ) -> None:
        """
        Args:
            task: the live batch.
            env_kwargs: as in the `TaskOptions` that the task was opened with.

        Raises:
            TaskError: the task fails while the envs of the rollouts are built.
            NothingToPlan: the task has no actions, or no reward.
        """
        require_plannable(task.env)
        self._loaded, self._task = loaded, task
        made_with = given_arguments(loaded.cls, env_kwargs, loaded.default_kwargs)
        with blamed("build", loaded):
            self._planner = Planner(task.env, made_with=made_with, **vars(plan))
        self._rolled = TaskEnv(self._planner.rollout_env)
        self._logs: dict[int, EpisodeLog] = {}
        self.name = f"solve ({plan.method}, {plan.rollouts} rollouts of {self._planner.horizon} steps)"
        """The source's name in a recording."""

    def begin(self, env: int, seed: int) -> None:
        """Begin an episode in this env; `seed` seeds the sampling of the planner's candidate actions."""
        self._planner.reset([env], seed)
        self._logs[env] = EpisodeLog(seed, self._planner.horizon)

    def next_action(self, env_idx: Sequence[int]) -> NDArray[np.float32]:
        """Actions (N, A): planned for these envs; all other envs hold still.

        Raises:
            TaskError: the task raised in a rollout.
            NotAlike: the envs of the rollouts have other bodies than one of these envs.
        """
        for env in env_idx:
            self._planner.require_alike(env)
        with blamed("step", self._loaded, self._rolled):
            action = self._planner.flat_actions(env_idx)
        for env in env_idx:
            self._logs[env].add_plan(self._planner.plans[env])
        return action

    def add_step(self, step: StepResult, env_idx: Sequence[int]) -> None:
        """Record the result of a step of these envs."""
        for env in env_idx:
            self._logs[env].add_step(step, env)

    def cut_off(self, env: int) -> None:
        """Record that the episode of this env ends now at its wall time limit."""
        self._logs[env].cut_off = True

    def episode(self, env: int) -> PlannedEpisode:
        """The episode of this env so far."""
        return self._logs[env].episode()

    def close(self) -> None:
        self._planner.close()


# --- values of ``--actions`` -----------------------------------------------------------------------------


KINDS = ("random", "zero", "hold")
SOLVE = "solve"
"""Value of ``--actions`` for planned actions."""
STEPS_WITHOUT_LIMIT = 200
"""Control steps of an episode whose task has no time limit."""


def find_actions(name: str, task: str) -> tuple[Sequence[RecordedRun], dict[str, Any]]:
    """The runs of an actions file, and the keyword arguments that the env needs to replay them; both empty
    for a policy, `SOLVE`, or one of `KINDS`.

    Args:
        name: as in `RecordArguments.actions`.
        task: as in `RecordArguments.task`; a policy may be in its folder.

    Raises:
        FileNotFoundError, ValueError: as in `read_actions`; or `name` names no policy (`NoPolicy`).
    """
    if Path(name).suffix in SUFFIXES:
        return read_actions(Path(name))
    if name not in (*KINDS, SOLVE):
        find_policy(name, _folder_of(task))
    return (), {}


def plain_chooser(name: str, task: str, seed: int, here: CurrentFolder) -> ActionChooser:
    """Make the chooser for an ``--actions`` value that is neither random, planned nor a file.

    Raises:
        TaskError: the policy cannot be imported.
    """
    chooser = ActionChooser(here)
    chooser.seed(seed)
    if name in ("hold", "zero"):
        chooser.use(name, None)
    else:
        with here.again():
            folder = _folder_of(task)
        chooser.use("policy", name, folder)
    return chooser


def _folder_of(task: str) -> Path | None:
    file = named_file(task)
    return None if file is None else file.parent


@dataclass(frozen=True)
class Needed:
    """The author's folders and files that a job needs."""

    folders: tuple[Path, ...]
    files: tuple[Path, ...]


def needed_by(task: str, actions: str = "", imports: Iterable[str] = ()) -> Needed:
    """Files and folders that a job needs and that are not installed.

    Args:
        task: as in `RecordArguments.task`; the job needs the folder of the task's file or package.
        actions: as in `RecordArguments.actions`; the job needs the file or policy that is named there.
        imports: as in `TaskOptions.imports`.
    """
    folders: list[Path] = []
    files: list[Path] = []
    named = split_reference(task)
    modules = [*imports, *([named[0]] if named else [])]
    if named is None and (file := named_file(task)) is not None:
        folders.append(file.parent)
    policy, colon, _ = actions.rpartition(":")
    if not colon:
        if (file := Path(actions)).suffix and file.is_file():
            files.append(file)
    elif policy.endswith(".py"):
        found, _ = find_policy(actions, folders[0] if folders else None)
        folders.append(Path(found).parent)
    else:
        modules.append(policy)
    for name in modules:
        place = find_module(name)
        if place is None or place.file is None or "site-packages" in place.file.parts:
            continue
        # The whole top-level package: its subpackages may import any part of it.
        top = name.partition(".")[0]
        root = next((parent for parent in place.file.parents if parent.name == top), None)
        if root is None:
            files.append(place.file)
        else:
            folders.append(root)
    return Needed(tuple(folders), tuple(files))


# --- actions from a file: NumPy arrays, or demonstrations in ManiSkill's ``.h5`` -----------------------


MAX_BYTES = 2**30
"""Maximum size of a NumPy file, also after decompression; enough for 20 million steps of a Panda."""
SUFFIXES = (".npy", ".npz", ".h5")


def read_actions(path: Path) -> tuple[list[RecordedRun], dict[str, Any]]:
    """Read a file of actions. Returns a run for each episode, and the keyword arguments that the env needs,
    such as the control mode.

    ``.npy``: one array (T, A) for all episodes, or an array (E, T, A) with one (T, A) per episode. ``.npz``:
    an array (T, A) per episode. ``.h5``: trajectories of ManiSkill, or a recording of the workbench; their
    runs also have a seed and env states. The states correct a replay whose own states deviate from the
    recorded ones, for example on another machine, in another version, or in a GPU batch that was seeded as a
    whole. As in ManiSkill's ``replay_trajectory``, an episode that replays a file does not stop at success or
    at the time limit.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file holds no actions; the message describes its content.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    if path.suffix == ".h5":
        return _demonstrations(path)
    try:
        arrays = _arrays(path)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, NotImplementedError, zlib.error) as error:
        raise ValueError(f"{path} cannot be read as a NumPy file of numbers: {error}") from error
    if path.suffix == ".npy" and arrays[0].ndim == 3:
        arrays = list(arrays[0])
    for array in arrays:
        if array.ndim != 2 or array.shape[0] == 0 or array.dtype.kind not in "fiub":
            raise ValueError(
                f"{path} holds {array.dtype} of shape {array.shape}; expected numbers of shape (steps, dimensions); a .npy "
                "may also have (episodes, steps, dimensions)"
            )
    if not arrays:
        raise ValueError(f"{path} holds no array")
    names = [
        f"file {path.name}" + (f", its array {i}" if len(arrays) > 1 else "") for i in range(len(arrays))
    ]
    return [RecordedRun(name, -1, {}, _finite(path, array), {}) for name, array in zip(names, arrays)], {}


def _arrays(path: Path) -> list[NDArray]:
    """The arrays of a NumPy file. `np.load` is not used: it allocates the size that a header claims before it
    checks the file's size."""
    with open_regular_file(path, MAX_BYTES) as file:
        if path.suffix == ".npy":
            return [_array(file, path.stat().st_size)]
        with zipfile.ZipFile(file) as archive:
            if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
                raise ValueError("its unpacked arrays are larger than 1 GiB")
            found = []
            for member in archive.infolist():
                with archive.open(member) as opened:
                    found.append(_array(opened, member.file_size))
            return found


def _array(file: IO[bytes], size: int) -> NDArray:
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of NumPy's format is not supported; save it as (1, 0) or (2, 0)")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, not numbers")
    length = math.prod(shape) * dtype.itemsize
    if length > size:
        raise ValueError(f"its header claims {length} bytes of {dtype}, but the file has {size}")
    content = file.read(length)
    return np.frombuffer(content, dtype, math.prod(shape)).reshape(shape, order="F" if fortran else "C")


def _demonstrations(path: Path) -> tuple[list[RecordedRun], dict[str, Any]]:
    runs, kwargs = list[RecordedRun](), dict[str, Any]()
    for source in find_sources(path):
        episode = read_recording(source)
        if episode.length == 0:
            continue
        run = run_of(episode)
        runs.append(
            replace(
                run, name=f"file {path.name}, {source.part or source.name}", action=_finite(path, run.action)
            )
        )
        given: Mapping[str, Any] = episode.info.env_kwargs
        kwargs = {key: given[key] for key in ("robot_uids", "control_mode") if given.get(key) is not None}
        if episode.info.control_mode is not None:
            kwargs["control_mode"] = episode.info.control_mode
    if not runs:
        raise ValueError(f"{path} holds no trajectory with actions")
    return runs, kwargs


def _finite(path: Path, actions: NDArray) -> NDArray[np.float32]:
    actions = np.asarray(actions, np.float32)
    if not np.isfinite(actions).all():
        raise ValueError(f"{path} holds actions that are NaN or infinite")
    return actions
