"""The names of mani_skill and gymnasium that `registry` relies on, so that an upgrade fails loudly."""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import pytest
from mani_skill import agents
from mani_skill.agents import registration as agent_registration
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import assets
from mani_skill.utils import registration as env_registration

from tests.authoring.registered import TABLES, registered
from workbench.authoring.loading import registry
from workbench.authoring.problem import HOOK_STAGES

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
    before = registered()
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        with pytest.raises(TypeError, match="BaseEnv"):
            env_registration.register_env("AuthorRegistry-v1")(dict)
        with pytest.raises(RuntimeError, match="json"):
            env_registration.register_env("AuthorRegistry-v1", shape=object())
        with pytest.raises(gym.error.Error):
            env_registration.register_env("not an id")(type("Task", (BaseEnv,), {}))
    registrations.undo()
    assert registered() == before


def test_every_hook_that_names_a_stage_is_one_of_upstreams() -> None:
    assert [name for name in HOOK_STAGES if not hasattr(BaseEnv, name)] == []


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


def test_a_load_that_came_back_once_does_not_take_a_name_that_a_newer_one_has_since() -> None:
    before = registered()
    first, old = _registered("AuthorRegistry-v1")
    first.undo()
    first.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is old
    second, new = _registered("AuthorRegistry-v1")
    first.undo()
    first.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is new
    second.undo()
    first.undo()
    assert registered() == before


def test_tasks_and_robots_are_classes_of_their_kind_and_not_the_base_itself() -> None:
    task = env_registration.REGISTERED_ENVS["PickCube-v1"].cls
    assert [registry.is_task(what) for what in (task, BaseEnv, Panda, dict, task.__name__, None)] == [
        *(True, False, False, False, False, False)
    ]
    assert [registry.is_robot(what) for what in (Panda, BaseAgent, task, dict, Panda.uid, None)] == [
        *(True, False, False, False, False, False)
    ]


def test_an_id_is_found_by_its_class_and_one_of_gymnasium_alone_is_told_apart() -> None:
    task = env_registration.REGISTERED_ENVS["PickCube-v1"].cls
    assert registry.id_of(task) == "PickCube-v1"
    assert registry.id_of(type("Task", (task,), {})) is None
    assert registry.environment_ids() == sorted(env_registration.REGISTERED_ENVS)
    ids = ("CartPole-v1", "PickCube-v1", "NoSuchTask-v1")
    assert [registry.is_other_gymnasium_id(env_id) for env_id in ids] == [True, False, False]


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


def test_a_body_that_raises_leaves_the_decorators_as_they_were() -> None:
    before = env_registration.register_env, agent_registration.register_agent, agents.register_agent
    with pytest.raises(ZeroDivisionError), registry.registering(lambda file: True, registry.Registrations()):
        assert env_registration.register_env is not before[0]
        raise ZeroDivisionError
    assert (env_registration.register_env, agent_registration.register_agent, agents.register_agent) == before


def test_a_robot_that_replaces_another_is_put_in_its_place() -> None:
    before = registered()
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        robot = agents.register_agent()(type("Robot", (Panda,), {}))
        with pytest.raises(registry.DuplicateName):
            agents.register_agent()(type("Robot", (Panda,), {}))
        again = agents.register_agent(override=True)(type("Robot", (Panda,), {}))
    assert robot is not again and agent_registration.REGISTERED_AGENTS["panda"].agent_cls is again
    assert [(one.name, one.is_robot) for one in registrations.replaced()] == [("panda", True)]
    registrations.undo()
    assert registered() == before


def test_what_overrides_another_on_purpose_is_not_told_as_taken() -> None:
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        agents.register_agent(override=True)(type("Robot", (Panda,), {}))
        env_registration.register_env("PickCube-v1", override=True)(type("Task", (BaseEnv,), {}))
    assert registrations.replaced() == ()
    registrations.undo()


def test_a_librarys_agents_are_registered_as_they_always_are() -> None:
    registrations = registry.Registrations()
    with registry.registering(lambda file: False, registrations):

        @agents.register_agent(override=True)
        class Robot(Panda):
            uid = "panda"

    assert registrations.made == [] and registrations.displaced == {}
    assert agents.REGISTERED_AGENTS["panda"].agent_cls is Robot


def test_a_name_is_somebody_elses_in_any_table_but_that_of_downloads() -> None:
    assets.DATA_GROUPS["AuthorDownloads-v1"] = []
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        for name in ("AuthorDownloads-v1", "CartPole-v1"):
            env_registration.register_env(name)(type("Task", (BaseEnv,), {}))

        @agents.register_agent()
        class Robot(Panda):
            uid = "fetch"

    assert [one.name for one in registrations.replaced()] == ["CartPole-v1", "fetch"]
    registrations.undo()
    assert registry.is_other_gymnasium_id("CartPole-v1") and assets.DATA_GROUPS["AuthorDownloads-v1"] == []
