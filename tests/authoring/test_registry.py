"""The names of mani_skill and gymnasium that `registry` relies on, so that an upgrade fails loudly."""

from __future__ import annotations

import inspect

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import pytest
from mani_skill import agents
from mani_skill.agents import registration as agent_registration
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import assets
from mani_skill.utils import registration as env_registration

from workbench.authoring import registry
from workbench.authoring.problem import HOOK_STAGES

THIS_FILE = __file__


def test_the_tables_are_the_ones_that_upstream_reads() -> None:
    assert registry._TABLES[0] is env_registration.REGISTERED_ENVS
    assert registry._TABLES[1] is gym.registry
    assert registry._TABLES[2] is agent_registration.REGISTERED_AGENTS is agents.REGISTERED_AGENTS
    assert registry._TABLES[3] is assets.DATA_GROUPS


def test_the_decorators_have_the_arguments_that_are_looked_at() -> None:
    assert {"uid", "override"} <= set(inspect.signature(env_registration.register_env).parameters)
    assert "override" in inspect.signature(agent_registration.register_agent).parameters
    assert agents.register_agent is agent_registration.register_agent


def test_an_entry_has_what_a_load_reads() -> None:
    spec = registry.environment("PickCube-v1")
    assert spec is not None
    assert (spec.uid, spec.max_episode_steps, spec.default_kwargs) == ("PickCube-v1", 50, {})
    assert issubclass(spec.cls, BaseEnv)


def test_registering_writes_only_the_tables_that_are_kept() -> None:
    before = [dict(table) for table in registry._TABLES]
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):

        @env_registration.register_env("AuthorRegistry-v1", max_episode_steps=3)
        class Task(BaseEnv):
            pass

        @agents.register_agent(asset_download_ids=[])
        class Robot(Panda):
            uid = "author_registry_robot"

    assert [made.name for made in registrations.made] == ["AuthorRegistry-v1", "author_registry_robot"]
    after = [set(table) - set(old) for table, old in zip(registry._TABLES, before, strict=True)]
    assert after == [
        {"AuthorRegistry-v1"},
        {"AuthorRegistry-v1"},
        {"author_registry_robot"},
        {"AuthorRegistry-v1", "author_registry_robot"},
    ]
    registrations.undo()
    assert [dict(table) for table in registry._TABLES] == before
    registrations.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is Task
    registrations.undo()


def test_other_files_register_as_they_always_do() -> None:
    built_in = env_registration.REGISTERED_ENVS["PickCube-v1"].cls
    registrations = registry.Registrations()
    with registry.registering(lambda file: False, registrations):

        @env_registration.register_env("PickCube-v1")
        class Task(BaseEnv):
            pass

    assert registrations.made == []
    assert env_registration.REGISTERED_ENVS["PickCube-v1"].cls is built_in


def test_upstreams_own_refusals_still_refuse() -> None:
    before = [dict(table) for table in registry._TABLES]
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        with pytest.raises(TypeError, match="BaseEnv"):
            env_registration.register_env("AuthorRegistry-v1")(dict)
        with pytest.raises(RuntimeError, match="json"):
            env_registration.register_env("AuthorRegistry-v1", shape=object())
        with pytest.raises(gym.error.Error):
            env_registration.register_env("not an id")(type("Task", (BaseEnv,), {}))
    registrations.undo()
    assert [dict(table) for table in registry._TABLES] == before


def test_every_hook_that_names_a_stage_is_one_of_upstreams() -> None:
    assert [name for name in HOOK_STAGES if not hasattr(BaseEnv, name)] == []
