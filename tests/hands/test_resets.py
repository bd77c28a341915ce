"""Where resets put the bodies."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import running
from tests.drive.session import fake_worker_session, live_session, start_over, wait_until
from workbench.hands.commands import HideResets, SampleResets
from workbench.hands.panel import HandsPanel, spread_text
from workbench.hands.resets import MIN_EPISODES, ResetCloud, ResetSampled
from workbench.page.command import Refused

N = 64


def test_the_sampled_poses_are_those_of_the_episodes_with_these_seeds(
    child_process: None, tmp_path: Path
) -> None:
    with live_session("PickCube-v1", tmp_path / "recordings", num_envs=N) as session:
        session.do(SampleResets())
        view = wait_until(session, lambda v: v.of(ResetCloud).state == "done", "the resets")
        cloud = view.of(ResetCloud)
        assert cloud.seeds == (0, N) and len(cloud.poses) * N >= MIN_EPISODES
        cube = view.task.geometry.body_names.index("cube")
        for batch, seed in enumerate(cloud.seeds):
            step = start_over(session, seed).step
            np.testing.assert_array_equal(cloud.of(cube)[batch], step.poses[:, cube])
        assert np.ptp(cloud.of(cube)[..., :2], axis=(0, 1)).min() > 0.1
        session.do(HideResets())
        assert session.view().of(ResetCloud).state == "none"


def test_a_new_version_is_sampled_again_and_late_results_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with fake_worker_session(tmp_path) as fake:
        with pytest.raises(Refused):
            fake.session.do(SampleResets())
        fake.load()
        begun: list[object] = []
        monkeypatch.setattr(fake.session._resets, "perform", begun.append)
        fake.session.do(SampleResets())
        poses = fake.view.step.poses
        fake.session.happen(ResetSampled(0, poses))
        assert fake.view.of(ResetCloud).seeds == (0,)
        fake.load("patched")
        assert fake.view.of(ResetCloud).seeds == () and len(begun) == 2
        fake.session.do(HideResets())
        fake.session.happen(ResetSampled(0, poses))
        assert fake.view.of(ResetCloud) == replace(ResetCloud(), serial=fake.view.of(ResetCloud).serial)


def test_the_points_are_drawn_at_the_selected_body_and_a_click_names_seed_and_env(panels: Panels) -> None:
    session, offset = StubSession(), np.array([5.0, 0.0, 0.0])
    panel = HandsPanel(panels.server, session, lambda: "cube")  # type: ignore[arg-type]
    view = running(3, selected_env=1)
    cube = view.task.geometry.body_names.index("cube")
    batches = [view.step.poses.copy() for _ in range(2)]
    for k, poses in enumerate(batches):
        poses[:, cube, :3] = [[0.1 * env, 0.1 * k, 0.02] for env in range(3)]
    batches[1][2, cube] = np.nan
    cloud = ResetCloud("done", 1, (7, 10), tuple(batches), 2)
    session.shown = view = replace(view, features={ResetCloud: cloud})
    panel.draw_in_view(view, view.step.poses, offset)
    (points,) = panels.nodes("/hands/resets")
    assert len(points.points) == 5 and points.points[:, 0].min() == 5.0
    eye = np.array([5.0, 0.0, 3.0])
    assert panel.reset_under_ray(eye, np.array([0.1, 0.1, 0.02]) + offset - eye) == (10, 1)
    assert panel.reset_under_ray(eye, np.array([0.15, 0.15, 0.02]) + offset - eye) is None
    assert panel.reset_under_ray(eye, eye - offset - np.array([0.1, 0.1, 0.02])) is None
    text = spread_text(cloud, cube)
    assert "5 resets" in text and "x 0.000 to 0.200 m" in text
    session.shown = view = replace(view, features={})
    panel.draw_in_view(view, view.step.poses, offset)
    assert not panels.nodes("/hands/resets")
