"""Task classes with N envs on the CPU, each with its own PhysX scene and render system."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
import sapien.render
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.multi_agent import MultiAgent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import BackendInfo
from mani_skill.render.utils import can_render
from mani_skill.utils.structs import Articulation

from workbench.envs.backends import give_brdf_table
from workbench.envs.broken_rule import (
    NeedsOneEnv,
    Place,
    frames_of_the_task,
    in_brackets,
    place_of,
    place_of_hook,
    warn_of,
)
from workbench.envs.camera_data import CallSite, CameraKey, CameraKind, PictureDegree
from workbench.envs.error_notes import AuthorCall, CoreRefusal, RefusedCall, RefusedValue
from workbench.envs.gpu_rules import Degree, Finding, degrees_of
from workbench.envs.maniskill_private import (
    allowed_on_the_cpu,
    asks_for_a_gpu,
    base_arguments,
    camera_components,
    camera_site,
    clears_scene,
    envs_of,
    hook_of_base_env,
    install_base_env_hooks,
    install_row_lookups,
    mark_camera_configs,
    objects_of,
    scene_of,
    substeps_are_unwatched,
)
from workbench.envs.partial_reset import (
    TARGET_FLAGS,
    KeptControllers,
    in_ascending_order,
    note_what_was_reset,
    seeded,
    untouched_envs,
    without_target_flags,
)
from workbench.envs.rendering.camera_shader import install_drawable_cameras, note_shader
from workbench.envs.rendering.drawing import drawing, read_texture
from workbench.envs.rendering.fast_shader import FastCameras
from workbench.envs.rendering.fast_shapes import FastShapes, shown
from workbench.envs.robot_notes import note_robot_errors
from workbench.envs.simulation.accessors import guard_scenes, install_struct_access
from workbench.envs.simulation.contact_queries import CpuArray
from workbench.envs.simulation.cpu_system import BatchedCpuSystem, batched_system
from workbench.envs.simulation.drawn_poses import NOWHERE_ELSE, Places
from workbench.envs.simulation.hiding import install_hiding
from workbench.envs.snapshots.snapshot import begin_anew
from workbench.envs.snapshots.task_state import note_constructed, note_scene
from workbench.envs.strict import StrictMixin

_UNIT_TOLERANCE = 1e-3
"""A quaternion whose length differs from 1 by more than this is not of unit length."""
SIM_BACKEND = "physx_cpu_batched"
"""Name of this backend. It is not in ManiSkill's ``CPU_SIM_BACKENDS``, for which ManiSkill refuses more than
one env."""


_NO_WINDOW = (
    'render_mode="human" and render_human() open a window, and this process has no display (DISPLAY is not set). '
    "`workbench open` with this task's file or id shows all envs in the browser. For pictures "
    'use render_mode="rgb_array", "sensors" or "all" and render().'
)
_MAX_NESTED_CALLS = 16
"""Limit of nested calls of `step` and `reset`: a hook that steps in each step would otherwise end in a RecursionError."""


class BatchedSimDevice:
    """Stand-in for ``sapien.Device("cpu")`` where ManiSkill asks ``_sim_device.is_cuda()``.

    The answer True makes ManiSkill apply drive targets after an action, which the batched simulation needs.
    """

    def is_cuda(self) -> bool:
        return True

    def __repr__(self) -> str:
        return "BatchedSimDevice(cpu)"


class CpuCameraGroup:
    """One camera of every env, with the interface of SAPIEN's ``RenderCameraGroup``."""

    def __init__(
        self,
        cameras: list[sapien.render.RenderCameraComponent],
        scene: BatchedCpuScene,
        key: CameraKey | None,
    ) -> None:
        """
        Args:
            key: None for a camera that the task added to the scene directly, not as a sensor; its pictures
                are always exact.
        """
        self._cameras, self._scene, self.key = cameras, scene, key

        self.textures = {"Color"}
        """Textures of a fast picture: every texture that was read so far."""
        self._drawn = cameras
        """Cameras that drew the last picture (`take_picture`), with the textures in `_has`."""
        self._has: set[str] = set()

    def take_picture(self) -> None:
        if self.key is None:
            self._scene.px.refused_by_gpu(  # type: ignore[union-attr]
                f"A picture is taken with the camera '{self._cameras[0].name.partition('_')[2]}', which the "
                "task added to the scene directly: on the GPU this fails. Return it from "
                "_default_sensor_configs."
            )
            for camera in self._cameras:
                camera.take_picture()
            return
        self._has = {*self.textures}
        with self._drawing():
            self._drawn = [
                self._scene.take_picture(env, self.key, camera, self._has)
                for env, camera in enumerate(self._cameras)
            ]

    def get_picture_cuda(self, name: str) -> CpuArray:
        """(N, H, W, C) texture `name` of every env, on the CPU."""
        self.textures.add(name)
        if self.key is not None and name not in self._has and self._drawn != self._cameras:
            # The fast picture lacks this texture: draw once with the exact cameras, which `update_render` has also moved.
            with self._drawing():
                for env, camera in enumerate(self._cameras):
                    self._scene.take_picture(env, self.key, camera, None)
            self._drawn = self._cameras
        if self.key is None:
            pictures = [camera.get_picture(name) for camera in self._cameras]
        else:
            pictures = [read_texture(camera, name, self.key, self._site()) for camera in self._drawn]
        return CpuArray(torch.stack([torch.from_numpy(picture) for picture in pictures]))

    def _drawing(self) -> AbstractContextManager[None]:
        return nullcontext() if self.key is None else drawing(self.key, self._site())

    def _site(self) -> CallSite | None:
        return None if self.key is None else camera_site(self._scene.camera(self.key).config)


class BatchedCpuScene(ManiSkillScene):
    """N sub-scenes, each with its own CPU physics and render system, as one ManiSkill scene."""

    def __init__(
        self,
        sub_scenes: list[sapien.Scene],
        threads: int | None,
        system_class: type[BatchedCpuSystem] = BatchedCpuSystem,
        **kwargs: Any,
    ) -> None:
        super().__init__(sub_scenes, **kwargs)
        self.px = system_class(sub_scenes, threads)  # type: ignore[assignment]
        self.gpu_sim_enabled = True
        self.pictures: PictureDegree = "exact"
        self._fast: tuple[FastShapes, FastCameras] | None = None

    def take_picture(
        self,
        env: int,
        key: CameraKey,
        camera: sapien.render.RenderCameraComponent,
        textures: Collection[str] | None,
        degree: PictureDegree | None = None,
    ) -> sapien.render.RenderCameraComponent:
        """Start drawing a picture; returns the camera from which to read its textures.

        Args:
            camera: the camera with this key in this env.
            textures: textures that a fast picture needs; None: `camera` itself draws all of its textures.
            degree: None for the scene's own degree. Before a fast picture, call `prepare_fast`, then
                ``update_render``.
        """
        if self.degree_of(camera, degree) == "exact":
            camera.take_picture()
            return camera
        shapes, cameras = self._fast_parts()
        drawing = camera if textures is None else cameras.camera_for(camera, textures)
        with shown(shapes.bodies(key, env)):
            drawing.take_picture()
        return drawing

    def degree_of(
        self, camera: sapien.render.RenderCameraComponent, asked: PictureDegree | None = None
    ) -> PictureDegree:
        """The degree at which a picture is drawn if `asked` is requested; None requests the scene's own
        degree.

        Always exact if the camera's quaternion is not of unit length (as after ``look_at`` straight down):
        SAPIEN turns and zooms such a picture, so it is unknown which bodies are out of view.
        """
        if (asked or self.pictures) == "exact" or abs(
            float(np.linalg.norm(camera.local_pose.q)) - 1
        ) > _UNIT_TOLERANCE:
            return "exact"
        return "fast"

    def prepare_fast(
        self, env: int, key: CameraKey, textures: Collection[str], places: Places = NOWHERE_ELSE
    ) -> None:
        """Choose the shapes of a fast picture, and move the fast camera to the present pose of this camera.

        Makes the shapes and the fast camera if they are missing.

        Args:
            places: poses at which bodies of the env are drawn instead of their simulated poses.
        """
        sensor = self.camera(key)
        components = camera_components(sensor)
        if self.degree_of(components[env], "fast") == "exact":
            return
        shapes, cameras = self._fast_parts()
        shapes.prepare(env, key, components, places)
        cameras.follow(env, sensor.config, components[env], textures)

    def forget_fast_shapes(self) -> None:
        """Discard the fast shapes, because the cameras have changed; the next picture makes new ones."""
        if self._fast is not None:
            self._fast[0].remove()
            self._fast = None

    def _fast_parts(self) -> tuple[FastShapes, FastCameras]:
        if self._fast is None:
            self._fast = FastShapes(self.sub_scenes), FastCameras(self.sub_scenes)
        return self._fast

    def camera(self, key: CameraKey) -> Any:
        """ManiSkill's sensor or human camera of this key."""
        kind, name = key
        return (self.sensors if kind == "sensor" else self.human_render_cameras)[name]

    def create_actor_builder(self) -> Any:
        # ManiSkill adds a plane once per builder, because all envs on a GPU share one physics scene. Without
        # this flag, every env but the first would have no ground.
        return super().create_actor_builder().set_allow_overlapping_plane_collisions(True)

    def _sapien_add_camera(self, *args: Any, **kwargs: Any) -> Any:
        # In GPU simulation a camera on a link gets a GPU pose index, which a CPU body lacks. Here the camera
        # moves with its entity.
        self.gpu_sim_enabled = False
        try:
            camera = super()._sapien_add_camera(*args, **kwargs)
        finally:
            self.gpu_sim_enabled = True
        for component in camera._render_cameras:
            note_shader(component)
            give_brdf_table(component)
        camera.camera_group = CpuCameraGroup(camera._render_cameras, self, None)  # type: ignore[assignment]
        return camera

    def _sapien_update_render(
        self, update_sensors: bool = True, update_human_render_cameras: bool = True
    ) -> None:
        chosen: list[tuple[CameraKind, dict[str, Any]]] = []
        if update_sensors:
            chosen.append(("sensor", self.sensors))
        if update_human_render_cameras:
            chosen.append(("human", self.human_render_cameras))
        for kind, cameras in chosen:
            for name, sensor in cameras.items():
                components = camera_components(sensor)  # empty if the sensor is not a camera
                if components and getattr(sensor.camera.camera_group, "key", None) is None:
                    group = CpuCameraGroup(components, self, (kind, name))
                    sensor.camera.camera_group = self.camera_groups[name] = group  # type: ignore
        self._system.catch_up()
        for env, sub_scene in enumerate(self.sub_scenes):
            for kind, cameras in chosen if self.pictures == "fast" else ():
                for name, sensor in cameras.items():
                    if camera_components(sensor) and isinstance(
                        group := sensor.camera.camera_group, CpuCameraGroup
                    ):
                        self.prepare_fast(env, (kind, name), group.textures)
            sub_scene.update_render()

    @property
    def _system(self) -> BatchedCpuSystem:
        return self.px  # type: ignore[return-value]

    @property
    def _gpu_sim_initialized(self) -> bool:
        """Read by ManiSkill, which allows some calls only while it is False; see `allowed_on_the_cpu`."""
        return not allowed_on_the_cpu(sys._getframe(1), self._system.laid_out)

    @_gpu_sim_initialized.setter
    def _gpu_sim_initialized(self, value: bool) -> None:
        """Ignore the value that ManiSkill's constructor sets."""

    def _setup(self, enable_gpu: bool) -> None:
        # As in a stock CPU env, values that were set while the scene was built stay, except for the poses.
        self._system.gpu_init()
        super()._setup(enable_gpu=False)
        self._gpu_apply_all()
        self._gpu_fetch_all()
        self._system.keep_beginning()

    def get_human_render_camera_images(self, camera_name: str | None = None) -> dict[str, torch.Tensor]:
        # ManiSkill refuses ray tracing if one camera group draws all envs. Here each camera draws alone.
        images = {}
        for name, camera in self.human_render_cameras.items():
            if camera_name in (None, name):
                camera.capture()
                images[name] = camera.get_obs(rgb=True, depth=False, segmentation=False, position=False)[
                    "rgb"
                ]
        return images

    def _gpu_apply_all(self) -> None:
        if self._needs_fetch:
            self._system.refused_by_gpu(
                "self.scene._gpu_apply_all() is called twice without self.scene._gpu_fetch_all() after the "
                f"first call{self._applied_at}: on the GPU this fails. Fetch after every apply, and once "
                "before the end of _initialize_episode, because ManiSkill applies after it."
            )
        self._applied_at = in_brackets(place_of(frames_of_the_task())) or " (ManiSkill's own)"
        self._system.apply_changes()
        self._needs_fetch = True

    def remove_articulation(self, articulation: Articulation) -> None:
        self._system.refused_by_gpu(
            f"'{articulation.name}' is removed from the scene: on the GPU this fails. Move it out of sight."
        )
        for env, each in zip(envs_of(articulation).tolist(), objects_of(articulation), strict=True):
            for entity in [link.entity for link in each.links]:
                self.sub_scenes[env].remove_entity(entity)
        self.articulations.pop(articulation.name)
        self._system.note_structure()

    def step(self) -> None:
        self.px.step()


class BatchedCpuMixin:
    """Mixin for batched CPU simulation; among the bases it stands before the author's class.

    ManiSkill 3.0.1 refuses ``num_envs > 1`` on the CPU in four places: the name of the simulation backend,
    one ``is_cuda()``, the scene that ``_setup_scene`` builds, and the groups of cameras. This mixin replaces
    those four; the author's class and stock ``gym.make`` are not changed. Each env has its own
    ``PhysxCpuSystem`` and ``RenderSystem``, so no other env can affect it, and a picture of env i renders env
    i alone.
    """

    num_envs: int
    _system_class = BatchedCpuSystem
    _workbench_task: type[BaseEnv]
    """The author's class, without this mixin."""
    _workbench_threads: int | None
    """Threads that step the envs; None for one on each core."""
    _workbench_pictures: PictureDegree
    _kept_controllers: KeptControllers | None = None
    begins_anew = False
    """Whether each reset is an exact point, from which an episode can be repeated to the last bit."""
    _to_begin: list[int] | None = None
    """During a reset with `begins_anew`: the envs that it has initialised, for `begin_anew`. Else None."""
    _sim_freq: int
    _sim_steps_per_control: int
    _set_scene_config: Any
    sim_config: Any
    _elapsed_steps: torch.Tensor
    agent: Any
    device: torch.device
    _is_closed = False
    _nested = 0
    """Number of steps and resets that are running."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if kwargs.get("parallel_in_single_scene"):
            raise RefusedValue(
                "parallel_in_single_scene is not possible with the batched CPU core: the page "
                "shows all envs side by side without it."
            )
        if kwargs.get("render_mode") == "human":
            _require_display()
        _refuse_frequencies(kwargs.get("sim_config"))
        wanted = kwargs.get("num_envs", 1)
        # Check before ManiSkill makes random generators for each env.
        require_scenes(wanted)
        with base_arguments(self, self._workbench_task, kwargs) as passed_on, AuthorCall():
            super().__init__(*args, **passed_on)
        refuse_unbuilt_env(self, self._workbench_task, wanted)  # type: ignore[arg-type]
        note_constructed(self)  # type: ignore[arg-type]

    @property
    def scene(self) -> Any:
        """
        Raises:
            EnvClosed: the env is closed.
        """
        made = self.__dict__.get("scene")
        if made is None and self._is_closed:
            raise EnvClosed("this env is closed: make another one")
        return made

    @scene.setter
    def scene(self, value: Any) -> None:
        if value is None and not clears_scene(sys._getframe(1)):
            raise RefusedCall("self.scene is set to None: the env cannot go on without its scene.")
        self.__dict__["scene"] = value

    def close(self) -> None:
        if hook := hook_of_base_env(self, sys._getframe(1)):
            raise RefusedCall(
                f"self.close() is called within {hook}(): the env cannot go on once it is closed."
            )
        super().close()  # type: ignore[misc]
        self._is_closed = True

    @property
    def gpu_sim_enabled(self) -> bool:
        """True, so that ManiSkill takes its batched code path; False for a caller that `asks_for_a_gpu`."""
        return self.scene.gpu_sim_enabled and not asks_for_a_gpu(sys._getframe(1))

    def render_human(self) -> Any:
        _require_display()
        return super().render_human()  # type: ignore[misc]

    @property
    def backend(self) -> BackendInfo:
        return self._backend

    @backend.setter
    def backend(self, value: BackendInfo) -> None:
        # BaseEnv.__init__ compares this name with those for which it refuses num_envs > 1.
        self._backend = replace(value, sim_backend=SIM_BACKEND)

    @property
    def _sim_device(self) -> BatchedSimDevice:
        return BatchedSimDevice()

    @_sim_device.setter
    def _sim_device(self, value: sapien.Device) -> None:
        """Ignore the device that BaseEnv parsed from the backend."""

    def step(self, action: Any) -> Any:
        resetting = self.scene.px.resetting
        before = self._elapsed_steps.clone()
        with self._in_turn("step"), AuthorCall():
            result = super().step(action)  # type: ignore[misc]
        if resetting is not None:
            # A hook of a partial reset made this step: only the envs that are being reset count it.
            self._elapsed_steps[~resetting] = before[~resetting]
        return result

    @contextmanager
    def _in_turn(self, what: str) -> Iterator[None]:
        """Context of a step or a reset; refuses the call if `_MAX_NESTED_CALLS` are running already."""
        if self._nested >= _MAX_NESTED_CALLS:
            raise RefusedCall(
                f"{what}() was called {_MAX_NESTED_CALLS} times within itself: a hook that it runs calls it again."
            )
        self._nested += 1
        try:
            with drawing_alone():
                yield
        finally:
            self._nested -= 1

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        with self._in_turn("reset"):
            return self._reset_in_turn(seed, options)

    def _reset_in_turn(self, seed: Any, options: dict[str, Any] | None) -> Any:
        untouched = untouched_envs(self, options)
        options, seeds = in_ascending_order(options or {}, seed, self)
        # ManiSkill takes a list of seeds as the seeds of the whole batch.
        if not untouched or seeds is None or len(seeds) == 1:
            given: Any = nullcontext()
        else:
            given, seed = seeded(self, options["env_idx"].tolist(), seeds), None
        self._kept_controllers = KeptControllers(self, untouched) if untouched else None
        self._to_begin = [] if self.begins_anew else None
        if untouched:
            chosen = torch.ones(self.num_envs, dtype=torch.bool)
            chosen[untouched] = False
            self.scene.px.resetting = chosen
        try:
            with AuthorCall(), note_robot_errors(), note_what_was_reset(self, untouched), given:
                return super().reset(seed=seed, options=options)  # type: ignore[misc]
        except BaseException:
            self.drop_writes()
            raise
        finally:
            self._kept_controllers = self._to_begin = None
            if untouched and scene_of(self) is not None:
                self.scene.px.resetting = None

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        super()._initialize_episode(env_idx, options)  # type: ignore[misc]
        if self._to_begin is not None:
            self._to_begin = env_idx.tolist()

    def _clear_sim_state(self) -> None:
        self.scene.px.heal(torch.nonzero(self.scene._reset_mask)[:, 0].tolist())
        super()._clear_sim_state()  # type: ignore[misc]

    def _load_agent(self, *args: Any, **kwargs: Any) -> None:
        super()._load_agent(*args, **kwargs)  # type: ignore[misc]
        refuse_unbuilt_agent(self.agent)

    def _after_reconfigure(self, options: dict[str, Any]) -> None:
        super()._after_reconfigure(options)  # type: ignore[misc]
        note_scene(self)  # type: ignore[arg-type]

    def get_info(self) -> dict[str, Any]:
        # During a reset, BaseEnv calls this right after it has reset the controllers of all envs.
        if self._kept_controllers is not None:
            self._kept_controllers.put_back()
        if self._to_begin and not self.scene._needs_fetch:
            # After the reset's writes are applied and fetched, before `evaluate` writes anything.
            begin_anew(self, self._to_begin)
            self._to_begin = None
        return super().get_info()  # type: ignore[misc]

    def _step_action(self, action: Any) -> Any:
        # Substeps may be merged only if no code of the author's runs between them.
        px: BatchedCpuSystem = self.scene.px  # type: ignore[assignment]
        unwatched = substeps_are_unwatched(self, self._workbench_task)
        for controller in without_target_flags(self):
            for flag in TARGET_FLAGS:
                # True is safe: only targets that changed are applied, so a controller that sets none changes nothing.
                setattr(controller, flag, getattr(controller, flag, True))
        try:
            with px.merging(self._sim_steps_per_control if unwatched else 1):
                return super()._step_action(action)  # type: ignore[misc]
        except BaseException:
            self.drop_writes()
            raise

    def drop_writes(self) -> None:
        """Discard writes to the simulation's tensors that were not applied."""
        # Without this, every later reset would apply what a failed hook had written (a NaN, for example). If
        # the hook had applied and not fetched, the next reset would raise.
        if scene_of(self) is not None and self.scene.px.laid_out:
            self.scene.px.drop_writes()
            self.scene._gpu_fetch_all()

    def _make_scene(self) -> None:
        """Build the scene in place of ``BaseEnv._setup_scene``, which a task's own ``_setup_scene`` may call."""
        require_scenes(self.num_envs)
        self._set_scene_config()
        sub_scenes = []
        for _ in range(self.num_envs):
            systems: list[Any] = [physx.PhysxCpuSystem()]
            if can_render(self.backend.render_device):
                systems.append(sapien.render.RenderSystem(self.backend.render_device))
            sub_scenes.append(sapien.Scene(systems))
        self.scene = BatchedCpuScene(
            sub_scenes,
            self._workbench_threads,
            self._system_class,
            sim_config=self.sim_config,
            device=self.device,
            backend=self.backend,  # type: ignore
        )
        self.scene.pictures = self._workbench_pictures
        self.scene.px.timestep = 1.0 / self._sim_freq
        guard_scenes(self.scene.px)  # type: ignore[arg-type]


def _is_batched(scene: Any) -> bool:
    return isinstance(scene, BatchedCpuScene)


def batched_class(
    task: type[BaseEnv],
    threads: int | None = None,
    rules: Degree | None = None,
    on_finding: Callable[[Finding], None] = warn_of,
    pictures: PictureDegree = "exact",
) -> type[BaseEnv]:
    """A subclass of `task` with the batched CPU simulation; `task` itself is not changed.

    Args:
        rules: the degree of all rules of GPU simulation; None: each rule has its own degree, see `gpu_rules`.
        on_finding: called once for each place where a rule that does not stop the task is broken.
        pictures: degree of the pictures that the env itself draws.
    """
    install_row_lookups(batched_system)
    install_struct_access()
    install_base_env_hooks()
    install_hiding()
    install_drawable_cameras(_is_batched)
    mark_camera_configs()
    namespace = {
        "__module__": task.__module__,
        "__doc__": task.__doc__,
        "__qualname__": task.__qualname__,
        "_workbench_task": task,
        "_workbench_threads": threads,
        "_workbench_pictures": pictures,
    }
    if all(degree == "off" for degree in degrees_of(rules).values()):
        return type(task.__name__, (BatchedCpuMixin, task), namespace)
    namespace |= {"_rule_choice": rules, "_on_finding": staticmethod(on_finding)}
    return type(task.__name__, (StrictMixin, BatchedCpuMixin, task), namespace)


# --- how many scenes a process can hold --------------------------------------------------------------


_SPARE_KEYS = 8
"""Number of thread-local keys kept free: for threads, drivers and libraries that start later, and the second scene
during a restore."""


def require_scenes(count: int) -> None:
    """Check that this process can hold `count` more PhysX scenes.

    Raises:
        ValueError: it cannot; the message has the number that it can hold.
    """
    free = free_thread_keys()
    if free is not None and count > free - _SPARE_KEYS:
        raise RefusedValue(
            f"num_envs={count} is more than this process has room for: PhysX takes one of Linux's 1024 thread-local "
            f"keys for each env, and {max(free - _SPARE_KEYS, 0)} are left here. Use fewer envs, close envs that "
            "are not needed, or divide the envs among processes."
        )


def free_thread_keys() -> int | None:
    """How many more thread-local keys this process can take; None where no limit is known.

    Each PhysX scene takes one (``PxTlsAlloc`` in PhysX's NpScene). Linux has 1024 (``PTHREAD_KEYS_MAX``), of which SAPIEN
    and torch take some twenty at import. Without a free key the process dies in native code: "Couldn't create autoTSSkey
    mapping". The keys are counted by taking all and giving them back.
    """
    if not sys.platform.startswith("linux"):
        return None
    library = ctypes.CDLL(None)
    key, taken = ctypes.c_uint(), []
    while library.pthread_key_create(ctypes.byref(key), None) == 0:
        taken.append(key.value)
    for value in taken:
        library.pthread_key_delete(ctypes.c_uint(value))
    return len(taken)


# --- calls and options that are refused ---------------------------------------------------------------


class EnvClosed(AttributeError):
    """The env was closed: it has no scene."""


def _require_display() -> None:
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise RefusedValue(_NO_WINDOW)


def _refuse_frequencies(config: Any) -> None:
    given = config if isinstance(config, Mapping) else vars(config) if config is not None else {}
    for name in ("sim_freq", "control_freq"):
        value = given.get(name, 1)
        if not isinstance(value, (int, float)) or value <= 0:
            raise RefusedValue(f"sim_config: {name} must be a number of Hz above 0, not {value!r}")


_drawing: dict[int, str] = {}
"""Names of the threads that are stepping or resetting an env, by thread id."""


@contextmanager
def drawing_alone() -> Iterator[None]:
    """Context that warns if another thread steps or resets an env at the same time."""
    me, outermost = threading.get_ident(), threading.get_ident() not in _drawing
    if _drawing.keys() - {me}:
        warnings.warn(_SHARED_GENERATOR, RuntimeWarning, stacklevel=5)
    if outermost:
        _drawing[me] = threading.current_thread().name
    try:
        yield
    finally:
        if outermost:
            del _drawing[me]


_SHARED_GENERATOR = (
    "Two threads step or reset envs at the same time: torch has one random generator for all of them, so the same seed does "
    "not give the same episode twice. Use a process for each env, or one env with more envs in its batch."
)


# --- constructors ------------------------------------------------------------------------------------


class ForgottenInit(CoreRefusal, RuntimeError):
    """A constructor did not call its parent's constructor. Without this check, the first use of the object
    would fail elsewhere ("weak reference to 'NoneType'")."""


def refuse_unbuilt_env(env: BaseEnv, task: type[BaseEnv], num_envs: int) -> None:
    """Check that the constructor of `task`, which has run, has built the env with `num_envs` envs.

    Raises:
        ForgottenInit: ``BaseEnv.__init__`` was not called.
        NeedsOneEnv: ``BaseEnv.__init__`` was called with another number of envs.
    """
    if scene_of(env) is None:
        cls, place = _culprit(task, BaseEnv, silent=True)
        raise ForgottenInit(
            f"{cls.__name__}.__init__ ends without super().__init__(*args, **kwargs), so nothing was built"
            f"{in_brackets(place)}. Call it there, after setting what the hooks need: that call builds the "
            "scene and resets the env.",
            place=place,
        )
    if env.num_envs != num_envs:
        cls, place = _culprit(task, BaseEnv, silent=False)
        raise NeedsOneEnv(
            f"{num_envs} envs were requested and {env.num_envs} built: {cls.__name__}.__init__ does not pass "
            "num_envs on",
            " Or pass its keyword arguments to super().__init__(*args, **kwargs).",
            place,
        )


def refuse_unbuilt_agent(agent: Any) -> None:
    """Check that ``_load_agent``, which has run, has loaded each robot.

    Raises:
        ForgottenInit: ``BaseAgent.__init__`` was not called.
    """
    for robot in agent.agents if isinstance(agent, MultiAgent) else [agent]:
        if isinstance(robot, BaseAgent) and not hasattr(robot, "robot"):
            cls, place = _culprit(type(robot), BaseAgent, silent=True)
            raise ForgottenInit(
                f"{cls.__name__}.__init__ ends without super().__init__(*args, **kwargs), so the robot was not loaded"
                f"{in_brackets(place)}. Call it there.",
                place=place,
            )


def _culprit(cls: type, base: type, silent: bool) -> tuple[type, Place | None]:
    """The class at fault, and the place of its constructor.

    It is the first class that has a constructor, in the order of inheritance from `cls` to `base`; with
    `silent`, preferably the first whose constructor calls no other constructor.
    """
    every = cls.__mro__[: cls.__mro__.index(base)]
    own = [owner for owner in every if hasattr(vars(owner).get("__init__"), "__code__")]
    named = [owner for owner in own if "__init__" in vars(owner)["__init__"].__code__.co_names]
    at_fault = [owner for owner in own if silent and owner not in named] or own
    return (at_fault[0], place_of_hook(at_fault[0], "__init__")) if own else (cls, None)
