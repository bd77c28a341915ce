"""Rules for the built scene, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from tests.checks.checked import Checked, CheckedRules, the_finding

pytestmark = pytest.mark.thorough

CUBE = 'self.cube = builder.build(name="cube")\n'
CUBE_AT = "builder.initial_pose = sapien.Pose(p=[0, 0, CUBE_HALF_SIZE])"
GOAL_POSE = "self.goal.set_pose(Pose.create_from_pq(p=goal, q=[1, 0, 0, 0]))"
PER_ENV = """parts = []
        for i in range(self.num_envs):
            each = self.scene.create_actor_builder()
            each.add_box_collision(half_size=[{size}] * 3)
            each.initial_pose = sapien.Pose(p=[0.3, 0.3, 0.02])
            each.set_scene_idxs([i])
            parts.append(each.build(name=f"part_{{i}}"))
        {merge}
"""
REGISTERED = """for part in parts:
            self.remove_from_state_dict_registry(part)
        self.add_to_state_dict_registry(self.merged)"""


def added(code: str) -> tuple[str, str]:
    """An edit that runs `code` after the cube is built."""
    return CUBE, f"{CUBE}        {code}\n"


def boxes(merge: str, size: str = "0.02") -> tuple[str, str]:
    """An edit that builds a box for each env."""
    return added(PER_ENV.format(size=size, merge=merge))


def test_a_robot_and_a_body_without_a_pose(checked_rules: CheckedRules) -> None:
    robot = "super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))", "super()._load_agent(options)"
    results = checked_rules(("robot-pose", "initial-pose"), robot, (CUBE_AT, ""), seeds=4)
    finding = the_finding(results["robot-pose"])
    assert "panda is built without an initial pose" in finding.message and finding.function == "_load_agent"
    finding = the_finding(results["initial-pose"])
    assert finding.code == CUBE.strip() and finding.function == "_load_scene"


FIXED = """fixed = self.scene.create_actor_builder()
        fixed.add_box_collision(half_size=[0.01] * 3, pose=sapien.Pose(p=[{x}, 0, 0.02]))
        fixed.{build}(name="fixed")"""


@pytest.mark.parametrize("build", ["build_static", "build_kinematic"])
def test_a_body_that_stays_at_the_origin_needs_no_pose(checked_rules: CheckedRules, build: str) -> None:
    away = added(FIXED.format(x=0.4, build=build))
    results = checked_rules(("initial-pose", "overlap-at-load"), away, seeds=4)
    assert {result.state for result in results.values()} == {"kept"}


def test_a_body_at_the_origin_inside_another_is_reported(checked: Checked) -> None:
    built = FIXED.format(x=0, build="build_kinematic").replace("fixed.build", "self.fixed = fixed.build")
    kinematic = added(built)
    aside = GOAL_POSE, f"{GOAL_POSE}\n            self.fixed.set_pose(Pose.create_from_pq(p=[0, 0.4, 0]))"
    finding = the_finding(checked("initial-pose", kinematic, aside, seeds=4))
    assert finding.code.startswith("self.fixed = fixed.build_kinematic")
    static = added(FIXED.format(x=0, build="build_static"))
    assert checked("initial-pose", static, seeds=4).state == "kept"
    assert "cube and fixed are built" in the_finding(checked("overlap-at-load", static, seeds=4)).message


def test_bodies_merged_under_one_name(checked: Checked) -> None:
    merge = "from mani_skill.utils.structs import Actor\n        Actor.merge(parts, name={})"
    finding = the_finding(checked("body-names", boxes(merge.format("'cube'")), seeds=4))
    assert "cube is the name of 2 bodies" in finding.message and "Actor.merge" in finding.code
    assert checked("body-names", boxes(merge.format("'box'")), seeds=4).state == "kept"


def test_an_articulation_of_many_links(checked: Checked) -> None:
    chain = """chain = self.scene.create_articulation_builder()
        link = chain.create_link_builder(None)
        for i in range({}):
            link.set_name(f"link_{{i}}")
            link = chain.create_link_builder(link)
            link.set_joint_name(f"joint_{{i}}")
            link.set_joint_properties("revolute", [[-1, 1]], sapien.Pose(), sapien.Pose())
        link.set_name("last")
        chain.initial_pose = sapien.Pose(p=[0.5, 0.5, 1])
        chain.build(name="chain", fix_root_link=True)"""
    finding = the_finding(checked("too-many-links", added(chain.format(64)), seeds=4))
    assert "chain has 65 links" in finding.message and "chain.build" in finding.code
    assert checked("too-many-links", added(chain.format(63)), seeds=4).state == "kept"


def meshed(file: Path, call: str) -> tuple[str, str]:
    """An edit that builds a body from a mesh file."""
    return added(f"""each = self.scene.create_actor_builder()
        each.{call.format(repr(str(file)))}
        each.initial_pose = sapien.Pose(p=[0.4, 0.4, 0.3])
        each.build_static(name="thing")""")


def open_box() -> trimesh.Trimesh:
    """A mesh with four walls and a floor."""
    floor = trimesh.creation.box(extents=(0.2, 0.2, 0.01))
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        wall = trimesh.creation.box(extents=(0.01, 0.2, 0.1) if x else (0.2, 0.01, 0.1))
        wall.apply_translation((0.1 * x, 0.1 * y, 0.05))
        floor = floor + wall
    return floor


def test_an_open_box_with_a_convex_hull(checked: Checked, tmp_path: Path) -> None:
    open_box().export(tmp_path / "box.stl")
    call = "add_convex_collision_from_file({})"
    finding = the_finding(checked("hull-fills-hollow", meshed(tmp_path / "box.stl", call), seeds=4))
    assert "thing is the convex hull of box.stl" in finding.message


def test_a_convex_decomposition_while_building(checked: Checked) -> None:
    call = "if False:\n            builder.add_multiple_convex_collisions_from_file('box.ply', decomposition={!r})"
    finding = the_finding(checked("decomposition-at-load", added(call.format("coacd")), seeds=4))
    assert "decomposition='coacd'" in finding.code and ".coacd.ply" in finding.message
    assert checked("decomposition-at-load", added(call.format("none")), seeds=4).state == "kept"


def test_a_mesh_of_many_triangles(checked: Checked, tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=7).export(tmp_path / "ball.ply")
    finding = the_finding(
        checked("heavy-mesh", meshed(tmp_path / "ball.ply", "add_visual_from_file({})"), seeds=4)
    )
    assert "327,680 triangles" in finding.message


def test_merged_parts_that_stay_in_the_state(checked: Checked) -> None:
    merge = "from mani_skill.utils.structs import Actor\n        self.merged = Actor.merge(parts, name='box')"
    finding = the_finding(checked("merged-actors", boxes(merge), seeds=4))
    assert finding.count == 4 and "part_0 and 3 more have 1 rows" in finding.message
    assert "Actor.merge" in finding.code
    assert checked("merged-actors", boxes(f"{merge}\n        {REGISTERED}"), seeds=4).state == "kept"


MARKERS = """markers = []
        for i in range(self.num_envs):
            each = self.scene.create_actor_builder()
            each.add_sphere_visual(radius=0.02)
            each.initial_pose = sapien.Pose(p=[0.3, 0.3, 0.2])
            each.set_scene_idxs([i])
            marker = each.build_kinematic(name=f"marker_{{i}}")
            self.remove_from_state_dict_registry(marker)
            {of_each}
            markers.append(marker)
        from mani_skill.utils.structs import Actor
        self.marker = Actor.merge(markers, "marker")
        {after}
        self.add_to_state_dict_registry(self.marker)
"""
HIDE = "self._hidden_objects.append({})"
NO_COLLISION = "self.marker.has_collision_shapes = False"


def markers(of_each: str = "pass", after: str = "pass") -> tuple[str, str]:
    """An edit that builds and merges a marker per env."""
    return added(MARKERS.format(of_each=of_each, after=after))


def test_hidden_parts_of_an_actor_that_is_not_hidden(checked: Checked) -> None:
    finding = the_finding(checked("hidden-objects", markers(HIDE.format("marker")), seeds=4))
    assert finding.code == HIDE.format("marker") and finding.count == 4 and finding.function == "_load_scene"
    assert NO_COLLISION in finding.message and HIDE.format("self.marker") in finding.message


def test_a_body_that_cannot_be_hidden(checked: Checked) -> None:
    hide = HIDE.format("self.marker")
    for edit, line in (
        (markers(after=hide), hide),
        (added(HIDE.format("self.cube")), HIDE.format("self.cube")),
        (added(HIDE.format("self.agent.robot")), HIDE.format("self.agent.robot")),
    ):
        assert the_finding(checked("hidden-objects", edit, seeds=4)).code == line


def test_one_env_that_always_has_the_same_objects(checked: Checked) -> None:
    drawn = boxes("pass", size="0.02 + 0.01 * self._batched_episode_rng[i].rand()")
    assert "reconfiguration_freq" in the_finding(checked("reconfigures", drawn, seeds=4)).message
    freq = "super().__init__(*args, robot_uids=robot_uids, **kwargs)"
    often = freq, freq.replace("**kwargs", "reconfiguration_freq=1, **kwargs")
    assert checked("reconfigures", drawn, often, seeds=4).state == "kept"
