"""What the core reads and changes of ManiSkill's own objects: cameras of chosen envs, hooks between substeps, tools."""

# ManiSkill annotates an env's members as the widest thing they may be.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

import copy
import inspect
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.render import PREBUILT_SHADER_CONFIGS
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

from tests.drive.envs import PICK_CUBE, batched
from tests.envs.watched import RENDERED, Watched
from tests.envs.written import Written
from workbench.envs import backends
from workbench.envs import maniskill_private as private
from workbench.envs.backends import sapien_device
from workbench.envs.camera_data import CallSite
from workbench.envs.error_notes import RefusedCall
from workbench.envs.rendering.camera_shader import is_ray_traced, replaced_shader
from workbench.envs.rendering.drawing import CannotDraw, drawing, read_texture
from workbench.envs.simulation.drawn_poses import camera_pose, drawn_at, temporarily
from workbench.envs.simulation.strict_system import envs_named
from workbench.envs.task_env import TaskEnv

N = 3


@pytest.fixture(scope="module")
def watched(renderer: None) -> Iterator[Any]:
    env = batched(Watched, N, render=True, **RENDERED)
    env.reset(seed=0)
    yield env
    env.close()


SETTERS: dict[str, tuple[Any, Any]] = {
    "near": (lambda camera: camera.set_near(0.5), lambda component: component.near),
    "far": (lambda camera: camera.set_far(5), lambda component: component.far),
    "lens": (lambda camera: camera.set_fovy(0.7), lambda component: component.fovy),
    "pose": (lambda camera: camera.set_local_pose(sapien.Pose([1, 2, 3])), lambda c: c.local_pose.p.tolist()),
    "property": (lambda camera: setattr(camera, "near", 0.25), lambda component: component.near),
}


@pytest.mark.parametrize("what", SETTERS)
def test_a_camera_is_changed_in_the_envs_that_are_being_reset(watched: Any, what: str) -> None:
    change, read = SETTERS[what]
    sensor = watched.scene.sensors["beside"]
    components = private.camera_components(sensor)
    before = [read(component) for component in components]
    matrices = sensor.camera.get_extrinsic_matrix().clone(), sensor.camera.get_model_matrix().clone()
    with private.setting_only(watched, [1]):
        change(sensor.camera)
    changed = [read(component) != was for component, was in zip(components, before, strict=True)]
    assert changed == [False, True, False]
    if what == "pose":
        for now, was in zip(
            (sensor.camera.get_extrinsic_matrix(), sensor.camera.get_model_matrix()), matrices, strict=True
        ):
            assert (now != was).flatten(1).any(dim=1).tolist() == [False, True, False]
    change(sensor.camera)
    assert len({str(read(component)) for component in components}) == 1, "outside of a reset all envs change"


def test_an_unknown_texture_and_a_failure_of_the_renderer_name_the_camera_and_its_line(watched: Any) -> None:
    component = private.camera_components(watched.scene.sensors["beside"])[0]
    site = CallSite("task.py", 7, "Task._default_sensor_configs")
    for given, place in ((site, ("task.py", 7, "_default_sensor_configs")), (None, None)):
        with pytest.raises(CannotDraw) as caught:
            read_texture(component, "Nope", ("sensor", "beside"), given)
        assert caught.value.key == ("sensor", "beside") and caught.value.place == place
        assert "beside" in str(caught.value) and "Color" in str(caught.value)
        assert ("task.py:7" in str(caught.value)) == (given is not None)
        with pytest.raises(CannotDraw, match="no memory") as failed, drawing(("human", "people"), given):
            raise RuntimeError("no memory")
        assert failed.value.key == ("human", "people") and failed.value.place == place
        with pytest.raises(CannotDraw) as same, drawing(("sensor", "other"), given):
            raise caught.value
        assert same.value is caught.value


def test_one_camera_for_people_is_drawn_alone(watched: Any) -> None:
    watched.scene.update_render()
    both = watched.scene.get_human_render_camera_images()
    assert both.keys() == {"people"} and both["people"].shape[0] == N
    assert watched.scene.get_human_render_camera_images("people").keys() == {"people"}
    assert watched.scene.get_human_render_camera_images("nobody") == {}


def test_a_config_has_the_target_of_its_look_at_and_is_noted() -> None:
    private.mark_camera_configs()
    noted: list[Any] = []
    looking = [sapien_utils.look_at([1, 0, 1], [0, 0, z]) for z in (0.0, 0.5)]
    with private.noting_cameras(lambda config, frame: noted.append((config, frame.f_code.co_filename))):
        made = [CameraConfig(f"{k}", pose, 8, 6, fov=1.0) for k, pose in enumerate([*looking, sapien.Pose()])]
    CameraConfig("later", looking[0], 8, 6, fov=1.0)
    assert all(__file__ == file for _, file in noted)
    assert [config for config, _ in noted] == made
    targets = [private.camera_target(config) for config in made]
    assert [None if target is None else [*target] for target in targets] == [[0, 0, 0.0], [0, 0, 0.5], None]


def test_a_config_knows_where_it_was_made(monkeypatch: pytest.MonkeyPatch) -> None:
    # Running an author's hooks patches the class for the rest of the process: restore ManiSkill's own.
    stock = getattr(CameraConfig.__init__, "_workbench_stock", CameraConfig.__init__)
    monkeypatch.setattr(CameraConfig, "__init__", stock)
    monkeypatch.setattr(sapien_utils, "look_at", sapien_utils.look_at)  # restored after the test
    private.mark_camera_configs()
    private.mark_camera_configs()

    def hook() -> list[CameraConfig]:
        pose = sapien.Pose()
        return [
            CameraConfig("a", pose, 8, 6, fov=1.0),
            CameraConfig(
                "b",
                pose=sapien.Pose(
                    [0, 0, 1]
                ),
                width=8, height=6, fov=1.0,
            ),
        ]  # fmt: skip

    first = inspect.getsourcelines(hook)[1]
    sites = [private.camera_site(copy.copy(config)) for config in hook()]
    assert [site and (site.file, site.line - first) for site in sites] == [(__file__, 3), (__file__, 4)]
    if sys.version_info >= (3, 11):
        assert sites[0].function == "test_a_config_knows_where_it_was_made.<locals>.hook"  # type: ignore[union-attr]
    monkeypatch.setattr(CameraConfig, "__init__", stock)
    assert private.camera_site(hook()[0]) is None


def test_a_call_before_each_substep_comes_after_the_tasks_own_and_ends_with_its_context() -> None:
    seen: list[str] = []

    class Notes(Written):
        def _before_simulation_step(self) -> None:
            seen.append("task")

    env = batched(Notes, 2, obs_mode="none", reward_mode="none")
    env.reset(seed=0)
    substeps = env._sim_steps_per_control
    for wrapped in (False, True):
        if wrapped:  # as RecordEpisode replaces a hook on the env
            env._before_simulation_step = lambda: seen.append("wrapper")
        own = "wrapper" if wrapped else "task"
        seen.clear()
        with pytest.raises(ZeroDivisionError), private.before_each_substep(env, lambda: seen.append("call")):
            env.step(None)
            assert seen == [own, "call"] * substeps
            raise ZeroDivisionError
        seen.clear()
        env.step(None)
        assert seen == [own] * substeps
    env.close()


def test_setters_reach_only_the_chosen_envs_within_the_context() -> None:
    env = batched(Written, N, rules="off", obs_mode="none", reward_mode="none")
    env.reset(seed=0)
    with pytest.raises(ZeroDivisionError), private.setting_only(env, [0, 2]):
        env.chain.set_qpos(torch.tensor([[0.1, 0.2], [0.3, 0.4]]))
        env.falls.set_mass(3.0)
        env.falls.set_disable_gravity(True)
        env.first_joint.set_drive_properties(70, 7)
        env.second_joint.set_limits([[-0.5, 0.5]])
        env.last.set_linear_damping(0.7)
        raise ZeroDivisionError
    assert torch.equal(env.chain.qpos, torch.tensor([[0.1, 0.2], [0, 0], [0.3, 0.4]]))
    bodies, joints = env.falls._bodies, [chain.active_joints for chain in env.chain._objs]
    chosen = [True, False, True]
    assert [body.mass == 3 for body in bodies] == [body.disable_gravity for body in bodies] == chosen
    assert [first.stiffness == 70 for first, _ in joints] == chosen
    assert [second.limits[0, 1] == 0.5 for _, second in joints] == chosen
    assert [link.linear_damping == pytest.approx(0.7) for link in env.last._bodies] == chosen
    env.chain.set_qpos(torch.full((N, 2), 0.5))
    assert (env.chain.qpos == 0.5).all()
    env.close()


def test_an_articulation_is_removed_from_every_env_and_the_rest_is_read_as_before() -> None:
    env = batched(Written, N, rules="off", obs_mode="none", reward_mode="none")
    env.reset(seed=0)
    before = env.falls.pose.raw_pose.clone()
    count = [len(scene.entities) for scene in env.scene.sub_scenes]
    env.scene.remove_articulation(env.chain)
    assert "chain" not in env.scene.articulations
    assert [was - len(scene.entities) for was, scene in zip(count, env.scene.sub_scenes, strict=True)] == [
        3
    ] * N
    assert torch.equal(env.falls.pose.raw_pose, before)
    env.step(None)
    env.close()


def test_the_tools_of_a_robot_are_its_links() -> None:
    env = batched(PICK_CUBE, 2)
    robot = env.agent
    assert private.tool_of(robot) is robot.tcp and private.tools_of(robot) == [robot.tcp]
    links = robot.robot.links
    made = SimpleNamespace(
        tcp="a name", right_tcp=links[3], left_tcp=links[4], tcp_2=links[5], finger1_tip=links[6]
    )
    assert private.tool_of(made) is None and private.tools_of(made) == [links[3], links[4], links[5]]
    assert private.tools_of(SimpleNamespace(finger1_tip=links[6])) == [links[6]]
    assert private.tools_of(SimpleNamespace(finger1_tip="x")) == []

    class Fails:
        @property
        def tcp(self) -> None:
            raise KeyError

    assert private.tool_of(Fails()) is None
    env.close()


@pytest.mark.parametrize(
    ("name", "device"),
    [("cpu", "cpu"), ("sapien_cpu", "cpu"), ("gpu", "cuda"), ("sapien_cuda", "cuda"), ("cuda", "cuda")]
    + [("gpu:1", "cuda:1"), ("cuda:1", "cuda:1"), ("pci:0000:01", "pci:0000:01")],
)
def test_maniskills_names_of_render_devices(name: str, device: str) -> None:
    assert sapien_device(name) == device


def test_a_shader_that_was_replaced_is_named() -> None:
    assert {pack: is_ray_traced(pack) for pack in ("minimal", "default", "rt", "rt-fast")} == {
        "minimal": False,
        "default": False,
        "rt": True,
        "rt-fast": True,
    }
    drawn = {name: PREBUILT_SHADER_CONFIGS[name] for name in ("default", "rt", "rt-fast")}
    for asked, used, named in (
        ("rt-fast", "default", "rt-fast"),
        ("rt-fast", "rt-fast", ""),
        ("rt", "rt", ""),
        ("default", "default", ""),
    ):
        config: Any = SimpleNamespace(shader_pack=asked, shader_config=drawn[used])
        assert replaced_shader(config) == named
    assert replaced_shader(SimpleNamespace(shader_pack="rt", shader_config=None)) == ""


@pytest.mark.parametrize(
    ("envs", "named"),
    [([3], "env 3"), ([2, 0, 2], "envs 0, 2"), (range(8), "envs 0, 1, 2, 3, 4, 5, 6, 7")]
    + [(np.arange(11), "envs 0, 1, 2, 3, 4, 5, 6, 7 and 3 more")],
)
def test_envs_are_named_up_to_eight(envs: Any, named: str) -> None:
    assert envs_named(envs) == named


def test_a_refused_hiding_leaves_the_actor_and_a_translucent_one_returns_as_it_was(watched: Any) -> None:
    bodies = [e.find_component_by_type(sapien.render.RenderBodyComponent) for e in watched.rider._objs]
    for number, body in enumerate(bodies):
        body.visibility = 0.2 + 0.1 * number
    for _ in range(2):
        watched.rider.hide_visual()
        watched.rider.hide_visual()  # a second time changes nothing
        assert [body.visibility for body in bodies] == [0] * N and watched.rider.hidden
        moved = watched.rider.pose.raw_pose.clone()
        assert watched.rider.hidden, "reading its pose leaves it hidden"
        watched.rider.show_visual()
        assert [body.visibility for body in bodies] == pytest.approx([0.2, 0.3, 0.4])
        assert torch.equal(watched.rider.pose.raw_pose, moved)
    for body in bodies:
        body.visibility = 1.0
    with pytest.raises(RefusedCall):
        watched.wall[0].hide_visual()


def test_attributes_return_to_what_they_were_in_any_order_of_changes() -> None:
    owner = SimpleNamespace(x=1, y=2)
    with pytest.raises(ZeroDivisionError), temporarily([(owner, "x", 5), (owner, "y", 6), (owner, "x", 7)]):
        assert (owner.x, owner.y) == (7, 6)
        raise ZeroDivisionError
    with pytest.raises(AttributeError), temporarily([(owner, "x", 5), (owner, "nothing", 6)]):
        raise AssertionError
    assert (owner.x, owner.y) == (1, 2)


def test_a_camera_of_a_body_that_is_drawn_elsewhere_is_moved_with_it(watched: Any) -> None:
    """And back; the body itself stays."""
    on_actor, beside = (
        private.camera_components(watched.scene.sensors[name])[1] for name in ("on_actor", "beside")
    )
    entity = watched.rider._objs[1]
    was = [camera_pose(one, {}) for one in (on_actor, beside)]
    place = sapien.Pose([1, 2, 3], [0.7071068, 0, 0, 0.7071068])
    places = {id(entity): (entity, np.array([*place.p, *place.q], np.float32))}
    wanted = place * on_actor.local_pose
    for _ in range(2):
        with drawn_at(places, [on_actor, beside]) as move_bodies:
            move_bodies()
            np.testing.assert_allclose(on_actor.get_global_pose().p, wanted.p, atol=1e-5)
            np.testing.assert_allclose(beside.get_global_pose().p, was[1].p)
            np.testing.assert_allclose(entity.pose.p, was[0].p, atol=1e-6)
        np.testing.assert_allclose(on_actor.get_global_pose().p, was[0].p, atol=1e-6)
    np.testing.assert_allclose(camera_pose(on_actor, places).p, wanted.p, atol=1e-5)
    np.testing.assert_allclose(camera_pose(beside, places).p, was[1].p)


REPORT = """
GPU: NVIDIA none
  Supported: 0
GPU: llvmpipe (LLVM 15)
  Supported: 1
GPU: another
  Supported: 1
"""


def test_the_renderer_is_named_by_the_first_device_that_is_supported(
    renderer: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for report, name in ((REPORT, "llvmpipe (LLVM 15)"), ("", "unknown device")):
        monkeypatch.setattr(sapien.render, "get_device_summary", lambda report=report: report)
        found = backends.find_renderer.__wrapped__()
        assert found is not None and found.name == name


@pytest.mark.parametrize(
    ("mode", "pictures"),
    [("state", False), ("state_dict", False), ("none", False), ("rgb", True), ("depth+state", True)],
)
def test_a_mode_of_observation_has_pictures_or_not(mode: str, pictures: bool) -> None:
    assert TaskEnv(SimpleNamespace(obs_mode=mode)).observes_pictures == pictures
