"""A second look over what a task remembers says what a first look would, whatever was done in between."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mani_skill.envs  # noqa: F401  registers the ids
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mani_skill.utils.structs.pose import Pose

from tests.drive.envs import batched
from workbench.core.task_buffers import note_scene
from workbench.core.task_members import forget_look, look_over


class Notes:
    def __init__(self) -> None:
        self.visits = torch.zeros(2)


Notes.__module__ = "mani_skill.envs.tasks.tabletop.push_cube"  # as if the task's own file had it


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    made = batched("PushCube-v1")
    made.reset(seed=0)
    yield made
    made.close()


def fill(env: Any) -> None:
    env.best = torch.zeros(2)
    env.count, env.limit = 3, 5
    env.stages = {"reach": torch.zeros(2), "names": ["a", "b"], "deep": {"n": 1}}
    env.trail = [torch.zeros(2), torch.ones(2)]
    env.marks = [0, 0]
    env.pair = (torch.zeros(2), [1, 2])
    env.goal = Pose.create_from_pq(torch.zeros(2, 3))
    env.notes = Notes()
    env.array = np.zeros(2)
    env.view = env.scene.px.cuda_rigid_body_data.torch()[:2, :3]


EDITS: dict[str, Callable[[Any], None]] = {
    "a tensor written to": lambda env: env.trail[0].add_(1),
    "another tensor": lambda env: setattr(env, "best", torch.rand(2)),
    "a tensor of another shape": lambda env: setattr(env, "best", torch.rand(2, 3)),
    "a tensor becomes a number": lambda env: setattr(env, "best", 1.0),
    "a tensor becomes a view of the simulation": lambda env: setattr(env, "best", env.view),
    "a view of the simulation becomes memory": lambda env: setattr(env, "view", torch.zeros(2)),
    "a counter": lambda env: setattr(env, "count", env.count + 1),
    "a number becomes a list": lambda env: setattr(env, "limit", [torch.zeros(2)]),
    "a new attribute": lambda env: setattr(env, "more", torch.zeros(2)),
    "an attribute goes": lambda env: vars(env).pop("array", None),
    "an entry of a dict": lambda env: env.stages.update(reach=torch.rand(2)),
    "a new entry of a dict": lambda env: env.stages.update({f"k{len(env.stages)}": torch.rand(2)}),
    "an entry goes and another comes": lambda env: env.stages.update(late=env.stages.pop("deep", 0)),
    "deep in a dict": lambda env: env.stages.update(deep={"n": env.stages.get("n", 0)}),
    "a dict in place of a dict": lambda env: setattr(env, "stages", dict(env.stages)),
    "an item of a list": lambda env: env.trail.__setitem__(0, torch.rand(2)),
    "a list grows": lambda env: env.trail.append(torch.rand(2)),
    "a list is turned round": lambda env: env.trail.reverse(),
    "a plain list": lambda env: env.marks.__setitem__(1, env.marks[1]),
    "a plain list gets a tensor": lambda env: env.marks.__setitem__(0, torch.rand(2)),
    "a list in a tuple": lambda env: env.pair[1].append(7),
    "another tuple": lambda env: setattr(env, "pair", (torch.rand(2), [1])),
    "another pose": lambda env: setattr(env, "goal", Pose.create_from_pq(torch.rand(2, 3))),
    "an attribute of an object": lambda env: setattr(env.notes, "visits", torch.rand(2)),
    "another object": lambda env: setattr(env, "notes", Notes()),
    "another __dict__": lambda env: setattr(env.notes, "__dict__", {"other": torch.rand(2)}),
    "another array": lambda env: setattr(env, "array", np.ones(2)),
    "an array of objects": lambda env: setattr(env, "array", np.array([env, None])),
    "a set": lambda env: setattr(env, "array", {1}),
    "what is two becomes one": lambda env: env.stages.update(reach=env.best),
    "a step": lambda env: env.step(torch.zeros(2, *env.single_action_space.shape)),
    "the scene as built": note_scene,
}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.lists(st.sampled_from(sorted(EDITS)), max_size=3), min_size=1, max_size=6))
def test_a_second_look_sees_what_a_first_one_would(env: Any, rounds: list[list[str]]) -> None:
    fill(env)
    built: dict[str, dict[str, Any]] = {"": {"count": 3}}
    look_over(env, built)
    for edits in rounds:
        for edit in edits:
            EDITS[edit](env)
        again = look_over(env, built)
        seen = [(leaf.path, leaf.value) for leaf in again.leaves]
        omitted, owners = dict(again.omitted), dict(again.owners)
        forget_look(env)
        first = look_over(env, built)
        assert [path for path, _ in seen] == [leaf.path for leaf in first.leaves]
        assert all(value is leaf.value for (_, value), leaf in zip(seen, first.leaves, strict=True))
        assert omitted == first.omitted
        assert {path: id(o) for path, o in owners.items()} == {
            path: id(o) for path, o in first.owners.items()
        }


def test_what_is_put_after_a_second_look_is_put_into_todays_objects(env: Any) -> None:
    fill(env)
    built: dict[str, dict[str, Any]] = {}
    look_over(env, built)
    env.stages["reach"] = torch.rand(2)
    wanted = torch.full((2,), 7.0)
    (leaf,) = [leaf for leaf in look_over(env, built).leaves if leaf.path == "stages['reach']"]
    leaf.put(wanted)
    assert env.stages["reach"] is wanted
    (leaf,) = [leaf for leaf in look_over(env, built).leaves if leaf.path == "stages['reach']"]
    assert leaf.value is wanted
