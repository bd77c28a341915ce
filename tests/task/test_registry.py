"""The names of mani_skill and gymnasium that `registry` relies on, so that an upgrade fails loudly."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import pytest
from mani_skill import agents
from mani_skill.agents import registration as agent_registration
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import assets
from mani_skill.utils import registration as env_registration

from tests.task.registered import TABLES, registered
from workbench.task import registry

THIS_FILE = __file__


def test_the_tables_are_the_ones_that_upstream_reads() -> None:
    ours = [id(table) for table in registry._TABLES]
    assert ours == [
        id(env_registration.REGISTERED_ENVS),
        id(gym.registry),
        id(agent_registration.REGISTERED_AGENTS),
        id(assets.DATA_GROUPS),
    ]
    assert agents.REGISTERED_AGENTS is agent_registration.REGISTERED_AGENTS
    assert ours == [id(table) for table in TABLES], "what the tests here look at"


def test_registering_writes_only_the_tables_that_are_kept() -> None:
    before = registered()
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):

        @env_registration.register_env("AuthorRegistry-v1", max_episode_steps=3)
        class Task(BaseEnv):
            pass

        @agents.register_agent(asset_download_ids=[])
        class Robot(Panda):
            uid = "author_registry_robot"

    assert [made.name for made in registrations.made] == ["AuthorRegistry-v1", "author_registry_robot"]
    after = [set(table) - set(old) for table, old in zip(TABLES, before, strict=True)]
    assert after == [
        {"AuthorRegistry-v1"},
        {"AuthorRegistry-v1"},
        {"author_registry_robot"},
        {"AuthorRegistry-v1", "author_registry_robot"},
    ]
    registrations.undo()
    assert registered() == before
    registrations.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is Task
    # A second save that fails to load.
    registrations.undo()
    registrations.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is Task
    registrations.undo()
    assert registered() == before


def _registered(env_id: str, *, override: bool = False) -> tuple[registry.Registrations, type[BaseEnv]]:
    """One load that registers one task."""
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        cls = env_registration.register_env(env_id, override=override)(type("Task", (BaseEnv,), {}))
    return registrations, cls


def test_taking_a_load_back_leaves_what_a_newer_one_put_under_the_name() -> None:
    before = registered()
    first, old = _registered("AuthorRegistry-v1")
    second, new = _registered("AuthorRegistry-v1")
    assert [one.name for one in second.replaced()] == ["AuthorRegistry-v1"] and first.replaced() == ()
    first.undo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is new
    # The failed load that came between has no part in the name either.
    first.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is new
    second.undo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is old
    first.undo()
    assert registered() == before


def test_a_name_that_one_load_takes_twice_is_refused_with_both_places() -> None:
    before = registered()
    registrations = registry.Registrations()
    elsewhere = compile(
        "def register(decorate, cls):\n    return decorate('AuthorRegistry-v1')(cls)",
        "/another/file.py",
        "exec",
    )
    functions: dict[str, Any] = {}
    exec(elsewhere, functions)
    first, second = type("First", (BaseEnv,), {}), type("Second", (BaseEnv,), {})
    with registry.registering(lambda file: file in (THIS_FILE, "/another/file.py"), registrations):
        env_registration.register_env("AuthorOther-v1")(type("Other", (BaseEnv,), {}))
        env_registration.register_env("AuthorRegistry-v1")(first)
        line = registrations.made[-1].line
        with pytest.raises(registry.DuplicateName) as here:
            env_registration.register_env("AuthorRegistry-v1")(second)
        with pytest.raises(registry.DuplicateName) as there:
            functions["register"](env_registration.register_env, second)
        env_registration.register_env("AuthorRegistry-v1", override=True)(second)
    told = f"'AuthorRegistry-v1' is registered twice: in line {line} (First) of {THIS_FILE} and in line "
    assert str(here.value).startswith(told) and str(here.value).count(THIS_FILE) == 1
    assert str(there.value) == f"{told}2 (Second) of /another/file.py. Give one of them another id."
    assert [made.cls.__name__ for made in registrations.made] == ["Other", "First", "Second"]
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is second
    registrations.undo()
    assert registered() == before
