"""Objects hidden from sensors: pictures of a batch equal those of stock ManiSkill's single CPU env."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose

from tests.envs.stock_env import Bare, batch_of, single
from tests.envs.watched import RENDERED, pictures
from workbench.envs.scene.scene_index import read_poses, scene_index
from workbench.envs.snapshots.snapshot import restore_snapshot, take_snapshot
from workbench.pictures.render import take_pictures

N = 3
SENSOR, PEOPLE = ("beside", "sensor", ("rgb", "segmentation")), ("people", "human", ("rgb",))
KINDS = ("parts", "own", "alone")


class Hides(Bare):
    """Boxes in a row, each hidden in a different way, that move in resets and steps."""

    def _load_scene(self, options: dict) -> None:
        parts = []
        for i, number in enumerate(self.env_numbers()):
            part = self._box(f"part_{number}", 0.05 + 0.02 * number, 0.6, [i])
            self._hidden_objects.append(part)
            parts.append(part)
        # Hidden one by one, but moved and read through the merged actor.
        self.parts = Actor.merge(parts, "parts")
        self.own = self._box("own", 0.08, 0.2)
        self._hidden_objects.append(self.own)
        self.alone = None
        if 1 in self.env_numbers():
            self.alone = self._box("alone", 0.08, -0.6, [self.env_numbers().index(1)])
            self._hidden_objects.append(self.alone)

    def _box(self, name: str, half: float, y: float, envs: list[int] | None = None) -> Actor:
        builder = self.scene.create_actor_builder()
        material = sapien.render.RenderMaterial(base_color=[1, 1, 1, 1])
        builder.add_box_visual(half_size=[half] * 3, material=material)
        builder.initial_pose = sapien.Pose([2, y, 1])
        if envs is not None:
            builder.set_scene_idxs(envs)
        return builder.build_kinematic(name)

    @property
    def _default_sensor_configs(self) -> CameraConfig:
        return CameraConfig("beside", sapien.Pose([0, 0, 1]), 64, 24, 1.0, 0.01, 10)

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        near = CameraConfig("people", sapien.Pose([0, 0, 1]), 64, 24, 1.0, 0.01, 10)
        return [near, CameraConfig("behind", sapien.Pose([-1, 0, 1]), 32, 24, 1.0, 0.01, 10)]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self._place(torch.tensor(self.env_numbers())[env_idx] * 0.05)

    def _before_control_step(self) -> None:
        self._place(self.parts.pose.p[:, 2] - 1 + 0.03)
        self.apply()

    def _place(self, up: torch.Tensor) -> None:
        for actor, y in ((self.parts, 0.6), (self.own, 0.2)):
            actor.set_pose(Pose.create_from_pq(torch.stack([2 + 0 * up, y + 0 * up, 1 + up], dim=1)))

    def evaluate(self) -> dict:
        return {"height": self.parts.pose.p[:, 2], "own": self.own.pose.p[:, 2]}


@pytest.fixture(scope="module")
def env(renderer: None) -> Iterator[Any]:
    env = batch_of(Hides, N, **RENDERED)
    yield env
    env.close()


def ids(env: Any, number: int) -> dict[str, int]:
    """Return the segmentation id of each hidden object that env `number` has."""
    index = scene_index(env)
    entities = {kind: index.entities[number, index.names.index(kind)] for kind in KINDS}
    return {kind: int(entity.per_scene_id) for kind, entity in entities.items() if entity is not None}


@pytest.mark.slow
def test_each_camera_sees_what_a_stock_env_sees(env: Any) -> None:
    stocks = [single(Hides, first_env=number, **RENDERED) for number in range(N)]
    ours, _ = env.reset(seed=list(range(N)))
    theirs = [stock.reset(seed=number)[0] for number, stock in enumerate(stocks)]
    for step in range(3):
        seen, evaluated = pictures(ours), env.evaluate()
        for number, stock in enumerate(stocks):
            where = f"env {number}, step {step}"
            for name, picture in pictures(theirs[number]).items():
                assert np.array_equal(seen[name][number], picture[0]), f"{name} of {where}"
            hidden = ids(env, number)
            assert {*hidden} == {*KINDS} - ({"alone"} if number != 1 else set())
            assert not np.isin(seen["beside/segmentation"][number], [*hidden.values()]).any(), where
            for entry, value in stock.evaluate().items():
                assert torch.equal(evaluated[entry][number], value[0]), f"{entry} of {where}"
        # Render one camera at a time: stock leaves hidden objects visible after it.
        for name in ("people", "behind"):
            shown = np.asarray(env.render_rgb_array(name))
            for number, stock in enumerate(stocks):
                assert np.array_equal(shown[number], stock.render_rgb_array(name)[0]), (
                    f"{name} of env {number}"
                )
            assert (shown.astype(int).max(axis=-1) > 150).any(), (
                "hidden objects must be visible to human render cameras"
            )
        ours = env.step(None)[0]
        theirs = [stock.step(None)[0] for stock in stocks]
    for stock in stocks:
        stock.close()


@pytest.mark.parametrize("before", ["obs", "people", "nothing"])
def test_the_pages_pictures_equal_the_envs_after_any_earlier_rendering(env: Any, before: str) -> None:
    env.reset(seed=list(range(N)))
    if before == "people":
        env.render_rgb_array("people")
    elif before == "nothing":
        for actor in env._hidden_objects:
            actor.show_visual()
    page = [take_pictures(env, number, [SENSOR, PEOPLE]) for number in range(N)]
    fast = [take_pictures(env, number, [SENSOR, PEOPLE], degree="fast") for number in range(N)]
    moment = read_poses(env)
    past = [take_pictures(env, number, [SENSOR, PEOPLE], moment[number]) for number in range(N)]
    observed = pictures(env.get_obs(env.get_info()))
    people = np.asarray(env.render_rgb_array("people"))
    for number in range(N):
        for sensor, human in (page[number], past[number]):
            assert np.array_equal(sensor.rgb, observed["beside/rgb"][number])
            assert np.array_equal(sensor.segmentation, observed["beside/segmentation"][number, ..., 0])
            assert np.array_equal(human.rgb, people[number])
        sensor, human = fast[number]
        assert not np.isin(sensor.segmentation, [*ids(env, number).values()]).any()
        assert np.abs(human.rgb.astype(int) - people[number]).mean() < 3


def test_a_restored_snapshot_restores_hidden_objects(env: Any) -> None:
    env.reset(seed=list(range(N)))
    env.step(None)
    snapshot, poses = take_snapshot(env), read_poses(env)
    height, seen = env.evaluate()["height"].clone(), pictures(env.get_obs(env.get_info()))
    people = np.asarray(env.render_rgb_array("people")).copy()
    for _ in range(3):
        env.step(None)
    assert not torch.equal(env.evaluate()["height"], height)
    restore_snapshot(env, snapshot)
    assert np.array_equal(read_poses(env), poses, equal_nan=True)
    assert torch.equal(env.evaluate()["height"], height)
    again = pictures(env.get_obs(env.get_info()))
    assert all(np.array_equal(again[name], picture) for name, picture in seen.items())
    assert np.array_equal(np.asarray(env.render_rgb_array("people")), people)


class Ghost(Hides):
    """The box `own` is translucent where it is visible."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        for thing in self.own._objs:
            thing.find_component_by_type(sapien.render.RenderBodyComponent).visibility = 0.3


def test_a_translucent_object_stays_translucent(renderer: None) -> None:
    env = batch_of(Ghost, 1, **RENDERED)
    env.reset(seed=0)
    (never_hidden,) = take_pictures(env, 0, [PEOPLE])
    for _ in range(2):
        env.get_obs(env.get_info())
        (human,) = take_pictures(env, 0, [PEOPLE])
        assert np.array_equal(human.rgb, never_hidden.rgb)
        assert np.array_equal(np.asarray(env.render_rgb_array("people"))[0], never_hidden.rgb)
    env.close()
