"""Calls that would leave an env broken are refused, and the env goes on afterwards."""

# ManiSkill annotates an env's members as the widest thing they may be in any task.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from tests.drive.envs import batched
from tests.envs.written import Written
from workbench.envs.cpu_scene import EnvClosed, drawing_alone
from workbench.envs.error_notes import RefusedCall, RefusedValue
from workbench.envs.maniskill_private import open_env
from workbench.envs.simulation.hiding import why_not_hidden
from workbench.envs.snapshots.snapshot import take_snapshot

N = 2


def nothing(env: Any) -> None: ...


class Does(Written):
    """``evaluate`` calls `does`."""

    does: Callable[[Any], None] = staticmethod(nothing)

    def evaluate(self) -> dict:
        type(self).does(self)
        return {}


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = batched(Does, N, obs_mode="none", reward_mode="none")
    env.reset(seed=0)
    yield env
    env.close()


def close(env: Any) -> None:
    env.close()


def lose_the_scene(env: Any) -> None:
    env.scene = None


def step_again(env: Any) -> None:
    env.step(None)


def reset_again(env: Any) -> None:
    env.reset()


@pytest.mark.parametrize("does", [close, lose_the_scene, step_again, reset_again])
def test_a_hook_that_would_break_its_env_is_refused_and_the_env_goes_on(
    env: Any, does: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    for call in (lambda: env.step(None), lambda: env.reset(seed=0)):
        monkeypatch.setattr(Does, "does", staticmethod(does))
        with pytest.raises(RefusedCall):
            call()
        monkeypatch.undo()
        env.reset(seed=0)
        for _ in range(20):
            env.step(None)
        assert env.elapsed_steps.tolist() == [20] * N


def test_a_closed_env_says_so() -> None:
    env = batched(Does, N, obs_mode="none", reward_mode="none")
    assert open_env(env) is env
    env.close()
    for call in (lambda: env.step(None), lambda: env.reset(seed=0), lambda: env.scene):
        with pytest.raises(EnvClosed):
            call()
    with pytest.raises(RuntimeError, match="closed"):
        take_snapshot(env)
    with pytest.raises(TypeError, match="object"):
        open_env(object())
    env.close()  # a second time, as a `finally` may


def test_only_steps_of_two_threads_at_once_warn(env: Any) -> None:
    entered, leave = threading.Event(), threading.Event()

    def hold() -> None:
        with drawing_alone():
            entered.set()
            leave.wait(60)

    for _ in range(2):
        entered.clear()
        leave.clear()
        other = threading.Thread(target=hold)
        other.start()
        entered.wait(60)
        with pytest.warns(RuntimeWarning, match="threads"):
            env.step(None)
        leave.set()
        other.join(60)
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            with drawing_alone():
                env.step(None)
            env.reset(seed=0)


def test_a_window_needs_a_display(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RefusedValue):
        env.render_human()
    with pytest.raises(RefusedValue):
        batched(Does, N, render_mode="human")


def test_an_actor_that_cannot_be_hidden_is_refused(env: Any) -> None:
    for thing in (env.wall, env.falls):
        assert why_not_hidden(thing)
        with pytest.raises(RefusedCall):
            thing.hide_visual()
        assert not thing.hidden
    assert why_not_hidden(env.chain) and not why_not_hidden(env.marker)
    env.marker.hide_visual()
    assert env.marker.hidden
    env.marker.show_visual()
    with pytest.raises(AttributeError):
        env.wall.linear_velocity  # noqa: B018
    with pytest.raises(AttributeError):
        env.wall.set_linear_velocity(torch.zeros(3))
