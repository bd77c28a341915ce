"""``get_state_dict``, ``set_state_dict`` and their flat forms, for all envs and for some."""

# ManiSkill annotates an env's members as the widest thing they may be, and vectors as tuples.
# pyright: reportAttributeAccessIssue=false, reportOptionalMemberAccess=false, reportArgumentType=false
# pyright: reportOptionalIterable=false

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.utils.registration import REGISTERED_ENVS

from tests.envs.stock_env import batch_of

PICK_CUBE: Any = REGISTERED_ENVS["PickCube-v1"].cls
TOLERANCE = 2e-6
"""Absolute. PhysX stores an articulation's root pose at its centre of mass, so a pose comes back rounded."""


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = batch_of(PICK_CUBE, 4)
    yield env
    env.close()


@pytest.fixture(autouse=True)
def some_steps(env: Any) -> None:
    env.reset(seed=[0, 1, 2, 3])
    move(env)


def move(env: Any, steps: int = 5) -> None:
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(rng.uniform(-1, 1, (4, 8)).astype(np.float32))


@pytest.mark.parametrize("flat", [False, True], ids=["dict", "vector"])
def test_a_state_survives_a_round_trip(env: Any, flat: bool) -> None:
    state = env.get_state() if flat else env.get_state_dict()
    before = env.get_state().clone()
    move(env)
    assert not torch.allclose(env.get_state(), before, atol=1e-3)
    if flat:
        env.set_state(state)
    else:
        env.set_state_dict(state)
    torch.testing.assert_close(env.get_state(), before, atol=TOLERANCE, rtol=0)


@pytest.mark.parametrize("flat", [False, True], ids=["dict", "vector"])
def test_a_state_of_some_envs_reaches_only_them(env: Any, flat: bool) -> None:
    chosen = torch.tensor([3, 1])
    wanted = env.get_state()[[1, 3]].clone()
    parts = env.get_state_dict()
    move(env)
    untouched = env.get_state()[[0, 2]].clone()
    # Rows come in the order of the envs, not of env_idx: ManiSkill makes a mask of it.
    rows = {
        kind: {name: value[[1, 3]] for name, value in parts[kind].items()}
        for kind in ("actors", "articulations")
    }
    if flat:
        env.set_state(wanted, chosen)
    else:
        env.set_state_dict(rows, chosen)
    assert torch.equal(env.get_state()[[0, 2]], untouched)
    torch.testing.assert_close(env.get_state()[[1, 3]], wanted, atol=TOLERANCE, rtol=0)
