"""Rules for the placement of bodies at resets, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

import pytest
from packaging.version import Version
from scipy import __version__ as scipy_version

from tests.checks.checked import Checked, the_finding

pytestmark = pytest.mark.thorough

CUBE_POSE = "self.cube.set_pose(Pose.create_from_pq(p=cube, q=[1, 0, 0, 0]))"
HEIGHT = "cube[:, 2] = CUBE_HALF_SIZE\n"


def test_a_cube_in_the_table(checked: Checked) -> None:
    finding = the_finding(checked("overlap-at-reset", (HEIGHT, "cube[:, 2] = 0.005\n")))
    assert "cube and table-workspace are 15 mm" in finding.message and finding.count == 8
    assert finding.code == CUBE_POSE and finding.function == "_initialize_episode"


def test_a_cube_above_the_table(checked: Checked) -> None:
    finding = the_finding(checked("falls-at-reset", (HEIGHT, "cube[:, 2] = 0.08\n")))
    assert "cube falls 0.06 m" in finding.message and finding.code == CUBE_POSE


def test_full_batch_values_in_a_partial_reset(checked: Checked) -> None:
    edit = "cube = torch.zeros((b, 3))", "cube = torch.zeros((self.num_envs, 3))"
    fails = "cube[:, :2] = (2 * torch.rand((b, 2))", "cube[:, :2] = (2 * torch.rand((self.num_envs, 2))"
    finding = the_finding(checked("batch-of-reset", edit, fails))
    assert "self.num_envs" in finding.code and "len(env_idx)" in finding.message


def test_selecting_rows_of_a_full_batch_is_correct(checked: Checked) -> None:
    edit = "torch.rand((b, 2))", "torch.rand((self.num_envs, 2))[env_idx]"
    assert checked("batch-of-reset", edit).state == "kept"


LAZY = "            if not hasattr(self, 'begun'):\n                self.begun = torch.zeros((self.num_envs, 3))\n"
KEPT = f"{LAZY}            self.begun[env_idx] = cube\n"
MINE = "            if len(env_idx) < self.num_envs: raise ValueError('my own mistake')\n"


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize(
    "edit",
    [
        pytest.param(("builder.initial_pose = sapien.Pose(p=[0, 0", "self.gone\n        builder.initial_pose = sapien.Pose(p=[0, 0"), id="in the build"),
        pytest.param((f"            {CUBE_POSE}\n", f"            {CUBE_POSE}\n{KEPT}{MINE}"), id="in a partial reset"),
    ],
)  # fmt: skip
def test_a_buffer_of_all_envs_is_not_blamed_for_another_error(
    checked: Checked, edit: tuple[str, str]
) -> None:
    buffer = f"            {CUBE_POSE}\n", f"            {CUBE_POSE}\n{KEPT}"
    assert checked("batch-of-reset", buffer).state == "kept"
    edits = (edit,) if "begun" in edit[1] else (edit, buffer)
    result = checked("batch-of-reset", *edits)
    assert result.state == "not_known" and result.findings == () and result.problem is not None


TURNED = """half = torch.rand(b) * 3
            zero = torch.zeros(b)
            q = torch.stack([{}], dim=1)
            self.cube.set_pose(Pose.create_from_pq(p=cube, q=q))"""


def test_quaternions_in_xyzw_order(checked: Checked) -> None:
    wrong = TURNED.format("zero, zero, half.sin(), half.cos()")
    finding = the_finding(checked("quaternion-order", (CUBE_POSE, wrong)))
    assert "x, y, z, w" in finding.message and finding.code.startswith("self.cube.set_pose")
    right = TURNED.format("half.cos(), zero, zero, half.sin()")
    assert checked("quaternion-order", (CUBE_POSE, right)).state == "kept"


def test_quaternions_of_scipy(checked: Checked) -> None:
    scipy = "Rotation.identity(b).as_quat({})"
    lines = "from scipy.spatial.transform import Rotation\n            {}\n            " + CUBE_POSE
    finding = the_finding(checked("quaternion-order", (CUBE_POSE, lines.format("q = " + scipy.format("")))))
    assert "as_quat() gives x, y, z, w" in finding.message
    orders = [f"q = np.roll({scipy.format('')}, 1, axis=-1)"]
    if Version(scipy_version) >= Version("1.14"):
        orders.append("q = " + scipy.format("scalar_first=True"))
    for order in orders:
        assert checked("quaternion-order", (CUBE_POSE, lines.format(order))).state == "kept"


def test_a_quaternion_that_is_not_normalised(checked: Checked) -> None:
    edit = CUBE_POSE, CUBE_POSE.replace("[1, 0, 0, 0]", "[1, 0, 0, 1]")
    finding = the_finding(checked("unit-quaternion", edit))
    assert "has length 1.41" in finding.message and "[1, 0, 0, 1]" in finding.code
    last = CUBE_POSE.replace(
        "[1, 0, 0, 0]", "torch.eye(4)[[0] * b] * torch.arange(1, b + 1).clamp(max=2)[:, None]"
    )
    finding = the_finding(checked("unit-quaternion", (CUBE_POSE, last)))
    assert "has length 2" in finding.message and "(2, 0, 0, 0)" in finding.message, "the first env's is right"


DOOR = """door = self.scene.create_articulation_builder()
        frame = door.create_link_builder()
        frame.set_name("frame")
        leaf = door.create_link_builder(frame)
        leaf.set_name("leaf")
        leaf.set_joint_name("hinge")
        leaf.add_box_collision(half_size=[0.1] * 3)
        leaf.set_joint_properties("revolute", [[-9, 9]], sapien.Pose(), sapien.Pose([0, 0.5, 0]), 0.0, 0.0)
        door.initial_pose = sapien.Pose([0, 3, 1])
        self.door = door.build("door", fix_root_link=True)
        super()"""


def test_a_robot_that_cannot_hold_itself_is_told_from_a_door_that_falls_open(checked: Checked) -> None:
    load = "super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))\n"
    assert checked("robot-holds", (load, load.replace("super()", DOOR)), seeds=4).state == "kept"
    weak = """super()._load_agent(options, sapien.Pose(p=[-0.615, 0, 0]))
        for link in self.agent.robot.links:
            link.disable_gravity[:] = False
            for each in link._objs:
                each.disable_gravity = False
        for joint in self.agent.robot.active_joints:
            joint.set_drive_properties(1.0, 1.0)
"""
    finding = the_finding(checked("robot-holds", (load, weak.replace("super()", DOOR)), seeds=4))
    assert "panda_joint" in finding.message and finding.function == "_initialize_episode"


def test_a_cube_that_flies_off(checked: Checked) -> None:
    thrown = "            self.cube.set_linear_velocity(torch.tensor([0.0, 0.0, 60.0]).repeat(b, 1))\n\n"
    ahead = "            # Ahead of the cube by"
    finding = the_finding(checked("bodies-stay", (ahead, thrown + ahead)))
    assert finding.message.startswith("cube moved at ") and "at step 1 of seed 0" in finding.message
    assert "8 of 8 random episodes" in finding.message and finding.code.startswith("self.cube.set_pose(")


def test_a_cube_that_falls_off_the_table_breaks_it_unless_the_episode_ends_there(checked: Checked) -> None:
    beside = HEIGHT, HEIGHT + "            cube[:, 0] += 2\n"
    assert checked("bodies-stay", beside).state == "kept"
    finding = the_finding(checked("bodies-stay", beside, ("height < -0.1", "height < -9")))
    assert finding.message.startswith("cube dropped 0.")
