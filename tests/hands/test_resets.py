"""Where resets put the bodies."""

# A session that has a task has a step.
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drive.live import StubSession
from tests.drive.panels import Panels
from tests.drive.scenes import running
from tests.drive.session import FakeWorkerSession, live_session, start_over, wait_until
from workbench.envs.inspection import Overlap
from workbench.hands.commands import HideResets, SampleResets, ShowReset, ToggleGhosts
from workbench.hands.panel import HandsPanel
from workbench.hands.questions import FirstStates
from workbench.hands.resets import MIN_EPISODES, ResetCloud, ResetSampled, SamplingFailed
from workbench.hands.resets_panel import BINS, ResetsPanel, histograms, marks, trouble_rows
from workbench.live.commands import SetSeed
from workbench.live.messages import Reset
from workbench.page.command import Refused

N = 64


def test_the_sampled_poses_are_those_of_the_episodes_with_these_seeds(
    child_process: None, tmp_path: Path
) -> None:
    with live_session("PickCube-v1", tmp_path / "recordings", num_envs=N) as session:
        session.do(SampleResets())
        view = wait_until(session, lambda v: v.of(ResetCloud).state == "done", "the resets")
        cloud = view.of(ResetCloud)
        assert cloud.seeds == (0, N) and len(cloud.states) * N >= MIN_EPISODES
        cube = view.task.geometry.body_names.index("cube")
        for batch, seed in enumerate(cloud.seeds):
            step = start_over(session, seed).step
            np.testing.assert_array_equal(cloud.of(cube)[batch], step.poses[:, cube])
        assert np.ptp(cloud.of(cube)[..., :2], axis=(0, 1)).min() > 0.1
        assert cloud.overlaps("cube") == {} and not cloud.out_of_reach(cube).any()
        assert cloud.out_of_reach(view.task.geometry.body_names.index("panda/panda_hand")) is None
        session.do(HideResets())
        assert session.view().of(ResetCloud).state == "none"


PLACED = '''
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building import actors
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.pose import Pose


@register_env("Placed-v1", max_episode_steps=10)
class PlacedEnv(BaseEnv):
    """Two cubes: in env 1 inside each other, in env 2 five metres away."""

    def __init__(self, *args, robot_uids="panda", **kwargs):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_scene(self, options):
        build_ground(self.scene)
        self.one = actors.build_cube(self.scene, 0.02, [1, 0, 0, 1], "one")
        self.other = actors.build_cube(self.scene, 0.02, [0, 1, 0, 1], "other")

    def _initialize_episode(self, env_idx, options):
        p = torch.tensor([[0.4, 0.0, 0.02], [0.4, 0.0, 0.02], [5.0, 0.0, 0.02]])[env_idx]
        self.one.set_pose(Pose.create_from_pq(p=p))
        self.other.set_pose(Pose.create_from_pq(p=torch.tensor([[0.4, 0.1, 0.02], [0.4, 0.03, 0.02], [0.4, 0.1, 0.02]])[env_idx]))

    def evaluate(self):
        return {"success": self.one.pose.p[:, 0] > 9}
'''


def test_overlaps_and_bodies_out_of_reach_are_found_in_their_envs(
    child_process: None, tmp_path: Path
) -> None:
    (task := tmp_path / "placed.py").write_text(PLACED)
    with live_session(task, tmp_path / "recordings", num_envs=3) as session:
        session.do(SampleResets())
        view = wait_until(session, lambda v: v.of(ResetCloud).states, "a reset")
        cloud, names = view.of(ResetCloud), view.task.geometry.body_names
        (depths,) = cloud.overlaps("one").values()
        np.testing.assert_allclose(depths[0], [0, 0.01, 0], atol=1e-3)
        assert list(cloud.overlaps("other")) == ["one"] and list(cloud.overlaps("one")) == ["other"]
        assert cloud.out_of_reach(names.index("one"))[0].tolist() == [False, False, True]
        assert not cloud.out_of_reach(names.index("other"))[0].any()


def test_a_new_version_is_sampled_again_and_late_results_are_dropped(
    fake: FakeWorkerSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(Refused):
        fake.session.do(SampleResets())
    fake.load()
    begun: list[object] = []
    monkeypatch.setattr("workbench.hands.resets.ResetJobs.perform", lambda _, effect: begun.append(effect))
    fake.session.do(SampleResets())
    states = FirstStates(fake.view.step.poses)
    fake.session.dispatch(ResetSampled(0, states))
    assert fake.view.of(ResetCloud).seeds == (0,)
    fake.load("patched")
    assert fake.view.of(ResetCloud).seeds == () and len(begun) == 2
    fake.session.do(HideResets())
    fake.session.dispatch(ResetSampled(0, states))
    assert fake.view.of(ResetCloud) == replace(ResetCloud(), serial=fake.view.of(ResetCloud).serial)


def test_a_sampled_reset_is_shown_in_its_env_with_its_seed(fake: FakeWorkerSession) -> None:
    fake.load()
    fake.asked(Reset)
    with pytest.raises(Refused):
        fake.session.do(ShowReset(seed=6, env=3))
    assert not fake.asked(Reset)
    fake.session.do(ShowReset(seed=6, env=2))
    assert fake.view.selected_env == 2 and fake.view.seed == 6
    assert fake.asked(Reset) == [Reset(None, 6)]


@pytest.fixture
def sampled(panels: Panels) -> tuple[ResetsPanel, StubSession, ResetCloud]:
    """Two resets of three envs, drawn at the selected cube: in env 0 it overlaps, in env 1 it is out of reach, and in
    env 2 it is missing after the second reset."""
    session = StubSession()
    hands = HandsPanel(panels.server, session, lambda: "cube")  # type: ignore[arg-type]
    panel = ResetsPanel(panels.server, session, lambda: hands.selected)  # type: ignore[arg-type]
    view = running(3, selected_env=1)
    cube = view.task.geometry.body_names.index("cube")
    batches = [view.step.poses.copy() for _ in range(2)]
    for k, poses in enumerate(batches):
        poses[:, cube, :3] = [[0.1 * env, 0.1 * k, 0.02] for env in range(3)]
    batches[1][2, cube] = np.nan
    overlaps = (Overlap(("cube", "table"), 0.012),), (), ()
    beyond = np.array([[False], [True], [False]])
    states = tuple(FirstStates(poses, overlaps, (cube,), beyond) for poses in batches)
    cloud = ResetCloud("done", 1, (7, 10), states, 2)
    session.shown = view = replace(view, features={ResetCloud: cloud})
    hands.draw_in_view(view, view.step.poses, np.array([5.0, 0.0, 0.0]))
    panel.draw(view)
    panel.draw_in_view(view)
    return panel, session, cloud


def test_the_points_are_drawn_at_the_selected_body_and_a_click_names_seed_and_env(
    panels: Panels, sampled: tuple[ResetsPanel, StubSession, ResetCloud]
) -> None:
    panel, session, _ = sampled
    offset = np.array([5.0, 0.0, 0.0])
    (points,) = panels.nodes("/hands/resets")
    assert len(points.points) == 5 and points.points[:, 0].min() == 5.0
    colours = points.colors.tolist()
    assert colours[0] == colours[3] and colours[1] == colours[4]
    assert len({tuple(colour) for colour in colours}) == 3
    eye = np.array([5.0, 0.0, 3.0])
    at_point = np.array([0.1, 0.1, 0.02]) + offset - eye
    assert panel.reset_under_ray(eye, at_point) == ShowReset(seed=10, env=1)
    assert panel.reset_under_ray(eye, np.array([0.15, 0.15, 0.02]) + offset - eye) is None
    assert panel.reset_under_ray(eye, -at_point) is None
    session.shown = view = replace(session.shown, features={})
    panel.draw_in_view(view)
    assert not panels.nodes("/hands/resets")


def test_the_panel_counts_the_resets_and_offers_those_that_overlap_or_are_out_of_reach(
    panels: Panels, sampled: tuple[ResetsPanel, StubSession, ResetCloud]
) -> None:
    html = panels.html("wb-resets")
    assert html.count("<svg") == 2, "x and y vary"
    assert "2 of 5" in html and "12 mm" in html and "table" in html
    for command in (ShowReset(seed=7, env=0), ShowReset(seed=10, env=0), ShowReset(seed=7, env=1)):
        assert f"seed {command.seed} env {command.env}" in html
    assert "seed 7 env 2" not in html


def test_the_shapes_are_as_many_as_the_resets_that_have_the_body(
    panels: Panels, sampled: tuple[ResetsPanel, StubSession, ResetCloud]
) -> None:
    panel, session, _ = sampled
    panel.do(ToggleGhosts(), None)  # type: ignore[arg-type]
    panel.draw_in_view(session.shown)
    (shape,) = panels.nodes("/hands/ghosts/0")
    np.testing.assert_allclose(np.sort(shape.batched_positions[:, 0]), [5, 5, 5.1, 5.1, 5.2], atol=1e-6)
    panel.do(ToggleGhosts(), None)  # type: ignore[arg-type]
    panel.draw_in_view(session.shown)
    assert not panels.nodes("/hands/ghosts/0")


def test_what_the_resets_of_each_body_came_to_is_told_by_pairs_envs_and_bins() -> None:
    geometry = running(2).task.geometry
    cube, table = (geometry.body_names.index(name) for name in ("cube", "table"))
    poses = np.zeros((4, 2, len(geometry.body_names), 7), np.float32)
    poses[..., 3] = 1.0
    poses[..., cube, 0] = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    poses[3, 1, cube] = np.nan
    pairs = [
        ((), ()),
        (("cube", "table"), ()),
        ((("hand", "cube")), ("table", "cube")),
        ((), ("hand", "table")),
    ]
    states = tuple(
        FirstStates(
            poses[batch],
            tuple((Overlap(pair, 0.001 * (1 + batch)),) if pair else () for pair in of),  # type: ignore[arg-type]
            (cube, table),
            np.array([[batch == 3, False], [False, batch == 0]]),
        )
        for batch, of in enumerate(pairs)
    )
    cloud = ResetCloud("done", 1, (5, 7, 9, 11), states, 4)
    found = cloud.overlaps("cube")
    assert list(found) == ["table", "hand"], "the most frequent one first"
    np.testing.assert_allclose(found["table"], [[0, 0], [0.002, 0], [0, 0.003], [0, 0]])
    np.testing.assert_allclose(found["hand"], [[0, 0], [0, 0], [0.003, 0], [0, 0]])
    np.testing.assert_array_equal(cloud.out_of_reach(cube), [[0, 0], [0, 0], [0, 0], [1, 0]])
    np.testing.assert_array_equal(cloud.out_of_reach(table), [[0, 1], [0, 0], [0, 0], [0, 0]])
    assert marks(cloud, cube, "cube").tolist() == [[0, 0], [1, 0], [1, 1], [2, 0]]
    x = histograms(cloud, cube, "cube")[0]
    assert (x.low, x.high) == ("0.000 m", "1.000 m") and len(x.bars) == BINS
    assert [bar for bar in x.bars if any(bar)] == [(60, 40, 0), (0, 20, 20)], "in per cent of the fullest bin"
    assert x.bars[0] == (60, 40, 0) and x.bars[-1] == (0, 20, 20)
    rows = trouble_rows(cloud, cube, "cube")
    assert [(row.count, [show for _, show in row.resets]) for row in rows] == [
        ("2 of 7", [ShowReset(seed=7, env=0), ShowReset(seed=9, env=1)]),
        ("1 of 7", [ShowReset(seed=9, env=0)]),
        ("1 of 7", [ShowReset(seed=11, env=0)]),
    ]


def test_sampling_ends_after_its_batches_or_with_the_reason(
    fake: FakeWorkerSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Any] = []
    monkeypatch.setattr("workbench.hands.resets.ResetJobs.perform", lambda _, effect: begun.append(effect))
    fake.load()
    fake.session.do(SetSeed(seed=100))
    for _ in range(2):
        fake.session.do(SampleResets())
        seeds = begun[-1].seeds
        assert seeds == tuple(range(100, 100 + 3 * len(seeds), 3)) and 3 * (
            len(seeds) - 1
        ) < MIN_EPISODES <= 3 * len(seeds)
        serials = []
        for seed in seeds:
            assert fake.view.of(ResetCloud).state == "running"
            fake.session.dispatch(ResetSampled(seed, FirstStates(fake.view.step.poses)))
            serials.append(fake.view.of(ResetCloud).serial)
        cloud = fake.view.of(ResetCloud)
        assert cloud.state == "done" and cloud.seeds == seeds and len(set(serials)) == len(seeds)
    fake.session.do(SampleResets())
    fake.session.dispatch(SamplingFailed("it raised", None))
    assert (fake.view.of(ResetCloud).state, fake.view.of(ResetCloud).why) == ("failed", "it raised")
