"""All private names of ManiSkill and SAPIEN that the core uses, and the features that depend on them."""

from __future__ import annotations

import inspect
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from itertools import islice
from types import FrameType
from typing import Any

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController, PDEEPoseController
from mani_skill.agents.multi_agent import MultiAgent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.sensors import camera as camera_module
from mani_skill.sensors.camera import Camera, CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.articulation_joint import ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from mani_skill.utils.structs.decorators import before_gpu_init
from mani_skill.utils.structs.link import Link
from mani_skill.utils.structs.pose import Pose
from mani_skill.utils.structs.render_camera import RenderCamera
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from numpy.typing import NDArray

from workbench.envs.camera_data import CallSite, CameraKey, CameraKind
from workbench.machine.versions import PrivateName, command_for_tested_versions, moved_text, untested_text

# --- what depends on which name ---------------------------------------------------------------------

EXCHANGING = "exchanging cameras without a rebuild"
HIDDEN = "objects that are hidden from sensors, in pictures"
NAMED_STATE = "names of the parts of a flat state observation"
ELSEWHERE = "pictures of a pose that is set and not applied yet"
PLACING = "placing cameras"
POSE_CONTROL = "control modes that set the hand's pose, pd_ee_..."
REACHING = "handles that move an arm"
WRITING = "writing cameras into the file"

_ENV = "mani_skill.envs.sapien_env:BaseEnv"
_SCENE = "mani_skill.envs.scene:ManiSkillScene"
_STRUCTS = "mani_skill.utils.structs"
_POSE_CONTROLLER = "mani_skill.agents.controllers.pd_ee_pose:PDEEPosController"


def _all(owner: str, disables: str, names: str) -> tuple[PrivateName, ...]:
    return tuple(PrivateName(owner, name, disables) for name in names.split())


PRIVATE_NAMES = (
    *_all(_ENV, "", "_setup_scene _set_scene_config _load_agent _initialize_episode _after_reconfigure"),
    *_all(
        _ENV, "", "_clear_sim_state _step_action _before_simulation_step _after_simulation_step _sim_device"
    ),
    *_all(
        _ENV, "", "_sim_freq _sim_steps_per_control _get_obs_agent _get_obs_extra _flatten_raw_obs _last_obs"
    ),
    *_all(_ENV, "", "_episode_seed _episode_rng _batched_episode_rng _batched_main_rng _batched_rng_backend"),
    *_all(_ENV, "", "_enhanced_determinism _sensors _human_render_cameras"),
    *_all(_SCENE, "", "_setup _gpu_apply_all _gpu_fetch_all _gpu_sim_initialized _needs_fetch _reset_mask"),
    *_all(_SCENE, "", "_sapien_add_camera _sapien_update_render"),
    *_all(f"{_STRUCTS}.base:BaseStruct", "", "_objs _scene_idxs"),
    *_all(f"{_STRUCTS}.base:PhysxRigidBodyComponentStruct", "", "_bodies _body_data _body_data_index"),
    *_all(f"{_STRUCTS}.articulation:Articulation", "", "_data_index"),
    *_all(f"{_STRUCTS}.articulation_joint:ArticulationJoint", "", "_data_index _physx_articulations"),
    *_all(f"{_STRUCTS}.render_camera:RenderCamera", "", "_render_cameras"),
    *_all(_ENV, EXCHANGING, "_setup_sensors"),
    *_all(_SCENE, EXCHANGING, "camera_groups"),
    *_all(_ENV, HIDDEN, "_hidden_objects"),
    *_all(f"{_STRUCTS}.actor:Actor", HIDDEN, "hidden before_hide_pose"),
    *_all(_ENV, NAMED_STATE, "_get_obs_state_dict"),
    *_all(_ENV, PLACING, "_sensor_configs _human_render_camera_configs"),
    *_all(f"{_STRUCTS}.render_camera:RenderCamera", PLACING, "camera_group _cached_model_matrix"),
    *_all(f"{_STRUCTS}.render_camera:RenderCamera", PLACING, "_cached_extrinsic_matrix"),
    *_all(f"{_STRUCTS}.render_camera:RenderCamera", PLACING, "_cached_intrinsic_matrix _cached_local_pose"),
    *_all(
        _POSE_CONTROLLER, POSE_CONTROL, "_preprocess_action _start_qpos _target_pose _target_qpos _sim_steps"
    ),
    *_all(_POSE_CONTROLLER, POSE_CONTROL, "_step _step_size _check_gpu_sim_works kinematics"),
    *_all("mani_skill.agents.base_agent:BaseAgent", REACHING, "_controller_configs"),
    *_all("mani_skill.agents.controllers.base_controller:BaseController", REACHING, "_preprocess_action"),
    *_all("sapien.render:RenderBodyComponent", ELSEWHERE, "_internal_node"),
    *_all(_ENV, WRITING, "_default_sensor_configs _default_human_render_camera_configs"),
    *_all("mani_skill.agents.base_agent:BaseAgent", WRITING, "_sensor_configs"),
)
"""Private names that the workbench uses. If a name is missing, its feature is off. If a name without a
feature ("") is missing, no task can be opened."""


@cache
def moved_names() -> tuple[PrivateName, ...]:
    """Names in `PRIVATE_NAMES` that the installed ManiSkill does not have."""
    return tuple(each for each in PRIVATE_NAMES if not each.exists())


def why_not(feature: str) -> str:
    """Why the installed ManiSkill does not allow a feature; empty if it does.

    Args:
        feature: one of the names above, such as `PLACING`; empty for opening any task.
    """
    return _with_advice(each for each in moved_names() if each.disables == feature)


def version_notice() -> str:
    """Notice of all features that the installed ManiSkill does not allow; empty if it allows all."""
    return _with_advice(moved_names())


def _with_advice(moved: Iterable[PrivateName]) -> str:
    text = moved_text(moved)
    if not text:
        return ""
    return f"{text} {untested_text() or f'The tested versions: {command_for_tested_versions()}'}"


def draw_at(drawn: Any, pose: NDArray[np.float32]) -> None:
    """Draw a ``RenderBodyComponent`` at a pose (7,) until the next ``update_render``; its entity stays where it is.

    If the component lacks SAPIEN's private node, it is drawn where its entity is.
    """
    if (node := getattr(drawn, "_internal_node", None)) is not None:
        node.set_position(pose[:3])
        node.set_rotation(pose[3:])


parse_cameras: Callable[[Any], dict[str, Any]] = (
    getattr(camera_module, "parse_camera_configs", None) or camera_module.parse_sensor_configs  # pyright: ignore
)
"""Turns the return value of a camera hook into a dict. 3.0.1 has the first name, the nightly builds of 2026 the second."""


_TARGETS_OF = "_workbench_targets_of"


SystemOf = Callable[[Any], Any]
"""Returns the system of a batched scene, None for any other scene."""


@cache
def install_row_lookups(batched_system: SystemOf) -> None:
    """Let ManiSkill's structs find their rows in a batched CPU system.

    Structs ask a body for ``gpu_pose_index`` and an articulation for ``gpu_index``, which raise for a CPU
    system. ManiSkill's builders make the structs, so the structs' cached properties of these indices are
    replaced, once per process; for a stock scene the new properties run the original code. Safe to call
    again.
    """
    bodies, joints = PhysxRigidBodyComponentStruct, ArticulationJoint
    _find_rows(batched_system, bodies, "_body_data_index", "_bodies", "row", torch.int64)
    _find_rows(batched_system, Articulation, "_data_index", "_objs", "index", torch.int32)
    _find_rows(batched_system, joints, "_data_index", "_physx_articulations", "index", torch.int32)
    Articulation.get_joint_target_indices = _joint_target_indices(batched_system)  # type: ignore[method-assign]
    Link._body_data = property(_link_data(batched_system))  # type: ignore[method-assign,assignment]
    ManiSkillScene.get_contacts = _get_contacts(batched_system)  # type: ignore[method-assign]
    if why_not(POSE_CONTROL):
        return
    PDEEPosController.set_action = _set_ee_action(batched_system)  # type: ignore[method-assign]
    for controller in (PDEEPosController, PDEEPoseController):
        check = _check_frame(batched_system, controller._check_gpu_sim_works)
        controller._check_gpu_sim_works = check  # type: ignore[method-assign,assignment]


def _find_rows(
    batched_system: SystemOf, owner: type, name: str, things: str, find: str, dtype: torch.dtype
) -> None:
    """Replace the cached property `name` of a struct: for a batched CPU scene it returns the row of each
    object in the struct's attribute `things`."""
    stock = owner.__dict__[name].func

    @wraps(stock)
    def rows(self: Any) -> torch.Tensor:
        known = self.__dict__.get(name)
        system = batched_system(self.scene)
        if known is not None and (system is None or known[0] == system.layout_version):
            return known[1]
        if system is None:
            found = 0, stock(self)
        else:
            place = system.row_of if find == "row" else system.index_of
            version = system.layout_version
            each = [place(thing) for thing in getattr(self, things)]
            if version != system.layout_version:
                # An unknown body made the system lay out the scene again.
                each = [place(thing) for thing in getattr(self, things)]
            found = system.layout_version, torch.tensor(each, device=self.device, dtype=dtype)
        self.__dict__[name] = found
        return found[1]

    setattr(owner, name, property(rows, doc=stock.__doc__))


def _joint_target_indices(batched_system: SystemOf) -> Callable[..., Any]:
    """``Articulation.get_joint_target_indices``, whose cache is emptied when the rows of a batched scene
    change."""
    stock = Articulation.get_joint_target_indices

    @wraps(stock)
    def get_joint_target_indices(self: Any, joint_indices: Any) -> Any:
        system = batched_system(self.scene)
        if system is not None and self.__dict__.get(_TARGETS_OF) != system.layout_version:
            self.__dict__[_TARGETS_OF] = system.layout_version
            self._cached_joint_target_indices.clear()
        return stock(self, joint_indices)

    return get_joint_target_indices


def _link_data(batched_system: SystemOf) -> Callable[[Any], torch.Tensor]:
    """The getter of ``Link._body_data``; in a batched scene it fetches the velocities of links first."""
    stock = PhysxRigidBodyComponentStruct.__dict__["_body_data"].fget

    @wraps(stock)
    def link_data(self: Any) -> torch.Tensor:
        # Only velocities are read this way (`Link.pose` reads the tensor itself). Velocities of roots are fetched with
        # every step, so reading only a root must not fetch all links.
        system = batched_system(self.scene)
        if system is not None and not self.is_root.all():
            system.fetch_link_velocities()
        return stock(self)

    return link_data


def _get_contacts(batched_system: SystemOf) -> Callable[[Any], Any]:
    stock = ManiSkillScene.get_contacts

    @wraps(stock)
    def get_contacts(self: Any) -> Any:
        # Nightly builds raise before they call the system, whose own error says what to call instead.
        system = batched_system(self)
        return stock(self) if system is None else system.get_contacts()

    return get_contacts


def _check_frame(batched_system: SystemOf, stock: Callable[[Any], None]) -> Callable[[Any], None]:
    """Skip, in batched scenes, ManiSkill's check for a controller's ``frame`` that GPU simulation does not
    support.

    To detect GPU simulation, nightly builds read ``scene.gpu_sim_enabled``; release 3.0.1 reads the device.
    """

    @wraps(stock)
    def check(self: Any) -> None:
        if batched_system(self.scene) is None:
            stock(self)

    return check


def _set_ee_action(batched_system: SystemOf) -> Callable[[Any, torch.Tensor], None]:
    stock = PDEEPosController.set_action

    @wraps(stock)
    def set_ee_action(self: Any, action: torch.Tensor) -> None:
        if batched_system(self.scene) is None:
            stock(self, action)
        else:
            _set_ee_action_of_each_env(self, action)

    return set_ee_action


def _set_ee_action_of_each_env(controller: Any, action: torch.Tensor) -> None:
    """``PDEEPosController.set_action`` of a single CPU env, for every env.

    ManiSkill has two inverse kinematics: on the CPU a solver that iterates until the pose is reached, for one
    env; on the GPU one damped step along the Jacobian, for all. Their targets for one ``pd_ee_delta_pos``
    action differ by 1.3 cm (mean of 30 random actions; 3.8 cm at most), and the one on the GPU ignores the
    config's ``frame``. An env here must equal a stock env, so the CPU solver is called for each env: 0.1 ms
    per env and control step.
    """
    action = controller._preprocess_action(action)
    controller._step = 0
    start = controller._start_qpos = controller.qpos
    use_target = controller.config.use_target
    before = controller._target_pose if use_target else controller.ee_pose_at_base
    goal = controller._target_pose = controller.compute_target_pose(before, action)
    solver, qpos = controller.kinematics, controller.articulation.get_qpos()
    solved = [solver.compute_ik(pose=goal[i : i + 1], q0=qpos[i : i + 1]) for i in range(len(qpos))]
    # As in stock ManiSkill, the arm does not move if the pose cannot be reached.
    target = torch.cat([start[i : i + 1] if row is None else row for i, row in enumerate(solved)])
    controller._target_qpos = target.to(start.dtype)
    if controller.config.interpolate:
        controller._step_size = (controller._target_qpos - start) / controller._sim_steps
    else:
        controller.set_drive_targets(controller._target_qpos)


_BETWEEN_SUBSTEPS = ("_step_action", "_before_simulation_step", "_after_simulation_step")


def substeps_are_unwatched(env: Any, task: type) -> bool:
    """Whether only ManiSkill's own code runs between the substeps of a control step.

    ManiSkill's own hooks do not touch the simulation: those of ``BaseEnv`` are empty, and its controllers
    write drive targets in ``before_simulation_step`` only if they interpolate. A hook of the author's code
    may read state.

    Args:
        task: the class of `env` without our mixin.
    """
    for hook in _BETWEEN_SUBSTEPS:
        if getattr(task, hook) is not getattr(BaseEnv, hook) or hook in vars(env):
            return False
    of_agents = {type(a).before_simulation_step for a in (env.agent, *agents(env)) if a is not None}
    if not of_agents <= {BaseAgent.before_simulation_step, MultiAgent.before_simulation_step}:
        return False
    return all(
        "before_simulation_step" not in vars(part)
        and type(part).before_simulation_step.__module__.startswith("mani_skill.agents.controllers.")
        and not getattr(getattr(part, "config", None), "interpolate", False)
        for robot in agents(env)
        for part in (robot.controller, *getattr(robot.controller, "controllers", {}).values())
    )


@cache
def install_base_env_hooks() -> None:
    """Replace ``BaseEnv``'s constructor and ``_setup_scene``, once per process.

    For an env of the batched CPU simulation, the new constructor takes the arguments of `base_arguments`, and
    the new ``_setup_scene`` calls the env's ``_make_scene``.

    Overriding the two in a subclass does not work: a task's own versions, which call those of ``BaseEnv``,
    would be skipped or get arguments that they do not take.
    """
    stock_init, stock_setup = BaseEnv.__init__, BaseEnv._setup_scene

    # Keep the name `__init__`: without it, an error in the build would be attributed to the author's call of
    # super().__init__().
    @wraps(stock_init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        defaults, fixed = self.__dict__.pop(_BASE_ARGUMENTS, ({}, {}))
        stock_init(self, *args, **{**defaults, **kwargs, **fixed})

    @wraps(stock_setup)
    def setup_scene(self: Any) -> None:
        make = getattr(self, "_make_scene", None)
        stock_setup(self) if make is None else make()

    BaseEnv.__init__ = __init__  # type: ignore[method-assign]
    BaseEnv._setup_scene = setup_scene  # type: ignore[method-assign]


_BASE_ARGUMENTS = "_workbench_base_arguments"
_WORKBENCH_ARGUMENTS = ("num_envs", "render_backend", "reward_mode")
"""Arguments that the workbench adds itself."""


@contextmanager
def base_arguments(env: Any, task: type, kwargs: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Context in which ``BaseEnv``'s constructor simulates on the CPU, whatever the task's constructor passes on.

    Yields the arguments for the task's constructor: `kwargs` without the `_WORKBENCH_ARGUMENTS` that this
    constructor does not take.
    """
    taken = inspect.signature(task.__init__).parameters
    any_name = any(each.kind is each.VAR_KEYWORD for each in taken.values())
    left = (
        {}
        if any_name
        else {name: kwargs[name] for name in _WORKBENCH_ARGUMENTS if name in kwargs.keys() - taken.keys()}
    )
    defaults = {name: value for name, value in left.items() if name != "render_backend"}
    fixed = {"sim_backend": "physx_cpu", **{k: v for k, v in left.items() if k == "render_backend"}}
    vars(env)[_BASE_ARGUMENTS] = defaults, fixed
    try:
        yield {name: value for name, value in kwargs.items() if name not in left}
    finally:
        vars(env).pop(_BASE_ARGUMENTS, None)


def clears_scene(caller: FrameType) -> bool:
    """Whether the caller is ``BaseEnv._clear`` or its constructor, which may set ``self.scene`` to None."""
    return caller.f_code in (BaseEnv._clear.__code__, inspect.unwrap(BaseEnv.__init__).__code__)


def hook_of_base_env(env: Any, caller: FrameType) -> str:
    """The outermost method of ``BaseEnv`` other than ``close`` that is running for `env`; empty if none is."""
    found, frame = "", caller
    while frame is not None:
        code = frame.f_code
        of_base = frame.f_globals.get("__name__") == BaseEnv.__module__ and code.co_name != "close"
        if of_base and frame.f_locals.get("self") is env:
            found = code.co_name
        frame = frame.f_back
    return found


def allowed_on_the_cpu(caller: FrameType, laid_out: bool) -> bool:
    """Whether the caller in ManiSkill must see a GPU simulation that is not initialised yet.

    True for ``before_gpu_init``, which refuses setters after initialisation: a stock CPU env allows them at
    any time. False for the methods that make an articulation's meshes: the link poses that they need exist at
    any time. For all other callers, True until the scene is laid out.
    """
    if caller.f_code in _NEED_LINK_POSES:
        return False
    return not laid_out or caller.f_code is _BEFORE_GPU_INIT


_BEFORE_GPU_INIT = before_gpu_init(lambda self: None).__code__
_NEED_LINK_POSES = {
    inspect.unwrap(method).__code__
    for method in (Articulation.get_collision_meshes, Articulation.get_visual_meshes)
}


def asks_for_a_gpu(caller: FrameType) -> bool:
    """Whether the caller of ``env.gpu_sim_enabled`` asks for a GPU, not for the code path to take.

    Only ``CPUGymWrapper`` does: it refuses GPU simulation, but works on batched CPU simulation with
    ``num_envs=1``. All other callers use the answer to decide whether to apply and fetch.
    """
    return caller.f_code is CPUGymWrapper.__init__.__code__


def episode_seeds(env: BaseEnv) -> np.ndarray | None:
    """(N,) seeds of the last resets; None before the first."""
    return getattr(env, "_episode_seed", None)


def draws_its_own_seeds(env: BaseEnv) -> bool:
    """Whether a reset without a seed draws a seed for each env (``enhanced_determinism``)."""
    return env._enhanced_determinism


def set_episode_seeds(env: BaseEnv, env_idx: list[int], seeds: list[int]) -> None:
    """Seed the numpy generators of these envs only.

    ``BaseEnv.reset(seed=[...], options={"env_idx": ...})`` would replace, and shorten, the seeds of the whole batch.
    """
    keep_episode_seeds(env, env_idx, seeds)
    env._batched_episode_rng[env_idx] = BatchedRNG.from_seeds(seeds, backend=env._batched_rng_backend)
    env._episode_rng = env._batched_episode_rng[0]


@contextmanager
def drawing_from(env: BaseEnv, index: int) -> Iterator[None]:
    """Context in which ``_episode_rng``, from which the robot's initial joints are drawn, is the generator of env `index`.

    In ManiSkill ``_episode_rng`` is always the generator of env 0: a partial reset of env 3 would draw from
    that one and ignore the seed of env 3. Also turns ``enhanced_determinism`` off, which would draw new seeds
    because ManiSkill's reset gets none.
    """
    env._episode_rng = env._batched_episode_rng[index]
    draws_seeds, env._enhanced_determinism = env._enhanced_determinism, False
    try:
        yield
    finally:
        env._episode_rng = env._batched_episode_rng[0]
        env._enhanced_determinism = draws_seeds


def keep_episode_seeds(env: BaseEnv, env_idx: list[int], seeds: Any) -> None:
    """Set the episode seeds of these envs; does not change their generators."""
    every = np.array(env._episode_seed, dtype=np.int64)
    every[env_idx] = seeds
    env._episode_seed = every


def set_reset_mask(env: BaseEnv, env_idx: list[int]) -> None:
    """Set ``scene._reset_mask``: True for envs that ManiSkill's setters write; between resets, for all
    envs."""
    mask = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    mask[env_idx] = True
    env.scene._reset_mask = mask


@contextmanager
def setting_only(env: BaseEnv, env_idx: list[int]) -> Iterator[None]:
    """Context in which ManiSkill's setters write these envs only. Values have a row per env, in ascending
    order."""
    set_reset_mask(env, env_idx)
    try:
        yield
    finally:
        set_reset_mask(env, list(range(env.num_envs)))


def keep_observation(env: BaseEnv, obs: Any) -> None:
    """Set ``_last_obs``, as ``reset`` and ``step`` do."""
    env._last_obs = obs


def last_observation(env: BaseEnv) -> Any:
    """The last observation of ``reset`` or ``step``, before any wrapper: ``_last_obs``."""
    return env._last_obs


def scene_of(env: Any) -> Any | None:
    """The scene; None before it is built (in nightly builds ``env.scene`` does not exist then) and after it
    is closed."""
    return getattr(env, "scene", None)


def open_env(env: Any) -> BaseEnv:
    """The env under its wrappers: ``base_env`` of ManiSkillVectorEnv, ``unwrapped`` of all others.

    Raises:
        TypeError: `env` is not a ManiSkill env.
        RuntimeError: the env was closed.
    """
    env = getattr(getattr(env, "base_env", env), "unwrapped", env)
    if not isinstance(env, BaseEnv):
        raise TypeError(f"expected a ManiSkill env, not {type(env).__name__}")
    if scene_of(env) is None:
        raise RuntimeError("this env is closed: its simulation is gone")
    return env


def task_class(env: BaseEnv) -> type[BaseEnv]:
    """The author's class, without the CPU core's mixins."""
    return getattr(type(env), "_workbench_task", type(env))


def apply_and_fetch(env: BaseEnv) -> None:
    """Apply the tensors to the simulation, and fetch them again."""
    env.scene._gpu_apply_all()
    env.scene.px.gpu_update_articulation_kinematics()  # type: ignore[union-attr]
    env.scene._gpu_fetch_all()


@contextmanager
def before_each_substep(env: Any, call: Callable[[], None]) -> Iterator[None]:
    """Context in which `call` runs before each substep, right after the task's ``_before_simulation_step``."""
    stock = env._before_simulation_step
    own = vars(env).get("_before_simulation_step")

    def both() -> None:
        stock()
        call()

    env._before_simulation_step = both
    try:
        yield
    finally:
        if own is None:
            del env._before_simulation_step
        else:
            env._before_simulation_step = own


def fetch(env: BaseEnv) -> None:
    """Fetch the tensors of the simulation, after ``scene.step()``: ``_gpu_fetch_all``."""
    env.scene._gpu_fetch_all()


def episode_generators(env: BaseEnv) -> dict[str, list[np.random.RandomState]]:
    """Each env's numpy generators: one for its episodes, one for its episode seeds."""
    return {"episode": env._batched_episode_rng.rngs, "main": env._batched_main_rng.rngs}


# --- what drawing and pictures read ----------------------------------------------------------------


def objects_of(struct: Any) -> list[Any]:
    """The SAPIEN objects behind an Actor, Link or Articulation: ``_objs``, one for each env that has it.

    An Actor's are entities, a Link's are link components, an Articulation's are physx articulations.
    """
    return struct._objs


def envs_of(struct: Any) -> NDArray[np.int64]:
    """The env of each of `objects_of`: ``_scene_idxs``."""
    return struct._scene_idxs.cpu().numpy().astype(np.int64)


def data_rows_of(struct: Any) -> torch.Tensor:
    """The row of each of `objects_of` in ``px.cuda_rigid_body_data``: ``_body_data_index``.

    Exists only where ``scene.gpu_sim_enabled``, after ``gpu_init``, and not for static bodies.
    """
    return struct._body_data_index


def agents(env: Any) -> list[Any]:
    """The agent of each robot in ``env.agent``; empty without a robot."""
    agent = env.agent
    return agent.agents if isinstance(agent, MultiAgent) else [] if agent is None else [agent]


def tool_of(agent: Any) -> Link | None:
    """The link of a robot's tool centre point, ``tcp``; None if there is no ``tcp``, or it is not a link."""
    try:
        tool = getattr(agent, "tcp", None)
    except Exception:  # a property of the author's, which ManiSkill itself never reads
        return None
    return tool if isinstance(tool, Link) else None


_TOOLS = ("tcp", "right_tcp", "left_tcp", "tcp_2")
"""Attributes in which ManiSkill's robots keep the links of their tool centre points."""


def tools_of(agent: Any) -> list[Link]:
    """The links of a robot's tool centre points; if there are none, the tip of its fixed finger, ``finger1_tip``."""
    kept = vars(agent)
    found = [kept[name] for name in _TOOLS if isinstance(kept.get(name), Link)]
    tip = kept.get("finger1_tip")
    return found or ([tip] if isinstance(tip, Link) else [])


def controller_configs(agent: Any) -> list[Any]:
    """The controller configs of all control modes of a robot, without the dicts that combine them."""
    if why_not(REACHING):
        return []
    modes = agent._controller_configs.values()
    return [part for mode in modes for part in (mode.values() if isinstance(mode, dict) else (mode,))]


def scaled_action(controller: Any, action: torch.Tensor) -> torch.Tensor:
    """(N, D) result of ``_preprocess_action``, with which a controller clips and scales an action (N, D)."""
    return controller._preprocess_action(action)


def data_rows_of_articulation(articulation: Any) -> torch.Tensor:
    """The articulation's row for each env in the joint tensors, such as ``px.cuda_articulation_qpos``: ``_data_index``."""
    return articulation._data_index


def joints_of(struct: Any) -> int:
    """Number of active joints of an Articulation, ``max_dof``; 0 for an Actor."""
    return int(getattr(struct, "max_dof", 0))


def named_to_hide(env: Any) -> list[Any]:
    """``_hidden_objects``; empty if the installed ManiSkill lacks a name of `HIDDEN`."""
    return [] if why_not(HIDDEN) else env._hidden_objects


def hidden_objects(env: Any) -> list[Any]:
    """The actors that the task hides from its sensors. ManiSkill cannot hide an Articulation, which has no ``hide_visual``."""
    return [each for each in named_to_hide(env) if isinstance(each, Actor)]


def pose_before_hiding(actor: Actor) -> torch.Tensor | None:
    """(M, 7) true pose of an actor that was moved away to hide it; None if it was not.

    In GPU simulation ``Actor.hide_visual`` keeps the pose in ``before_hide_pose`` and moves the actor 99999 m away. On the
    CPU, stock or batched (`simulation.hiding`), nothing moves.
    """
    return getattr(actor, "before_hide_pose", None) if actor.hidden else None


def unflattened_state(env: BaseEnv, info: dict[str, Any]) -> dict[str, Any]:
    """The observation that ``obs_mode="state"`` flattens: ``_get_obs_state_dict``. Runs the author's hooks."""
    return env._get_obs_state_dict(info)


def extra_observation(env: BaseEnv, info: dict[str, Any]) -> Any:
    """What the task adds to the robot's own observation: ``_get_obs_extra``. Runs the author's hook."""
    return env._get_obs_extra(info)


def cameras(env: Any) -> dict[CameraKey, Any]:
    """``_sensors`` (also tactile sensors), then ``_human_render_cameras``; empty without a render device."""
    lists: tuple[tuple[CameraKind, str], ...] = (("sensor", "_sensors"), ("human", "_human_render_cameras"))
    return {(kind, name): c for kind, held in lists for name, c in getattr(env, held, {}).items()}


def forget_cameras(env: Any) -> None:
    """Empty the camera lists of the env and its scene; `set_up_sensors` fills them again."""
    env._sensors, env._human_render_cameras = {}, {}
    env.scene.camera_groups.clear()
    env.scene.sensors, env.scene.human_render_cameras = {}, {}


def set_up_sensors(env: Any) -> None:
    """Make configs and cameras, as the last step of ``_reconfigure`` does."""
    env._setup_sensors({"reconfigure": True})


def flatten_observation(env: Any, obs: Any) -> Any:
    """Flatten an observation as ``step`` does after computing the reward: ``_flatten_raw_obs``."""
    return env._flatten_raw_obs(obs)


def camera_components(camera: Any) -> list[Any]:
    """The ``RenderCameraComponent`` of every env behind a ManiSkill camera: ``camera._render_cameras``.

    Empty for a sensor of a task's own class, and for the stereo depth camera (which ManiSkill 3.0.1 cannot
    build: its constructor needs an argument that BaseEnv does not pass).
    """
    inner = camera.camera if isinstance(camera, Camera) else None
    return inner._render_cameras if isinstance(inner, RenderCamera) else []


# --- what placing a camera writes ------------------------------------------------------------------


_note_camera: Callable[[Any, FrameType], None] | None = None


@contextmanager
def noting_cameras(note: Callable[[Any, FrameType], None]) -> Iterator[None]:
    """Context in which `note` is called with each new ``CameraConfig`` and the frame that makes it."""
    global _note_camera
    mark_camera_configs()
    before, _note_camera = _note_camera, note
    try:
        yield
    finally:
        _note_camera = before


def camera_configs(env: Any) -> dict[CameraKey, Any]:
    """Configs that the camera hooks return now, before keywords of ``gym.make`` change them."""
    of_agent = {} if env.agent is None else parse_cameras(env.agent._sensor_configs)
    sensors = {**parse_cameras(env._default_sensor_configs), **of_agent}
    people = parse_cameras(env._default_human_render_camera_configs)
    return {
        **{("sensor", name): config for name, config in sensors.items()},
        **{("human", name): config for name, config in people.items()},
    }


def sensor_configs_of_hooks(env: Any) -> tuple[list[Any], list[Any]]:
    """Configs that the task's and the robot's sensor hooks return now. Configs with the same name are all
    included."""
    of_robot = [] if env.agent is None else env.agent._sensor_configs
    return _listed(env._default_sensor_configs), _listed(of_robot)


def _listed(configs: Any) -> list[Any]:
    if isinstance(configs, dict):
        return [*configs.values()]
    return [*configs] if isinstance(configs, (list, tuple)) else [configs]


def mark_camera_configs() -> None:
    """Make every ``CameraConfig`` store the line that made it (`camera_site`) and the target of its
    ``look_at`` (`camera_target`), in tasks that are imported after this call. Safe to call again."""
    stock = CameraConfig.__init__
    if hasattr(stock, "_workbench_stock"):
        return
    stock_look_at = sapien_utils.look_at
    looked: deque[tuple[Pose, Any]] = deque(maxlen=64)
    """The last poses of ``look_at`` with their targets; tensors are read only when a camera is made, since a read waits for the GPU."""

    @wraps(stock)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        stock(self, *args, **kwargs)
        self._workbench_site = _place_of_call(sys._getframe(1))
        own = self.pose.raw_pose
        same = (to for pose, to in reversed(looked) if torch.equal(pose.raw_pose.to(own.device), own))
        self._workbench_target = next(same, None)
        if _note_camera is not None:
            _note_camera(self, sys._getframe(1))

    @wraps(stock_look_at)
    def look_at(eye: Any, target: Any, *args: Any, **kwargs: Any) -> Pose:
        pose = stock_look_at(eye, target, *args, **kwargs)
        looked.append((pose, target))
        return pose

    init._workbench_stock = stock  # type: ignore[attr-defined]
    CameraConfig.__init__ = init  # type: ignore[method-assign]
    sapien_utils.look_at = look_at


def _place_of_call(frame: FrameType) -> CallSite:
    code = frame.f_code
    # In a call over several lines `f_lineno` may be a later line.
    start = next(islice(code.co_positions(), frame.f_lasti // 2, None), (None,))[0]
    return CallSite(code.co_filename, start or frame.f_lineno, code.co_qualname)


def camera_site(config: Any) -> CallSite | None:
    """Where a config was made; None if unknown."""
    return getattr(config, "_workbench_site", None)


def camera_target(config: Any) -> Any:
    """The target of the ``look_at`` that made the config's pose; None without ``look_at``."""
    return getattr(config, "_workbench_target", None)


def set_up_camera(env: Any, key: CameraKey, camera: Any, config: Any, components: list[Any]) -> None:
    """Give a ``Camera`` this config and these components, which already match the config."""
    kind, name = key
    camera.config = config
    if hasattr(camera, "_shader_config"):
        # Nightly builds read the shader's textures from here, 3.0.1 from the config.
        camera._shader_config = config.shader_config
    (env._sensor_configs if kind == "sensor" else env._human_render_camera_configs)[name] = config
    inner: RenderCamera = camera.camera
    if inner._render_cameras is not components:
        inner._render_cameras = components
        # The scene makes the group again when it next draws the camera in all envs.
        inner.camera_group = None  # type: ignore[assignment]
        env.scene.camera_groups.pop(name, None)
    inner._cached_model_matrix = None  # type: ignore[assignment]
    inner._cached_extrinsic_matrix = None  # type: ignore[assignment]
    inner._cached_intrinsic_matrix = None  # type: ignore[assignment]
    inner._cached_local_pose = None  # type: ignore[assignment]
