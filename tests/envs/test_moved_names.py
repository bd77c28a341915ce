"""With an untested ManiSkill that lacks a private name, the feature that needs it is refused and the rest works."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.articulation_joint import ArticulationJoint

from workbench.cameras.edit.run_hooks import run_hooks
from workbench.envs import maniskill_private
from workbench.envs.backends import BackendUnavailable
from workbench.envs.hot_swap import can_exchange_cameras
from workbench.envs.state_columns import flat_names
from workbench.envs.task_env import EnvOptions, TaskEnv, make_env
from workbench.machine import versions
from workbench.machine.versions import PrivateName, command_for_tested_versions
from workbench.pictures.placed_cameras import PlacedCameras, settings_of
from workbench.source.parsed import RefusedEdit

FEATURES = sorted({name.disables for name in maniskill_private.PRIVATE_NAMES if name.disables})


def test_the_installed_maniskill_has_all_names() -> None:
    assert [name.dotted for name in maniskill_private.PRIVATE_NAMES if not name.exists()] == []


@pytest.mark.parametrize(
    "name",
    [
        PrivateName("mani_skill.envs.sapien_env:BaseEnv", "_no_such_name"),
        PrivateName("mani_skill.envs.sapien_env:NoSuchClass", "_objs"),
        PrivateName("mani_skill.no_such_module", "anything"),
        PrivateName("mani_skill.envs.sapien_env", "_no_such_function"),
    ],
    ids=lambda name: name.owner,
)
def test_a_missing_name_is_detected(name: PrivateName) -> None:
    assert not name.exists()


@pytest.fixture
def fresh_name_cache() -> Iterator[None]:
    cached = maniskill_private.moved_names
    cached.cache_clear()
    yield
    cached.cache_clear()


def a_task(num_envs: int = 2, **kwargs: object) -> TaskEnv:
    options = EnvOptions(num_envs, "cpu", kwargs={"obs_mode": "state", **kwargs})
    return TaskEnv(make_env(REGISTERED_ENVS["PickCube-v1"].cls, options), None)


def test_a_missing_essential_name_refuses_to_open_tasks(
    monkeypatch: pytest.MonkeyPatch, fresh_name_cache: None
) -> None:
    monkeypatch.delattr(ArticulationJoint, "_data_index")
    with pytest.raises(BackendUnavailable, match=r"opening a task \(needs ArticulationJoint._data_index\)"):
        a_task()


@pytest.mark.parametrize("feature", FEATURES)
def test_a_task_runs_without_a_feature(
    feature: str, monkeypatch: pytest.MonkeyPatch, fresh_name_cache: None, renderer: None
) -> None:
    moved = tuple(name for name in maniskill_private.PRIVATE_NAMES if name.disables == feature)
    monkeypatch.setattr(maniskill_private, "moved_names", lambda: moved)
    why = maniskill_private.why_not(feature)
    assert feature in why and all(name.dotted in why for name in moved)
    assert [other for other in FEATURES if maniskill_private.why_not(other)] == [feature]

    task = a_task()
    try:
        task.reset(3)
        before = task.step(task.env.action_space.sample())
        task.reset(4, env_idx=[1])
        after = task.step(task.env.action_space.sample())
        assert before.reward is not None and after.reward is not None

        env, placements = task.env, PlacedCameras()
        (key, camera), *_ = maniskill_private.cameras(env).items()
        settings = settings_of(camera.config)
        assert settings is not None
        if feature == maniskill_private.PLACING:
            with pytest.raises(ValueError, match="Not possible with the installed versions: placing cameras"):
                placements.place(env, key, settings)
        else:
            placements.place(env, key, settings)
        if feature == maniskill_private.WRITING:
            with pytest.raises(RefusedEdit, match="writing cameras"):
                run_hooks(env, {})
        else:
            assert key in run_hooks(env, {}).cameras
        assert can_exchange_cameras(env) == (feature != maniskill_private.EXCHANGING)
        names = flat_names(task, task.obs)
        assert (names is None) == (feature == maniskill_private.NAMED_STATE)
        hidden = maniskill_private.hidden_objects(env)
        assert bool(hidden) == (feature != maniskill_private.HIDDEN)
    finally:
        task.env.close()


def test_the_message_names_the_tested_versions(
    monkeypatch: pytest.MonkeyPatch, fresh_name_cache: None
) -> None:
    monkeypatch.delattr(BaseEnv, "_get_obs_extra")
    monkeypatch.setitem(versions.TESTED, "sapien", ("0.1",))
    why = maniskill_private.why_not("")
    assert why.endswith(command_for_tested_versions()) and "sapien==0.1" in why
