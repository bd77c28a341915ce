from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from tests.ui.scenes import EMPTY, PLAN, problem, running
from workbench.session.live.solver import SolveView
from workbench.ui.live.status_line import status_values
from workbench.ui.widgets.templates import render


def html(view) -> str:
    return render("status_line", **status_values(view))


def test_running_says_rates_envs_and_backend() -> None:
    text = html(running(16))
    assert all(
        word in text
        for word in ("running", "16 envs", "cpu (batched)", "<b>20</b> steps/s", "1.00 × real time")
    )


def test_a_batch_that_steps_once_a_second_has_a_rate_too() -> None:
    text = html(running(1, steps_per_second=0.93, real_time_factor=0.0465, recorded_share=0.9))
    assert "steps/s" not in html(running(1, steps_per_second=0.0)), "not known before the second step"
    assert "<b>0.93</b> steps/s" in text and "0.046 × real time" in text and "0.93 steps a second" in text


def test_while_actions_are_planned_it_says_so_and_how_long_a_plan_takes() -> None:
    def planning(**solve: Any) -> str:
        view = running(4, steps_per_second=0.3, real_time_factor=0.01, solve=SolveView(**solve))
        return html(replace(view, settings=replace(view.settings, action_source="solve")))

    said = planning(state="planning", plan=PLAN)
    assert "<b>planning</b>" in said and "<b>0.25</b> s a plan" in said
    assert "running</b>" not in said and "real time" not in said and "wb-warn-text" not in said
    begun = planning(state="starting", activity="building 1 env")
    assert "<b>planning</b>" in begun and "building 1 env" in begun and "steps/s" not in begun


def test_one_env_is_one_env() -> None:
    assert "1 env on" in html(running(1))


def test_first_load_says_what_is_being_done() -> None:
    text = html(replace(EMPTY, state="loading", activity="building 16 envs"))
    assert "loading" in text and "building 16 envs" in text and "real time" not in text


def test_paused_claims_no_rate() -> None:
    assert "steps/s" not in html(running(4, state="paused", playing=False))


@pytest.mark.parametrize("word", ["running", "paused", "loading"])
def test_error_and_stale_are_marks_beside_the_state(word: Any) -> None:
    text = html(running(4, state=word, playing=word == "running", stale=True, problem=problem()))
    assert f"<b>{word}</b>" in text and text.count(">error</span>") == 1
    assert (">stale</span>" in text) is (word != "loading")


def test_machine_that_cannot_keep_up_is_said() -> None:
    assert "cannot reach it" in html(running(4, speed=4.0, real_time_factor=1.2))
    assert "cannot reach it" not in html(running(4, speed=float("inf"), real_time_factor=1.2))


def test_the_selected_envs_place_in_its_episode_is_said() -> None:
    view = running(4)
    assert view.step is not None
    assert f"env {view.selected_env}: step {view.step.elapsed_steps[view.selected_env]}" in html(view)
    assert "step" not in html(EMPTY)


def test_the_tab_is_called_after_the_task() -> None:
    assert 'data-title="Push-v1 · Workbench"' in html(running(4))
    assert 'data-title="Workbench"' in html(EMPTY)
