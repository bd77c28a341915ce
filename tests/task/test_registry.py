"""The names in mani_skill and gymnasium that `registry` relies on; an incompatible upgrade fails here."""

from __future__ import annotations

from typing import Any

import mani_skill.envs  # noqa: F401
import pytest
from mani_skill import agents
from mani_skill.agents.robots import Panda
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import registration as env_registration

from tests.task.registered import TABLES, registered
from workbench.task import registry

THIS_FILE = __file__


def test_registering_writes_only_the_restored_registries() -> None:
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
    # The second save fails to load.
    registrations.undo()
    registrations.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is Task
    registrations.undo()
    assert registered() == before


def _registered(env_id: str, *, override: bool = False) -> tuple[registry.Registrations, type[BaseEnv]]:
    """Register one task, as one load does."""
    registrations = registry.Registrations()
    with registry.registering(lambda file: file == THIS_FILE, registrations):
        cls = env_registration.register_env(env_id, override=override)(type("Task", (BaseEnv,), {}))
    return registrations, cls


def test_undoing_a_load_keeps_a_newer_registration_of_the_name() -> None:
    before = registered()
    first, old = _registered("AuthorRegistry-v1")
    second, new = _registered("AuthorRegistry-v1")
    assert [one.name for one in second.replaced()] == ["AuthorRegistry-v1"] and first.replaced() == ()
    first.undo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is new
    # The failed load in between has no part in the name either.
    first.redo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is new
    second.undo()
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is old
    first.undo()
    assert registered() == before


def test_a_name_registered_twice_in_one_load_is_refused_with_both_places() -> None:
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
    beginning = f"'AuthorRegistry-v1' is registered twice: in line {line} (First) of {THIS_FILE} and in line "
    assert str(here.value).startswith(beginning) and str(here.value).count(THIS_FILE) == 1
    assert str(there.value) == f"{beginning}2 (Second) of /another/file.py. Give one of them another id."
    assert [made.cls.__name__ for made in registrations.made] == ["Other", "First", "Second"]
    assert env_registration.REGISTERED_ENVS["AuthorRegistry-v1"].cls is second
    registrations.undo()
    assert registered() == before
