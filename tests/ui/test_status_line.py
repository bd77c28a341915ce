from __future__ import annotations

from dataclasses import replace

from tests.ui.scenes import EMPTY, problem, running
from workbench.ui.fragments import render
from workbench.ui.status_line import status_values


def html(view) -> str:
    return render("status_line", **status_values(view))


def test_running_says_rates_envs_and_backend() -> None:
    text = html(running(16))
    assert all(
        word in text
        for word in ("running", "16 envs", "cpu (batched)", "<b>20</b> steps/s", "1.00 × real time")
    )


def test_one_env_is_one_env() -> None:
    assert "1 env on" in html(running(1))


def test_first_load_says_what_is_being_done() -> None:
    text = html(replace(EMPTY, state="loading", activity="building 16 envs"))
    assert "loading" in text and "building 16 envs" in text and "real time" not in text


def test_paused_claims_no_rate() -> None:
    assert "steps/s" not in html(running(4, state="paused", playing=False))


def test_error_and_stale_are_seen_together() -> None:
    text = html(running(4, state="error", stale=True, problem=problem()))
    assert "error" in text and "stale" in text


def test_machine_that_cannot_keep_up_is_said() -> None:
    assert "does not reach it" in html(running(4, speed=4.0, real_time_factor=1.2))
    assert "does not reach it" not in html(running(4, speed=float("inf"), real_time_factor=1.2))


def test_the_selected_envs_place_in_its_episode_is_said() -> None:
    view = running(4)
    assert view.step is not None
    assert f"env {view.selected_env}: step {view.step.elapsed_steps[view.selected_env]}" in html(view)
    assert "step" not in html(EMPTY)
