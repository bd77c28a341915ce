"""Solving a task on the page, saving the episode, and exporting it as demonstrations for ManiSkill's baselines."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from tests.drive.desk import Desk
from tests.drive.page import TASK, page_on
from tests.drive.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Desk]:
    file = Path(shutil.copy(TASK, tmp_path_factory.mktemp("author")))
    arguments = ("--num-envs", "1", "--env", "render_backend=none", "--env", "control_mode=pd_ee_delta_pose")
    with page_on(file, *arguments, browser=browser) as (page, errors, opened):
        yield Desk(page, errors, file, opened)


def test_a_task_is_solved_saved_and_exported_with_the_mouse_only(desk: Desk) -> None:
    page = desk.page
    desk.tab("Run")
    desk.choose("choose_actions", "solve")
    desk.button("Options and results of solve").click()
    expect(page.get_by_text(re.compile("actions are planned by rollouts"))).to_be_visible()
    desk.button("Play").click()
    save = desk.button("Save the solved episode")
    expect(save).to_be_visible(timeout=120_000)
    expect(page.get_by_text(re.compile(r"^Solved at step \d+$"))).to_be_visible()
    expect(page.locator(".wb-status").get_by_text("paused", exact=True)).to_be_visible()
    expect(page.get_by_text(re.compile("The best rollout: return"))).to_be_visible()
    save.click()
    expect(page.get_by_text(re.compile("^saved ", re.IGNORECASE))).to_be_visible()
    desk.tab("Episodes")
    desk.button("Review recordings").click()
    expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
    desk.tab("Share")
    page.get_by_label("Make", exact=True).select_option(label="ManiSkill demonstrations (h5)")
    desk.button("Make").click()
    datasets = desk.file.parent / "recordings" / "datasets"
    (file,) = until(lambda: list(datasets.glob("demonstrations_*.h5")), "the demonstrations")
    metadata = json.loads(file.with_suffix(".json").read_text())
    assert [episode["success"] for episode in metadata["episodes"]] == [True]
    with h5py.File(file) as demonstrations:
        steps = np.asarray(demonstrations["traj_0/actions"]).shape[0]
    assert steps == metadata["episodes"][0]["elapsed_steps"] > 0
    expect(page.get_by_text(re.compile(f"^1 episode, {steps} steps"))).to_be_visible()
    assert desk.errors == []


def test_a_pressed_seed_opens_in_the_review_and_back_returns_to_its_row(desk: Desk) -> None:
    """The review last showed its Share tab, with another episode."""
    page = desk.page
    desk.button("Back to the live env").click()
    desk.tab("Try")
    page.locator("[data-fold='Solve many seeds']").click()
    page.get_by_label("Seeds", exact=True).locator("visible=true").fill("1")
    desk.button("Solve the seeds").click()
    expect(page.get_by_text(re.compile(r"^seed 0 at step \d+ of \d+$"))).to_be_visible(timeout=120_000)
    summary = page.get_by_text(re.compile(r"^Solved [01] of 1 seed"))
    expect(summary).to_be_visible(timeout=240_000)
    page.locator(".wb-seeds tbody tr").first.click()
    expect(page.get_by_text(re.compile("step 0 /")).first).to_be_visible(timeout=120_000)
    expect(page.get_by_role("tab", name="Review", exact=True)).to_have_attribute("aria-selected", "true")
    desk.button("Back to the live env").click()
    expect(summary).to_be_visible()
    assert desk.errors == []
