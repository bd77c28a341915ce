"""Ways in which authors write cameras, from ManiSkill's tasks and robots and from variations of them.

Each is a file with a class ``Task`` whose camera ``cam`` a test edits. Edits of `WRITTEN` succeed; edits of `REFUSED`
are refused for the reason given with it.
"""

from __future__ import annotations

from textwrap import dedent, indent

from tests.cameras.edit.real_cameras import HEADER


def _hook(body: str, name: str = "_default_sensor_configs", before: str = "", members: str = "") -> str:
    parts = [HEADER, dedent(before), "class Task(Base):\n"]
    if members:
        parts += [indent(dedent(members), "    "), "\n"]
    parts += ["    @property\n", f"    def {name}(self):\n", indent(dedent(body), "        ")]
    return "".join(parts)


WRITTEN: dict[str, str] = {
    "one config, positional": _hook(
        """\
        pose = sapien_utils.look_at([0.6, 0.7, 0.6], [0.0, 0.0, 0.35])
        return CameraConfig("cam", pose, 512, 512, 1, 0.01, 100)
        """,
        "_default_human_render_camera_configs",
    ),
    "a list, positional to the end": _hook(
        """\
        pose = sapien_utils.look_at(eye=[0.3, 0, 0.6], target=[-0.1, 0, 0.1])
        return [CameraConfig("cam", pose, 128, 128, np.pi / 2, 0.01, 100)]
        """
    ),
    "one argument per line, with comments": _hook(
        """\
        return [
            # replicated from the xml file
            CameraConfig(
                uid="cam",  # the side
                pose=sapien_utils.look_at(eye=[0, -2.8, 0.8], target=[0, 0, 0]),
                width=128,
                height=128,
                fov=60 * np.pi / 180,
                near=0.01,
                far=100,
                mount=self.camera_link,
                # shader_pack="rt",
            ),
        ]
        """
    ),
    "one argument per line, no trailing comma": _hook(
        """\
        return [
            CameraConfig(
                uid="cam",
                pose=sapien.Pose(p=[0, 0, -0.05], q=[0.70710678, 0, 0.70710678, 0]),
                width=128,
                height=128,
                fov=1.57  # about 90 degrees
            )
        ]
        """
    ),
    "libraries imported under other names": _hook(
        """\
        return [Cam("cam", su.look_at(eye=[0.3, 0, 0.6], target=[-0.1, 0, 0.1]), 128, 128, np.deg2rad(90.0))]
        """,
        before=(
            "from mani_skill.utils import sapien_utils as su\n"
            "from mani_skill.sensors.camera import CameraConfig as Cam\n\n\n"
        ),
    ),
    "sapien.Pose, positional": _hook(
        """\
        return CameraConfig(
            "cam",
            sapien.Pose(
                [0.279123, 0.303438, 1.34794], [0.252428, 0.396735, 0.114442, -0.875091]
            ),
            128,
            128,
            np.pi / 2,
            0.01,
            100,
        )
        """
    ),
    "a default pose": _hook('return [CameraConfig("cam", sapien.Pose(), 128, 128, 1.2)]\n'),
    "Pose.create_from_pq in a robot": _hook(
        """\
        return [
            CameraConfig(
                uid="cam",
                pose=Pose.create_from_pq([0, 0, 0], [1, 0, 0, 0]),  # identity
                width=128,
                height=128,
                fov=2,
                near=0.01,
                far=100,
                entity_uid="gripper_link",
            ),
            CameraConfig(
                uid="other",
                pose=Pose.create_from_pq([-0.1, 0, 0.1], [1, 0, 0, 0]),
                width=128,
                height=128,
                fov=2,
                entity_uid="gripper_link",
            ),
        ]
        """,
        "_sensor_configs",
    ),
    "euler angles in degrees": _hook(
        """\
        q = euler2quat(np.deg2rad(10), np.deg2rad(30), -90 * np.pi / 180)
        return CameraConfig("cam", sapien.Pose([0.5, 0, 0.5], q), 128, 128, np.radians(60))
        """
    ),
    "euler angles with their axes": _hook(
        """\
        q = euler2quat(0.1, 0.5, -1.5, axes="sxyz")
        return CameraConfig("cam", sapien.Pose([0.5, 0, 0.5], q), 128, 128, np.radians(60))
        """
    ),
    "an intrinsic": _hook(
        """\
        return [
            CameraConfig(
                uid="cam",
                pose=sapien.Pose([0, 0, 0], [0.5, 0.5, -0.5, 0.5]),
                width=640,
                height=512,
                intrinsic=np.array([[425.0, 0, 305.0], [0, 413.1, 233.0], [0, 0, 1]]),
            )
        ]
        """
    ),
    "constants that are read twice": _hook(
        """\
        pose = sapien_utils.look_at(eye=EYE, target=TARGET)
        return [CameraConfig("cam", pose, 128, 128, 1.0), CameraConfig("other", pose, 64, 64, 1.0)]
        """,
        before="EYE = [0.3, 0, 0.6]\nTARGET = np.array([-0.1, 0, 0.1])\n\n\n",
    ),
    "constants of the class": _hook(
        """\
        pose = sapien_utils.look_at(eye=self.eye, target=Task.target)
        return [CameraConfig("cam", pose, 128, 128, self.fov)]
        """,
        members="eye = [0.3, 0, 0.6]\ntarget: tuple = (-0.1, 0, 0.1)\nfov = 1.1",
    ),
    "set in __init__": _hook(
        """\
        pose = sapien_utils.look_at(eye=self.eye, target=[0, 0, 0])
        return [CameraConfig("cam", pose, 128, 128, 1.0)]
        """,
        members="def __init__(self):\n    self.eye = [0.3, 0, 0.6]\n",
    ),
    "a dict of numbers": _hook(
        """\
        pose = sapien_utils.look_at(CAMERA["eye"], CAMERA["target"])
        return [CameraConfig("cam", pose=pose, width=128, height=128, fov=CAMERA["fov"])]
        """,
        before='CAMERA = {"eye": [0.3, 0, 0.6], "target": [-0.1, 0, 0.1], "fov": 1.0}\n\n\n',
    ),
    "a list of eyes": _hook(
        """\
        return [
            CameraConfig("cam", sapien_utils.look_at(EYES[0], [0, 0, 0]), 128, 128, 1.0),
            CameraConfig("other", sapien_utils.look_at(EYES[1], [0, 0, 0]), 128, 128, 1.0),
        ]
        """,
        before="EYES = [[0.3, 0, 0.6], [0.3, 0.5, 0.6]]\n\n\n",
    ),
    "arithmetic with a height": _hook(
        """\
        eye = [0.3, 0, TABLE + 0.6]
        pose = sapien_utils.look_at(eye=eye, target=[-0.1, 0, TABLE - 0.1])
        return [CameraConfig("cam", pose, 128, 128, 2 * np.arctan(0.5))]
        """,
        before="TABLE = 0.2\n\n\n",
    ),
    "arrays that are added": _hook(
        """\
        eye = CENTRE + np.array([0.3, 0, 0.5])
        return [CameraConfig("cam", sapien_utils.look_at(eye, CENTRE), 128, 128, 1.0)]
        """,
        before="CENTRE = np.array([0.0, 0.1, 0.1])\n\n\n",
    ),
    "tensors": _hook(
        """\
        eye, target = torch.tensor([0.3, 0, 0.6]), torch.tensor([-0.1, 0, 0.1])
        return [CameraConfig("cam", sapien_utils.look_at(eye, target), 128, 128, 1.0)]
        """
    ),
    "a dict of cameras": _hook(
        """\
        return {
            "cam": CameraConfig("cam", sapien_utils.look_at([0.3, 0, 0.6], [0, 0, 0]), 128, 128, 1.0),
            "other": CameraConfig("other", sapien.Pose([0, 0, 1]), 128, 128, 1.0),
        }
        """
    ),
    "configs in variables": _hook(
        """\
        room = CameraConfig("cam", sapien_utils.look_at([2.5, -2.5, 3], [0.0, 0.0, 0]), 512, 512, 1)
        robot_pose = sapien_utils.look_at([2, 0, 1], [0, 0, -1])
        robot = CameraConfig("robot", robot_pose, 512, 512, 1.5, 0.01, 100, mount=self.camera_link)
        return [room, robot]
        """
    ),
    "branches with other values": _hook(
        """\
        if self.robot_uids == "fetch":
            return []
        if self.robot_uids == "panda":
            pose = sapien_utils.look_at([0.4, 0.4, 0.8], [0.0, 0.0, 0.4])
        else:
            pose = sapien_utils.look_at([0, 10, -3], [0, 0, 0])
        return CameraConfig("cam", pose, 512, 512, 1, 0.01, 100)
        """
    ),
    "a variable reused for a second camera": _hook(
        """\
        pose = sapien_utils.look_at([0.3, 0, 0.6], [0, 0, 0])
        first = CameraConfig("cam", pose, 128, 128, 1.0)
        pose = sapien_utils.look_at([0.3, 0.6, 0.6], [0, 0, 0])
        second = CameraConfig("other", pose, 128, 128, 1.0)
        return [first, second]
        """
    ),
    "its uid is a constant": _hook(
        "return [CameraConfig(NAME, sapien.Pose([0.5, 0, 0.5]), 128, 128, 1.0)]\n",
        before='NAME = "cam"\n\n\n',
    ),
    "remarks within look_at": _hook(
        """\
        pose = sapien_utils.look_at(
            # above the table
            eye=[
                0.3,  # towards the robot
                0,
                0.6,
            ],
            target=TARGET,  # the cube
        )
        return [CameraConfig("cam", pose, 128, 128, 1.0)]
        """,
        before="TARGET = [-0.1, 0, 0.1]  # read once\n\n\n",
    ),
    "another up": _hook(
        """\
        pose = sapien_utils.look_at([0, 0, 1.5], [0.2, 0, 0], up=[1, 0, 0])
        return [CameraConfig("cam", pose, 128, 128, 1.0)]
        """
    ),
    "straight down, as upstream gets it wrong": _hook(
        """\
        pose = sapien_utils.look_at(eye=[0, 0, 1.2], target=[0, 0, 0])
        return [CameraConfig("cam", pose, 128, 128, 1.0)]
        """
    ),
    "almost straight down": _hook(
        """\
        pose = sapien_utils.look_at(eye=[0, 0, 1.2], target=[0.01, 0, 0])
        return [CameraConfig("cam", pose, 128, 128, 1.0)]
        """
    ),
    "tabs and parentheses": _hook(
        """\
        return (
            [CameraConfig("cam", pose=(sapien.Pose(p=((0.5), 0, (.5)))), width=(128), height=128, fov=(1.0))]
        )
        """
    ).replace("    ", "\t"),
    "non-ASCII letters": _hook(
        """\
        größe = 128  # Größe — 像素
        return [CameraConfig("cam", sapien.Pose([0.5, 0, 0.5]), größe, größe, 1.0)]  # kamera ✓
        """
    ),
    "a starred import": _hook(
        """\
        pose = look_at(eye=[0.3, 0, 0.6], target=[-0.1, 0, 0.1])
        return [CameraConfig("cam", pose, 128, 128, 1.0)]
        """,
        before="from mani_skill.utils.sapien_utils import *\n\n\n",
    ),
    "more arguments by **": _hook(
        """\
        common = dict(near=0.01, far=10)
        pose = sapien_utils.look_at(eye=[0.3, 0, 0.6], target=[-0.1, 0, 0.1])
        return [CameraConfig("cam", pose, 128, 128, fov=1.0, **common)]
        """
    ),
    "a pose of the class for two cameras": _hook(
        """\
        return [CameraConfig("cam", self.POSE, 64, 64, 1.0), CameraConfig("other", Task.POSE, 64, 64, 1.0)]
        """,
        members="EYE = (0.3, 0, 0.6)\nPOSE = sapien_utils.look_at(EYE, [0, 0, EYE[2] / 2])\n",
    ),
    "made by a method": _hook(
        "return [self.camera()]\n",
        members=(
            "def camera(self):\n"
            "    try:\n"
            "        eye = [0.3, 0, 0.6]\n"
            "    except ValueError:\n"
            "        eye = [0.5, 0, 0.6]\n"
            '    return CameraConfig("cam", sapien_utils.look_at(eye, target=[0, 0, 0]), 64, 64, fov := 1.0)\n'
        ),
    ).replace("fov := 1.0", "(1.0)"),
    "a function within the hook": _hook(
        """\
        height = 0.6
        target = [0, 0, 0]

        def camera():
            return CameraConfig("cam", pose=sapien_utils.look_at(target=target, eye=[0.3, 0, height]),
                                width=64, height=64, fov=1.0, near=.01)

        return [camera()]
        """
    ),
    "two branches with the same values": _hook(
        """\
            if self.robot_uids == "panda":
                return [CameraConfig("cam", sapien_utils.look_at([0.3, 0, 0.6], [0, 0, 0]), 128, 128, 1.0)]
            return [CameraConfig("cam", sapien_utils.look_at([0.3, 0, 0.6], [0, 0, 0]), 128, 128, 1.0)]
            """
    ),
}

REFUSED: dict[str, tuple[str, str]] = {
    "a loop with a plain name": (
        _hook(
            """\
            for height in (0.4, 0.6):
                camera = CameraConfig("cam", sapien_utils.look_at([0.3, 0, 0.6], [0, 0, 0]), 128, 128, 1.0)
            return [camera]
            """
        ),
        "loop",
    ),
    "a comprehension": (
        _hook('return [CameraConfig("cam", sapien.Pose([0.5, 0, z]), 128, 128, 1.0) for z in (0.5,)]\n'),
        "comprehension",
    ),
    "a pose that is computed": (
        _hook(
            """\
            pose = sapien.Pose([0.3, 0, 0.6]) * sapien.Pose(q=euler2quat(0, 1, 0))
            return [CameraConfig("cam", pose, 128, 128, 1.0)]
            """
        ),
        "computed when the task runs",
    ),
    "a helper with parameters": (
        _hook(
            """\
            return [camera("cam", [0.3, 0, 0.6])]
            """,
            before=(
                "def camera(uid, eye):\n"
                '    return CameraConfig("cam", sapien_utils.look_at(eye, [0, 0, 0]), 128, 128, 1.0)\n\n\n'
            ),
        ),
        "a parameter of camera",
    ),
    "changed afterwards": (
        _hook(
            """\
            config = CameraConfig("cam", sapien_utils.look_at([0.3, 0, 0.6], [0, 0, 0]), 128, 128, 1.0)
            config.pose = Pose.create(sapien.Pose([0.5, 0, 0.5]))
            config.fov = 1.3
            return [config]
            """
        ),
        "something else changes it",
    ),
    "a table by the robot's name": (
        _hook(
            """\
            return [CameraConfig("cam", sapien_utils.look_at(EYES[self.robot_uids], [0, 0, 0]), 128, 128, 1.0)]
            """,
            before='EYES = {"panda": [0.3, 0, 0.6]}\n\n\n',
        ).replace('    robot_uids = "panda"', '    robot_uids = str("panda")'),
        "only the running task has",
    ),
    "a custom look_at": (
        _hook(
            """\
            return [CameraConfig("cam", look_at([0.3, 0, 0.6], [0, 0, 0]), 128, 128, 1.0)]
            """,
            before=(
                "def look_at(eye, target):\n    return sapien_utils.look_at(eye, [*target[:2], 0.1])\n\n\n"
            ),
        ),
        "computed when the task runs",
    ),
    "set in two places": (
        _hook(
            """\
            self.eye = [0.3, 0, 0.6]
            return [CameraConfig("cam", sapien_utils.look_at(self.eye, [0, 0, 0]), 128, 128, 1.0)]
            """,
            members="def __init__(self):\n    self.eye = [0.3, 0, 0.7]\n",
        ),
        "Task.__init__",
    ),
}
