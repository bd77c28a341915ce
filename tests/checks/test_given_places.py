"""Rules about where bodies are, on poses that differ in every env: which body, how far, and in which seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from tests.checks.checked import the_finding
from tests.checks.given import SEEDS, Judged, outcome
from workbench.checks.evidence.builds import Built, Merged, Shape
from workbench.checks.evidence.collect import Checkup
from workbench.checks.evidence.rolled_episodes import Episodes, SeenOutlier
from workbench.envs.inspection import Overlap
from workbench.envs.outliers import OutlierKind

pytestmark = pytest.mark.thorough

Moves = Mapping[tuple[int, str], tuple[float, float, float]]
"""Metres by which a body is away from where it began, by episode and name."""
TABLE = "table-workspace"


def moved(example: Checkup, moves: Moves, times: int = 2) -> NDArray[np.float32]:
    """(T, K, B, 7) the poses of the starts, with these moves at the last time."""
    poses = np.repeat(example.starts.poses[:1], times, axis=0).copy()
    for (episode, body), away in moves.items():
        poses[-1, episode, example.bodies.index(body), :3] += np.array(away, np.float32)
    return poses


def still(example: Checkup, moves: Moves | None = None, **changes: Any) -> Episodes:
    qpos = example.starts.qpos
    assert qpos is not None
    of = Episodes("still", SEEDS, moved(example, moves or {}), np.repeat(qpos[:1], 2, axis=0))
    return replace(of, **changes)


def test_the_body_that_falls_is_named_with_its_way_in_its_own_seed(example: Checkup, judged: Judged) -> None:
    falls = still(example, {(1, "cube"): (0, 0.01, -0.05), (2, "cube"): (0, 0, -0.03)})
    finding = the_finding(judged("falls-at-reset", still=falls, overlaps={}))
    assert finding.count == 2 and "2 of 3 seeds (seed 21, 22)" in finding.message
    assert finding.message.startswith("cube falls 0.05 m and turns 0 ") and finding.code.startswith(
        "self.cube.set_pose("
    )
    slides = still(example, {(1, "cube"): (0, 0, -0.05), (2, "cube"): (0.2, 0, -0.05)})
    assert "cube moves 0.21 m" in the_finding(judged("falls-at-reset", still=slides, overlaps={})).message
    settles = still(
        example, {(1, "cube"): (0, 0, -0.015), (0, "goal"): (0, 0, -1), (0, "panda/panda_hand"): (0, 0, -1)}
    )
    assert judged("falls-at-reset", still=settles, overlaps={}).state == "kept"


def test_a_body_that_turns_or_is_lost_does_not_stay(example: Checkup, judged: Judged) -> None:
    cube = example.bodies.index("cube")
    turned, lost = moved(example, {}), moved(example, {})
    # A quaternion and its negative are the same turn.
    turned[-1, 0, cube, 3:] *= -1
    turned[-1, 2, cube, 0] += 0.001
    turned[-1, 2, cube, 3:] = [np.cos(0.25), 0, np.sin(0.25), 0]
    finding = the_finding(judged("falls-at-reset", still=still(example, poses=turned), overlaps={}))
    assert finding.count == 1 and "0.00 m and turns 29 " in finding.message and "(seed 22)" in finding.message
    lost[-1, 1, cube] = np.nan
    finding = the_finding(judged("falls-at-reset", still=still(example, poses=lost), overlaps={}))
    assert "(seed 21)" in finding.message and "nan" not in finding.message
    lost[0, 1, cube] = np.nan  # this env lacks the body
    assert judged("falls-at-reset", still=still(example, poses=lost), overlaps={}).state == "kept"


def test_a_body_in_the_hand_may_slip(example: Checkup, judged: Judged) -> None:
    falls = still(example, {(1, "cube"): (0, 0, -0.05)})
    held = {20: (), 21: (Overlap(("cube", "panda/panda_hand"), 0.0),)}
    assert judged("falls-at-reset", still=falls, overlaps=held).state == "not_known"
    on_table = {20: (Overlap(("cube", TABLE), 0.0),)}
    assert judged("falls-at-reset", still=falls, overlaps=on_table).state == "broken"


def test_the_deepest_overlap_of_two_bodies_is_reported_with_its_seeds(judged: Judged) -> None:
    overlaps = {
        20: (Overlap(("cube", TABLE), 0.008), Overlap(("cube", "panda/panda_hand"), 0.02)),
        21: (Overlap(("cube", TABLE), 0.012), Overlap(("cube", "panda/panda_leftfinger"), 0.03)),
        22: (Overlap(("cube", TABLE), 0.0001), Overlap((TABLE, "ground"), 0.9)),
    }
    result = judged("overlap-at-reset", overlaps=overlaps)
    hand, table = result.findings
    assert (
        hand.message.startswith("cube and panda/panda_leftfinger are 30 mm") and "(seed 21)" in hand.message
    )
    assert (
        table.message.startswith(f"cube and {TABLE} are 12 mm")
        and "2 of 3 seeds (seed 20, 21)" in table.message
    )
    assert (hand.count, table.count) == (1, 2) and table.code.startswith("self.cube.set_pose(")
    robot = {20: (Overlap(("panda/panda_hand", TABLE), 0.02),)}
    assert the_finding(judged("overlap-at-reset", overlaps=robot)).count == 1


def test_the_joint_that_sags_is_named_with_its_seeds(example: Checkup, judged: Judged) -> None:
    qpos = still(example).qpos
    assert qpos is not None
    qpos = qpos.copy()
    qpos[-1, 0, 1] += 0.09  # a revolute joint may move by 0.1
    qpos[-1, 1, 2] -= 0.15
    qpos[-1, 2, 2] += 0.12
    qpos[-1, 2, 7] += 0.019  # a finger by 0.02
    finding = the_finding(judged("robot-holds", still=still(example, qpos=qpos)))
    assert "panda_joint3 moves 0.15 rad" in finding.message and "2 of 3 seeds" in finding.message
    qpos[-1, :, 2] = qpos[0, :, 2]
    assert judged("robot-holds", still=still(example, qpos=qpos)).state == "kept"
    qpos[-1, 2, 7] += 0.01
    assert (
        "panda_finger_joint1 moves 0.03 m"
        in the_finding(judged("robot-holds", still=still(example, qpos=qpos))).message
    )
    assert judged("robot-holds", still=still(example, qpos=None)).state == "not_known"


def test_a_body_out_of_reach_is_found_where_it_is_out_of_reach(example: Checkup, judged: Judged) -> None:
    starts = replace(example.starts, poses=moved(example, {(1, "cube"): (3, 0, 0)}, times=1))
    finding = the_finding(judged("outside-reach", starts=starts))
    # The base of the robot stands at x = -0.615.
    x = 0.615 + 3 + example.starts.poses[0, 1, example.bodies.index("cube"), 0]
    assert f"cube is up to {x:.2f} m" in finding.message and "1 of 3 seeds (seed 21)" in finding.message
    reach = float(finding.message.split(" m: ")[0].rpartition(" ")[2])
    assert 1.1 < reach < 1.4, (
        "the shoulder of the Panda is 0.333 m high, and its arm with the hand is almost 1 m long"
    )
    everywhere = moved(example, {(k, "cube"): (3, 0, 0) for k in range(3)}, times=1)
    result = judged("outside-reach", starts=replace(starts, poses=everywhere))
    assert result.state == "not_known" and "cube" in result.why


def test_a_goal_that_moves_in_one_episode_is_moved(example: Checkup, judged: Judged) -> None:
    same = np.broadcast_to(example.starts.poses[:1, :1], (3, 3, *example.starts.poses.shape[2:])).copy()
    starts, random = (replace(example.starts, poses=poses) for poses in (same[:1], same))
    finding = the_finding(judged("kinematic-never-moved", starts=starts, random=random))
    assert finding.code.startswith("self.goal = builder.build_kinematic(")
    moves = same.copy()
    moves[1, 2, example.bodies.index("goal"), 1] += 0.001
    moving = replace(random, poses=moves)
    assert judged("kinematic-never-moved", starts=starts, random=moving).state == "kept"
    assert judged("kinematic-never-moved", starts=replace(random, poses=moves), random=random).state == "kept"


def test_the_body_that_leaves_its_env_furthest_is_named(example: Checkup, judged: Judged) -> None:
    spacing = example.task.env.sim_config.spacing
    cube = {(2, "cube"): (0.0, -spacing, 0.0), (0, "cube"): (0.45 * spacing, 0.0, spacing)}
    poses = moved(example, {**cube, (1, "panda/panda_hand"): (0.7 * spacing, 0.0, 0.0)}, times=4)
    random = replace(example.random, poses=poses)
    finding = the_finding(judged("env-spacing", random=random))
    assert finding.message.startswith("cube is up to ") and f"{spacing:g} m apart" in finding.message
    assert finding.count == 1 and "1 of 3 episodes" in finding.message
    inside = replace(example.random, poses=moved(example, {(0, "cube"): (0.45 * spacing, 0.0, spacing)}, 4))
    assert judged("env-spacing", random=inside).state == "kept"


def test_the_first_outlier_of_a_body_is_told_and_all_its_seeds_are_counted(
    example: Checkup, judged: Judged
) -> None:
    def seen(kind: OutlierKind, step: int, seed: int, reason: str, body: str = "cube") -> SeenOutlier:
        return SeenOutlier(kind, step, seed, reason, body)

    outliers = (
        seen(OutlierKind.FAST, 3, 22, "cube moved at 30 m/s"),
        seen(OutlierKind.DROPPED, 2, 21, "cube dropped 0.9 m"),
        seen(OutlierKind.FAST, 4, 21, "cube moved at 40 m/s"),
        seen(OutlierKind.UNDER_FLOOR, 1, 22, "hand is under the floor", "panda/panda_hand"),
        seen(OutlierKind.REWARD_NOT_FINITE, 1, 20, "the reward is NaN", ""),
    )
    random = replace(example.random, outliers=outliers)
    hand, cube = judged("bodies-stay", random=random).findings
    assert hand.message.startswith("hand is under the floor at step 1 of seed 22")
    assert cube.message.startswith("cube dropped 0.9 m at step 2 of seed 21") and cube.count == 2
    assert "2 of 3 random episodes (seed 21, 22)" in cube.message and cube.code.startswith(
        "self.cube.set_pose("
    )


def test_overlaps_of_the_built_scene_are_reported_at_the_line_that_builds(
    example: Checkup, judged: Judged
) -> None:
    pairs = (
        Overlap(("cube", TABLE), 0.02),
        Overlap(("cube", "ground"), 0.004),
        Overlap((TABLE, "ground"), 0.9),
        Overlap(("panda/panda_hand", TABLE), 0.01),
    )
    alone = replace(example.alone, overlaps=pairs)
    cube, hand = judged("overlap-at-load", alone=alone).findings
    assert "20 mm" in cube.message and cube.code.startswith("self.cube = builder.build(")
    assert "10 mm" in hand.message and hand.function == "_load_agent"


def test_quaternions_of_each_body_are_judged_alone(example: Checkup) -> None:
    """In the order x, y, z, w a turn about the vertical looks like one that no body needs: (0, 0, ...)."""
    (cube, goal), line = example.placed[-2:], example.placed[-1].place
    assert (cube.name, goal.name) == ("cube", "goal")

    def judged(*rows: Sequence[float], rule: str = "quaternion-order") -> Any:
        given = np.array(rows, np.float32)
        placed = [*example.placed[:-1], replace(goal, quaternions=given)]
        return outcome(example, rule, placed=placed)

    turns = [[0, 0, np.sin(half), np.cos(half)] for half in (0.2, 0.5, 0.9)]
    finding = the_finding(judged(*turns))
    assert finding.message.startswith("The quaternions of goal ") and (finding.file, finding.line) == line[:2]  # type: ignore[index]
    right = [[np.cos(half), 0, 0, np.sin(half)] for half in (0.2, 0.5, 0.9)]
    assert judged(*right).state == "kept"
    assert judged(*turns[:2], [0.1, 0, 0.2, 0.97]).state == "kept"
    half_turn = judged(*[[0, 0, 0, 1]] * 3)
    assert half_turn.state == "kept" and half_turn.notes[0].startswith("goal ")
    long = the_finding(judged([1, 0, 0, 0], [0, 0, 3, 4], [0, 1, 0, 0], rule="unit-quaternion"))
    assert "goal has length 5: (0, 0, 3, 4)" in long.message and (long.file, long.line) == line[:2]  # type: ignore[index]
    short = the_finding(judged([1, 0, 0, 0], [0.3, 0, 0.4, 0], rule="unit-quaternion"))
    assert "goal has length 0.5: (0.3, 0, 0.4, 0)" in short.message
    assert judged([1, 0, 0, 0.02], rule="unit-quaternion").state == "kept"


# --- bodies as they were built ---------------------------------------------------------------------------


def built(example: Checkup, **changes: Any) -> list[Built]:
    """What the example builds, with these changes of the bodies by name."""
    assert example.task
    return [replace(each, **changes.get(each.name, {})) for each in example.builds]


def test_a_robot_without_a_pose_is_reported_where_it_is_loaded(example: Checkup, judged: Judged) -> None:
    finding = the_finding(judged("robot-pose", builds=built(example, panda={"quaternion": None})))
    assert finding.message.startswith("panda ") and finding.function == "_load_agent"
    assert judged("robot-pose", builds=built(example, cube={"quaternion": None})).state == "kept"
    for changes in ({"of_robot": False}, {"kind": "dynamic"}):
        other = built(example, panda={"quaternion": None, **changes})
        assert judged("robot-pose", builds=other).state == "not_applicable"


def test_only_a_body_that_may_be_pushed_away_needs_a_pose(example: Checkup, judged: Judged) -> None:
    none = {"quaternion": None}
    finding = the_finding(judged("initial-pose", builds=built(example, cube=none)))
    assert finding.message.startswith("cube is ") and finding.code.startswith("self.cube = builder.build(")
    other = replace(built(example, cube=none)[-2], name="lid", quaternion=None)
    two = judged("initial-pose", builds=[*built(example, cube=none), other])
    assert the_finding(two).count == 2 and the_finding(two).message.startswith("cube and 1 more are ")
    for changes in ({"kind": "static"}, {"collision": ()}, {"of_robot": True}, {"place": None}):
        assert judged("initial-pose", builds=built(example, cube={**none, **changes})).state == "kept", (
            changes
        )
    solid = {**none, "collision": example.builds[-2].collision}
    inside = replace(example.alone, overlaps=(Overlap(("goal", TABLE), 0.01),))
    for alone, state in ((replace(inside, overlaps=()), "kept"), (inside, "broken")):
        assert judged("initial-pose", builds=built(example, goal=solid), alone=alone).state == state
    merges = [Merged("box", frozenset(["goal"]), ("task.py", 1, "_load_scene"))]
    inside = replace(inside, overlaps=(Overlap(("box", TABLE), 0.01),))
    in_parts = judged("initial-pose", builds=built(example, goal=solid), alone=inside, merges=merges)
    assert in_parts.state == "broken"
    # What has no pose is reported once, not as an overlap too.
    pair = replace(example.alone, overlaps=(Overlap(("cube", TABLE), 0.02),))
    for builds, state in ((built(example), "broken"), (built(example, cube=none), "kept")):
        assert judged("overlap-at-load", builds=builds, alone=pair).state == state


def test_a_name_belongs_to_one_body(example: Checkup) -> None:
    line = example.places.body("cube")
    assert line is not None

    def judged(*merges: tuple[str | None, str]) -> Any:
        of = [Merged(name, frozenset(parts.split()), line) for name, parts in merges]
        return outcome(example, "body-names", merges=of)

    assert judged(("box", "part_0 part_1"), ("lid", "lid_0 lid_1")).state == "kept"
    assert judged(("box", "part_0 part_1"), ("box", "part_1 part_0")).state == "kept", (
        "a rebuild merges again"
    )
    twice = judged(("box", "part_0 part_1"), ("box", "lid_0 lid_1"))
    assert len(twice.findings) == 2 and all(
        "box" in one.message and " 2 " in one.message for one in twice.findings
    )
    assert " 2 " in the_finding(judged(("cube", "part_0 part_1"))).message
    assert judged(("cube", "cube part_1")).state == "kept"
    nameless = the_finding(judged((None, "part_0 part_1 part_2")))
    assert nameless.message.startswith("3 ") and (nameless.file, nameless.line) == line[:2]


def test_each_mesh_file_is_judged_with_the_first_body_that_uses_it(
    example: Checkup, judged: Judged, tmp_path: Path
) -> None:
    heavy, light = str(tmp_path / "heavy.ply"), str(tmp_path / "light.ply")
    trimesh.creation.icosphere(subdivisions=7).export(heavy)
    trimesh.creation.icosphere(subdivisions=2).export(light)

    def drawn(*files: str, kind: str = "file") -> tuple[Shape, ...]:
        return tuple(Shape(kind, file, ()) for file in files)

    both = built(example, cube={"visual": drawn(light)}, goal={"visual": drawn(heavy, light)})
    again = replace(both[-1], name="later", visual=drawn(heavy))
    finding = the_finding(judged("heavy-mesh", builds=[*both, again]))
    assert finding.message.startswith("goal is drawn with 327,680 ") and "heavy.ply" in finding.message
    assert finding.code.startswith("self.goal = ")
    table = built(example, **{TABLE: {"visual": drawn(heavy)}})
    assert judged("heavy-mesh", builds=table).state == "not_applicable", "not of the author"
    (tmp_path / "text.ply").write_text("no mesh " * 50_000)
    unread = built(example, cube={"visual": drawn(str(tmp_path / "text.ply"))})
    result = judged("heavy-mesh", builds=unread)
    assert result.state == "not_known" and "text.ply" in result.why
    hull = built(example, cube={"collision": drawn(light, kind="convex_mesh")})
    assert judged("hull-fills-hollow", builds=hull).state == "kept"
    assert judged("hull-fills-hollow", builds=both).state == "not_applicable"
