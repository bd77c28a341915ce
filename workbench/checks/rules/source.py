"""Checks of the task's class and registration, and of names and calls in its source."""

from __future__ import annotations

import ast
import difflib
import inspect
import re
from collections.abc import Iterator
from types import CodeType
from typing import Any

from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building import ActorBuilder, ArticulationBuilder

from workbench.checks.evidence.collect import Checkup, Found, NotApplicable, Note
from workbench.checks.evidence.random_draws import global_draw
from workbench.checks.register_rule import rule
from workbench.checks.rules.devices import EVERY_STEP
from workbench.checks.rules.reward import REWARD_HOOKS
from workbench.envs.assets import robots_of
from workbench.envs.broken_rule import Place
from workbench.task import registry

HOOKS = tuple(
    name for name, member in vars(BaseEnv).items() if callable(member) or isinstance(member, property)
)
"""All methods and properties of BaseEnv."""
AT_RESETS = ("_initialize_episode", "reset", *EVERY_STEP)
"""Hooks that run after the GPU simulation has begun."""
_BUILDERS = {"create_actor_builder": ActorBuilder, "create_articulation_builder": ArticulationBuilder}
_GPU_CALLS = {"_gpu_apply_all", "_gpu_fetch_all"}
_STATE = re.compile(r"(get_|set_)?(\w+_)?(pose|qpos|qvel|velocity|global_pose)$")
_GUARDS = {
    "gpu_sim_enabled",
    "is_cuda",
    "is_gpu_enabled",
    "backend",
    "sim_backend",
    "_sim_device",
    "device_type",
}


# --- the class and its registration --------------------------------------------------------------------


@rule("registered", "warn", "class")
def registered(checkup: Checkup) -> Iterator[Found | Note]:
    """The class inherits BaseEnv and is registered with @register_env.

    ManiSkill's own commands and trainers do not find the task, and a batch of envs gets no time limit;
    without any id, gym.make cannot make the task.

    ## Why
    `gym.make`, ManiSkill's demos, its recording tools and every trainer make a task by its id. A class
    without an id can be opened only in the workbench. Gymnasium's own `register` makes an id that only
    `gym.make` finds, and a time limit that a batch of envs does not get. The rule reports such an id too; the
    workbench uses the id and its limit.

    ## Fix
    Write the decorator above the class.

    ```python fragment
    @register_env("PushCup-v1", max_episode_steps=100)
    class PushCupEnv(BaseEnv): ...
    ```

    ## How it is checked
    The rule reads ManiSkill's table of ids after the import of the file; no env is made. The result is *not
    applicable* for a robot that is shown in one of ManiSkill's scenes. The rule does not see an id that
    another file registers for the class, unless that file is imported too.
    """
    if _spec(checkup) is not None:
        return
    other = registry.gymnasium_spec_of(checkup.loaded.cls)
    has = "has no id" if other is None else f"is registered as {other.id} with gymnasium alone"
    env_id, limit = (_suggested_id(checkup), None) if other is None else (other.id, other.max_episode_steps)
    yield Found(
        f'{checkup.loaded.class_name} {has}: write @register_env("{env_id}", max_episode_steps={limit or 100}) above the '
        f"class{'' if other is None else ' in place of gymnasium.register'}.",
        checkup.places.task,
    )


@rule("versioned-id", "warn", "class")
def versioned_id(checkup: Checkup) -> Iterator[Found | Note]:
    """The registered id ends in a version (-v1).

    Results from before and after a change of the task cannot be told apart.

    ## Why
    A task changes: the goal becomes smaller, the reward gets another term. With a version in the id, results
    of the earlier and of the later task stay apart in papers, logs and recordings. Without a version, a
    number does not say which of the two tasks it belongs to.

    ## Fix
    End the id in `-v1`, and increase the number when results are no longer comparable.

    ```python fragment
    @register_env("PushCup-v1", max_episode_steps=100)
    class PushCupEnv(BaseEnv): ...
    ```

    ## How it is checked
    The rule reads the registered id. The result is *not applicable* for a class that is not registered. The
    rule does not look at whether a change of the task needs a new version.
    """
    _needs_id(checkup)
    env_id = checkup.loaded.env_id
    if re.search(r"-v\d+$", env_id) is None:
        versioned = re.sub(r"-v[\d.]*$", "", env_id) + "-v1"
        yield Found(
            f"The id {env_id!r} has no version, which is -v and a whole number: write {versioned!r}.",
            _decorator(checkup),
        )


@rule("time-limit", "warn", "class")
def time_limit(checkup: Checkup) -> Iterator[Found | Note]:
    """@register_env has max_episode_steps.

    Episodes end at success or failure only: a policy that reaches neither never resets.

    ## Why
    Without a time limit an episode ends at success or failure only. A policy that reaches neither, as every
    policy does in the beginning, never resets: 4096 GPU envs then collect the same dead ends, and the return
    of an episode is never logged.

    ## Fix
    Allow one and a half times as many control steps as a slow success needs.

    ```python fragment
    @register_env("PushCup-v1", max_episode_steps=100)
    class PushCupEnv(BaseEnv): ...
    ```

    ## How it is checked
    The rule reads the registration. The result is *not applicable* for a class without `@register_env`. The
    rule does not see a limit that a trainer gives to `gym.make(max_episode_steps=...)`, and does not judge
    whether the limit is long enough.
    """
    _needs_id(checkup)
    if checkup.loaded.max_episode_steps is None:
        yield Found(
            f"{checkup.loaded.env_id} has no time limit: write @register_env(..., max_episode_steps=100), one and "
            "a half times the control steps of a slow success.",
            _decorator(checkup),
        )


@rule("id-taken", "warn", "class")
def id_taken(checkup: Checkup) -> Iterator[Found | Note]:
    """No other task or robot has a name that the file registers, unless the file overrides it on purpose.

    Stock ManiSkill skips the registration, and gym.make gives the other task.

    ## Why
    The first class that registers an id keeps it. Stock ManiSkill logs a line and skips the second class, and
    `gym.make` makes the first one without an error: a training run spends hours on another task. The
    workbench opens the class of the file instead, so the mistake shows on a cluster only.

    ## Fix
    Choose an id that no other task has.

    ```python fragment
    @register_env("MyPushCube-v1", max_episode_steps=100)  # not PushCube-v1
    class PushCubeEnv(BaseEnv): ...
    ```

    ## How it is checked
    The rule compares the table of registered ids before and after the file is imported. It sees the tasks of
    ManiSkill and of the packages that the process has imported, and no others.
    """
    _needs_id(checkup)
    for made in checkup.loaded.replaced:
        of, gives = ("robot", "robot_uids=") if made.is_robot else ("task", "gym.make of ")
        yield Found(
            f"{made.name} is the name of another {of}: stock ManiSkill skips this class, and {gives}{made.name!r} gives "
            f"the other one. Choose a name that no {of} has, or register with override=True.",
            (made.file, made.line, made.cls.__name__),
        )


@rule("supported-robots", "warn", "class")
def supported_robots(checkup: Checkup) -> Iterator[Found | Note]:
    """SUPPORTED_ROBOTS lists the robots, including the default of robot_uids.

    ManiSkill logs a warning for each env, and the file does not say which robots were tried.

    ## Why
    ManiSkill makes a task with any robot that `robot_uids` names. `SUPPORTED_ROBOTS` lists the robots that
    were tried: rewards, reach and cameras were made for them, and ManiSkill warns about all others. If the
    default robot is not listed, each env logs a warning that hides other messages.

    ## Fix
    List the robots, including the default one; a tuple stands for several robots at once.

    ```python fragment
    class PushCupEnv(BaseEnv):
        SUPPORTED_ROBOTS = ["panda", "fetch"]

        def __init__(self, *args, robot_uids="panda", **kwargs):
            super().__init__(*args, robot_uids=robot_uids, **kwargs)
    ```

    ## How it is checked
    The rule reads the class and the default of its constructor's `robot_uids`. The result is *not applicable*
    if the class lists no robots and its constructor names none. The rule does not try whether the task works
    with each of the listed robots.
    """
    checkup.require_task()
    cls = checkup.loaded.cls
    robot = robots_of(cls, checkup.loaded.default_kwargs)
    supported = cls.SUPPORTED_ROBOTS
    if supported is None:
        if robot is None or robot in ("none", ()):
            raise NotApplicable("the task's constructor names no robot")
        yield Found(
            f"The class does not say which robots it is for. Write SUPPORTED_ROBOTS = [{_named(robot)}].",
            checkup.places.task,
        )
    elif robot is not None and robot not in supported and _as_tuple(robot) not in supported:
        yield Found(
            f"The default of robot_uids, {_named(robot)}, is not in SUPPORTED_ROBOTS: ManiSkill warns about each "
            "env. Add the robot there.",
            _class_value(checkup, "SUPPORTED_ROBOTS"),
        )


@rule("reward-modes", "warn", "class")
def reward_modes(checkup: Checkup) -> Iterator[Found | Note]:
    """Each mode in SUPPORTED_REWARD_MODES has its method.

    The first step in that mode raises NotImplementedError.

    ## Why
    `SUPPORTED_REWARD_MODES` is what `gym.make` accepts, and its first entry is the default. A mode without
    its method fails at the first step with a bare `NotImplementedError`, after the job on the cluster has
    waited in the queue. A class that does not declare its modes claims all four.

    ## Fix
    List the modes that the class has methods for; `sparse` needs only `success` or `fail` in `evaluate`.

    ```python fragment
    class PushCupEnv(BaseEnv):
        SUPPORTED_REWARD_MODES = ("sparse", "none")  # no compute_dense_reward yet
    ```

    ## How it is checked
    The rule reads the class. `sparse` and `none` need no method. The result is *not applicable* for a task
    with its own `get_reward`. The rule `success-stays-possible` checks that `evaluate` returns what the
    sparse reward is made of.
    """
    checkup.require_task()
    cls = checkup.loaded.cls
    if cls.get_reward is not BaseEnv.get_reward:
        raise NotApplicable("the task has its own get_reward()")
    for mode in cls.SUPPORTED_REWARD_MODES:
        hook = REWARD_HOOKS.get(mode)
        if mode == "none" or mode == "sparse":
            continue
        if hook is None:
            why = f"ManiSkill knows no reward mode {mode!r}"
        elif getattr(cls, hook) is getattr(BaseEnv, hook):
            why = f"{mode!r} is among SUPPORTED_REWARD_MODES, and there is no {hook}()"
        else:
            continue
        yield Found(
            f"{why}: the first step in that mode raises NotImplementedError. "
            f"Write SUPPORTED_REWARD_MODES = {_implemented(cls)!r}, or write the method.",
            _class_value(checkup, "SUPPORTED_REWARD_MODES"),
        )


# --- names and calls in the source -----------------------------------------------------------------------


@rule("unknown-name", "warn", "class")
def unknown_name(checkup: Checkup) -> Iterator[Found | Note]:
    """Every attribute that is set on a builder exists, and so does every method that is called on self or
    the scene.

    A typo on a builder (inital_pose) is ignored silently; a call of a method that does not exist fails only
    when its line runs.

    ## Why
    Python sets any attribute on a builder: `builder.inital_pose = ...` raises nothing, and the body is built
    at the origin, in all 4096 envs, inside the bodies that are there. A call of a method that does not exist
    fails only when its line runs, perhaps after hours, in a branch that seldom runs.

    ## Fix
    Write the name that the finding proposes.

    ```python fragment
    builder.initial_pose = sapien.Pose(p=[0, 0, 0.02])
    forces = self.scene.get_pairwise_contact_forces(self.cube, self.goal)
    ```

    ## How it is checked
    The rule reads the source of the hooks and of the functions that they call; nothing runs. It looks up
    attributes that are set on variables made by `create_actor_builder` and `create_articulation_builder`, and
    methods that are called on `self` and `self.scene`. It also accepts an attribute of a builder if the files
    read an attribute of this name, and a method if the files assign an attribute of its name or contain the
    name as a string, as in a call of `hasattr`. The rule does not look at builders that a function gets as an
    argument, nor at objects such as `self.agent`.
    """
    checkup.require_source()
    read = {
        node.attr
        for module in checkup.places.modules
        for node in ast.walk(module.tree)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load)
    }
    for module, function in checkup.places.reached_from(*HOOKS):
        builders = _builders(function)
        for node in ast.walk(function):
            if not isinstance(node, ast.Attribute) or not isinstance(node.value, ast.Name):
                continue
            known = builders.get(node.value.id)
            if known is None or not isinstance(node.ctx, ast.Store) or node.attr in known | read:
                continue
            close = difflib.get_close_matches(node.attr, known, n=1, cutoff=0.6)
            yield Found(
                f"A builder has no attribute {node.attr!r}: Python sets it, and ManiSkill never reads it."
                + (f" Write {close[0]!r}." if close else ""),
                module.place(node, function.name),
            )
    known_self, known_scene = _names_of(checkup, checkup.loaded.cls), _names_of(checkup, ManiSkillScene)
    for module, function in checkup.places.methods:
        for node in ast.walk(function) if function.args.args else ():
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            owner, name = ast.unparse(node.func.value), node.func.attr
            known = known_self if owner == "self" else known_scene if owner == "self.scene" else None
            if known is None or name in known:
                continue
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
            other = f" Write self.scene.{name}()." if owner == "self" and name in known_scene else ""
            yield Found(
                f"There is no {owner}.{name}(): this line raises AttributeError when it is reached."
                + (other or (f" Write {owner}.{close[0]}()." if close else "")),
                module.place(node, function.name),
            )


@rule("unseeded-random", "warn", "class")
def unseeded_random(checkup: Checkup) -> Iterator[Found | Note]:
    """Random numbers come from torch in _initialize_episode, and from self._batched_episode_rng where the scene
    is built.

    The same seed gives another episode each time: nothing can be reproduced.

    ## Why
    ManiSkill seeds torch for a reset and gives each env a generator for the build. Numbers from NumPy's or
    Python's own generator are not seeded: `reset(seed=3)` gives another episode each time. Runs,
    demonstrations and the one episode that failed cannot be repeated.

    ## Fix
    Draw from torch at a reset, and from `self._batched_episode_rng` where the scene is built.

    ```python fragment
    def _load_scene(self, options: dict):
        sizes = self._batched_episode_rng.uniform(0.02, 0.04)  # a number for each env


    def _initialize_episode(self, env_idx: torch.Tensor, options: dict):
        with torch.device(self.device):
            place = torch.rand((len(env_idx), 2)) * 0.2 - 0.1
    ```

    ## How it is checked
    The rule reads the source of the hooks and of the functions that they call, and looks for calls into
    `numpy.random`, `random` and SciPy's `Rotation.random`. A generator that is made with a seed is accepted.
    The rule does not see random numbers inside other libraries; the rule `same-seed` compares whole episodes.
    """
    checkup.require_source()
    at_resets = {function for _, function in checkup.places.reached_from(*AT_RESETS)}
    for module, function in checkup.places.reached_from(*HOOKS):
        for node in ast.walk(function):
            drawn = global_draw(node, module)
            if drawn is None:
                continue
            write = (
                "torch.rand((len(env_idx), ...)), which is seeded for the reset"
                if function in at_resets
                else "self._batched_episode_rng, which has a generator for each env's seed"
            )
            yield Found(
                f"{drawn} does not depend on the seed of the reset, so the same seed gives another episode each time. Draw from "
                f"{write}.",
                module.place(node, function.name),
            )


@rule("backend-only-call", "warn", "class")
def backend_only_call(checkup: Checkup) -> Iterator[Found | Note]:
    """Calls that exist in a single backend are guarded by `if self.gpu_sim_enabled:` or its opposite.

    The task runs on one of CPU and GPU, and fails on the other.

    ## Why
    Often a task is written on the CPU and trained on the GPU, or trained on one and evaluated on the other.
    `get_contacts()` and the state of a single SAPIEN object exist, or are up to date, in the CPU simulation
    only; `px.gpu_...` and `_gpu_apply_all()` exist in the GPU simulation only. The task runs on one of them,
    and on the other it raises or reads old state.

    ## Fix
    Use ManiSkill's batched calls, or put the call behind the condition.

    ```python fragment
    if self.gpu_sim_enabled:
        self.scene._gpu_apply_all()
    forces = self.scene.get_pairwise_contact_forces(self.cube, self.goal)  # (N, 3), on both
    ```

    ## How it is checked
    The rule reads the source of the hooks and of the functions that they call. It accepts a call behind a
    condition that names the backend, and a call after an early return under such a condition. It also accepts
    reads of a SAPIEN object while the scene is built. The rule does not follow objects that were put into
    variables first.
    """
    checkup.require_source()
    after_begin = {function for _, function in checkup.places.reached_from(*AT_RESETS)}
    for module, function in checkup.places.reached_from(*HOOKS):
        guarded = set(_guarded(function.body))
        for node in ast.walk(function):
            if not isinstance(node, ast.Attribute) or node in guarded:
                continue
            place = module.place(node, function.name)
            if node.attr in _GPU_CALLS or (_is_px(node.value) and node.attr.startswith(("gpu_", "cuda_"))):
                yield Found(
                    f"{node.attr} exists in the GPU simulation only: on the CPU this line raises. Write it below "
                    "`if self.gpu_sim_enabled:`.",
                    place,
                )
            elif node.attr == "get_contacts" and (_is_px(node.value) or _ends_in(node.value, "scene")):
                yield Found(
                    "get_contacts() exists in the CPU simulation only: on a GPU this line raises. Use "
                    "self.scene.get_pairwise_contact_forces(a, b), which has a row for each env.",
                    place,
                )
            elif function in after_begin and _STATE.match(node.attr) and _is_one_object(node.value):
                yield Found(
                    f"{node.attr} of a SAPIEN object is the state of one env in the CPU simulation only: a GPU "
                    "does not update it. Use the ManiSkill object itself, whose pose.p is (N, 3).",
                    place,
                )


# --- parts of the above ------------------------------------------------------------------------------------


def _spec(checkup: Checkup) -> Any:
    checkup.require_task()
    return registry.environment(checkup.loaded.env_id)


def _needs_id(checkup: Checkup) -> None:
    if _spec(checkup) is None:
        raise NotApplicable("the task is not registered with @register_env")


def _suggested_id(checkup: Checkup) -> str:
    return f"{checkup.loaded.class_name.removesuffix('Env')}-v1"


def _decorator(checkup: Checkup) -> Place | None:
    """The ``@register_env`` line; else the ``class`` line."""
    if (found := checkup.places.class_definition(checkup.loaded.cls)) is not None:
        module, node = found
        for each in node.decorator_list:
            if "register_env" in ast.unparse(each):
                return module.file, each.lineno, node.name
    return checkup.places.task


def _class_value(checkup: Checkup, name: str) -> Place | None:
    """The line of the class, or of a base class in the author's files, that assigns this name; else the
    ``class`` line."""
    owner = next((cls for cls in checkup.loaded.cls.__mro__ if name in vars(cls)), None)
    if owner is not None and (found := checkup.places.class_definition(owner)) is not None:
        module, node = found
        for statement in node.body:
            targets = getattr(statement, "targets", [getattr(statement, "target", None)])
            if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                return module.file, statement.lineno, node.name
    return checkup.places.task


def _named(robot: Any) -> str:
    return getattr(robot, "__name__", None) or repr(robot)


def _as_tuple(robot: Any) -> Any:
    return tuple(robot) if isinstance(robot, (list, tuple)) else robot


def _implemented(cls: type[BaseEnv]) -> tuple[str, ...]:
    """The declared reward modes that the class has methods for."""
    have = [
        mode
        for mode in cls.SUPPORTED_REWARD_MODES
        if mode in ("sparse", "none")
        or (
            mode in REWARD_HOOKS
            and getattr(cls, REWARD_HOOKS[mode]) is not getattr(BaseEnv, REWARD_HOOKS[mode])
        )
    ]
    return tuple(have) or ("none",)


def _builders(function: ast.FunctionDef) -> dict[str, set[str]]:
    """Names of the builder's attributes, for each local variable that holds a builder."""
    found: dict[str, set[str]] = {}
    for node in ast.walk(function):
        if not isinstance(node, ast.Assign):
            continue
        call = node.value
        made = call.func.attr if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) else ""
        for target in node.targets:
            if isinstance(target, ast.Name) and made in _BUILDERS:
                found.setdefault(target.id, set()).update(dir(_BUILDERS[made]()))
    return found


def _names_of(checkup: Checkup, cls: type) -> set[str]:
    """All names that an object of this class may have: those of this class and its base classes, those that
    the author's files assign or name in a string, and those that code outside these files reads or sets."""
    own = {module.file for module in checkup.places.modules}
    names = set(dir(cls))
    for module in checkup.places.modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                names.add(node.attr)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                names.add(node.target.id)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                names.add(node.value)
    for base in cls.__mro__:
        for member in vars(base).values():
            member = getattr(member, "fget", None) or getattr(member, "__func__", member)
            code = getattr(inspect.unwrap(member) if callable(member) else member, "__code__", None)
            if isinstance(code, CodeType) and code.co_filename not in own:
                names.update(code.co_names)
    return names


def _guarded(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """The nodes of these statements that a condition about the backend or a ``try`` guards."""
    behind = False
    for statement in body:
        if behind:
            yield from ast.walk(statement)
            continue
        for node in ast.walk(statement):
            if isinstance(node, (ast.If, ast.IfExp, ast.BoolOp, ast.While)):
                test = node.values[0] if isinstance(node, ast.BoolOp) else node.test
                if _asks_for_backend(test):
                    yield from ast.walk(node)
            elif isinstance(node, ast.Try):
                yield from ast.walk(node)
        if isinstance(statement, ast.Assert):
            behind = _asks_for_backend(statement.test)
        if isinstance(statement, ast.If) and _asks_for_backend(statement.test):
            behind = isinstance(statement.body[-1], (ast.Return, ast.Raise, ast.Continue))


def _asks_for_backend(test: ast.expr) -> bool:
    names = {getattr(node, "attr", getattr(node, "id", "")) for node in ast.walk(test)}
    return not names.isdisjoint(_GUARDS) or any("gpu" in name or "cuda" in name for name in names)


def _is_px(node: ast.expr) -> bool:
    return _ends_in(node, "px") or _ends_in(node, "physx_system")


def _ends_in(node: ast.expr, name: str) -> bool:
    return getattr(node, "attr", getattr(node, "id", None)) == name


def _is_one_object(node: ast.expr) -> bool:
    """Whether the expression is one SAPIEN object, such as ``self.cube._objs[0]``."""
    return isinstance(node, ast.Subscript) and (
        _ends_in(node.value, "_objs") or _ends_in(node.value, "_bodies")
    )
