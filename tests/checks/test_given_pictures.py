"""Rules about cameras and observations in modes with pictures, on reports in which cameras, objects and pictures differ."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.checks.checked import the_finding
from tests.checks.given import outcome
from workbench.checks.evidence.collect import Checkup
from workbench.checks.results import RuleResult
from workbench.checks.rules.cameras import hook_configs, sensor_configs, sensor_reports
from workbench.checks.rules.visual_modes import Followers, followers

pytestmark = pytest.mark.thorough

Views = dict[str, tuple[str, str]]
"""What a camera sees of each object in each picture: how it is with other things, and alone: ``"1 0 0"`` pixels."""


def report(things: Views, background: float = 0.0) -> Any:
    seen = []
    for name, (pixels, alone) in things.items():
        counts = [
            np.array([0 if each == "-" else int(each) for each in row.split()]) for row in (pixels, alone)
        ]
        present = np.array([each != "-" for each in pixels.split()])
        seen.append(SimpleNamespace(name=name, present=present, pixels=counts[0], alone=counts[1]))
    share = np.array([background, background])
    return SimpleNamespace(wanted_objects=lambda wanted: seen, depth=SimpleNamespace(background=share))


@pytest.fixture
def judged(example: Checkup, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(
        "workbench.checks.rules.cameras.cameras_of",
        lambda env: {("sensor", name): name for name in ("a", "b", "hand")},
    )
    monkeypatch.setattr(
        "workbench.checks.rules.cameras.mount_of", lambda env, camera: "link" if camera == "hand" else None
    )

    def judge(rule: str, looks: dict[Any, Any], **reports: Any) -> RuleResult:
        of = {("sensor", name): each for name, each in reports.items()}
        known = {sensor_reports: of, sensor_configs: ([], []), **looks}
        return outcome(example, rule, look=lambda see: known[see], pictured=example.task)

    return judge


def test_an_object_must_be_in_view_of_any_camera_in_most_pictures(judged: Any) -> None:
    a = report(
        {"cube": ("9 0 0 0", "9 0 0 0"), "goal": ("0 0 0 0", "5 5 5 5"), "lid": ("- 0 - 0", "- 0 - 0")}
    )
    b = report(
        {"cube": ("0 9 0 0", "0 9 0 0"), "goal": ("0 0 0 0", "0 0 0 0"), "lid": ("- 3 - 3", "- 3 - 3")}
    )
    result = judged("camera-sees", {}, a=a, b=b)
    finding = the_finding(result)
    assert finding.message.startswith("cube ") and finding.count == 2 and "2 of 4 pictures" in finding.message
    assert finding.function == "_default_sensor_configs"
    assert len(result.notes) == 1 and result.notes[0].endswith(": goal"), "it is in view, and always covered"
    # A quarter of the pictures may miss it.
    more = report(
        {"cube": ("0 9 9 0", "0 9 9 0"), "goal": ("0 0 0 1", "0 0 0 1"), "lid": ("- 3 - 3", "- 3 - 3")}
    )
    result = judged("camera-sees", {}, a=a, b=more)
    assert result.state == "kept" and result.notes == ()
    assert judged("camera-sees", {}, a=report({})).state == "not_applicable"


def test_each_fixed_camera_of_several_must_see_something(judged: Any) -> None:
    sees, blind = report({"cube": ("9 9", "9 9")}), report({"cube": ("0 0", "0 0")})
    finding = the_finding(judged("camera-sees", {}, a=sees, b=blind, hand=blind))
    assert "'b'" in finding.message and "cube" in finding.message
    assert judged("camera-sees", {}, a=sees, hand=blind).state == "kept"
    once = report({"cube": ("0 0", "0 1")})
    assert judged("camera-sees", {}, a=sees, b=once).state == "kept"


def test_the_background_of_each_fixed_camera_is_measured(judged: Any) -> None:
    finding = the_finding(
        judged("camera-background", {}, a=report({}, 0.5), b=report({}, 0.52), hand=report({}, 0.9))
    )
    assert "52%" in finding.message and "'b'" in finding.message
    assert judged("camera-background", {}, hand=report({}, 0.9)).state == "not_applicable"


def config(
    uid: str, width: int = 128, height: int = 128, length: float = 1.0, shader_pack: str = "minimal"
) -> Any:
    pose = SimpleNamespace(raw_pose=torch.tensor([[0, 0, 1, length, 0, 0, 0]]))
    return SimpleNamespace(uid=uid, width=width, height=height, pose=pose, shader_pack=shader_pack)


def test_two_cameras_of_one_name_are_found(judged: Any) -> None:
    def names(*of_task: str, robot: str = "hand") -> RuleResult:
        configs = [config(uid) for uid in of_task], [config(robot)]
        return judged("camera-names", {sensor_configs: configs})

    assert names("a", "b").state == "kept" and "'b'" in the_finding(names("a", "b", "b")).message
    assert "'hand'" in the_finding(names("a", "hand")).message
    assert judged("camera-names", {sensor_configs: ([], [])}).state == "not_applicable"


def test_the_pixels_and_the_turn_of_each_camera_are_judged(judged: Any) -> None:
    large = [config("a"), config("b", 512, 512), config("c", 512, 513)], [config("hand", 4000, 4000)]
    finding = the_finding(judged("camera-size", {sensor_configs: large}))
    assert "'c'" in finding.message and "512 x 513" in finding.message
    assert judged("camera-size", {sensor_configs: ([], large[1])}).state == "not_applicable"
    hooks = {
        ("sensor", "a"): config("a", length=1.0005),
        ("sensor", "hand"): config("hand", length=2),
        ("human", "film"): config("film", length=0.5, shader_pack="rt-fast"),
    }
    looks = {hook_configs: hooks, sensor_configs: ([], [config("hand")])}
    finding = the_finding(judged("camera-pose", looks))
    assert "'film'" in finding.message and "0.5" in finding.message
    assert finding.function == "_default_human_render_camera_configs"
    assert "'film'" in the_finding(judged("ray-traced", looks)).message
    del hooks["human", "film"]
    assert judged("camera-pose", looks).state == judged("ray-traced", looks).state == "kept"
    del hooks["sensor", "a"]
    assert judged("camera-pose", looks).state == "not_applicable"


def test_what_follows_a_body_is_told_at_its_entry(judged: Any) -> None:
    moved = {
        "cube": Followers(False, {"goal_pos", "tcp_pose"}, {"the reward"}),
        "lid": Followers(False, {"goal_pos"}, set()),
        "goal": Followers(True, {"other"}, {"success"}),
        "mark": Followers(True, set(), {"success", "cube_to_goal"}),
        "decor": Followers(True, set(), set()),
    }
    truth = judged("ground-truth", {followers: moved})
    found = {finding.message.split("'")[3]: finding for finding in truth.findings}
    assert found.keys() == {"goal_pos", "tcp_pose"} and found["goal_pos"].code.startswith('"goal_pos"')
    assert "cube, lid" in found["goal_pos"].message and "lid" not in found["tcp_pose"].message
    hidden = the_finding(judged("hidden-goal", {followers: moved}))
    assert hidden.message.startswith("mark ") and "cube_to_goal, success" in hidden.message
    assert hidden.function == "_get_obs_extra"
    for rule, bodies in (("ground-truth", ("goal", "mark")), ("hidden-goal", ("cube", "lid"))):
        assert judged(rule, {followers: {body: moved[body] for body in bodies}}).state == "not_applicable"
        assert judged(rule, {followers: {}}).state == "not_applicable"


def test_without_a_renderer_nothing_is_known_of_pictures(example: Checkup) -> None:
    states = {
        rule: outcome(example, rule).state
        for rule in ("camera-sees", "camera-background", "ground-truth", "hidden-goal")
    }
    assert set(states.values()) == {"not_known"}
    assert outcome(example, "camera-names").state == outcome(example, "camera-pose").state == "kept"
