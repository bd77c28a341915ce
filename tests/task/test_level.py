"""The changes in a save and the reload level they need: on the example task, and on difficult code."""

from __future__ import annotations

import re
import sys
import textwrap
import types
from pathlib import Path

import pytest
from mani_skill.envs.sapien_env import BaseEnv

from workbench.task.reload_level import Change, Inherited, find_change, inherited_names, removed_effects

FILE = "/author/task.py"
PUSH_CUBE = (Path(__file__).parents[2] / "tasks" / "push_cube.py").read_text()
BASE_ENV = Inherited(
    frozenset(
        (
            "__init__ _load_agent _load_scene _load_lighting _initialize_episode evaluate compute_dense_reward "
            "compute_normalized_dense_reward _get_obs_extra _default_sensor_configs _after_control_step step "
            "_default_human_render_camera_configs SUPPORTED_ROBOTS SUPPORTED_REWARD_MODES agent"
        ).split()
    )
)


def change(
    old: str, new: str, class_name: str = "Task", inherited: Inherited = BASE_ENV, **more: str
) -> Change:
    beside = {f"/author/{name}.py": text for name, text in more.items()}
    return find_change({FILE: old, **beside}, {FILE: new, **beside}, FILE, class_name, inherited)


def of_push_cube(old: str, new: str) -> Change:
    assert PUSH_CUBE.count(old) >= 1, old
    return change(PUSH_CUBE, PUSH_CUBE.replace(old, new, 1), "PushCubeEnv")


@pytest.mark.parametrize(
    ("old", "new", "level", "says"),
    [
        ("# Ahead of the cube", "# Before the cube", "same", ""),
        ('"""Push the blue cube', '"""Shove the blue cube', "same", "docstrings"),
        (
            "reach = 1 - torch.tanh(5 * distance)",
            "reach = 1 - torch.tanh(9 * distance)",
            "patched",
            "dense_reward",
        ),
        ('"cube_height": height', '"height": height', "patched", "only evaluate changed"),
        ('obs["cube_pose"]', 'obs["pose_of_cube"]', "patched", "_get_obs_extra"),
        ("2 * torch.rand((b, 2)) - 1", "torch.rand((b, 2)) - 1", "patched", "seen from the next reset on"),
        ("SPAWN_HALF_WIDTH = 0.1", "SPAWN_HALF_WIDTH = 0.2", "patched", "SPAWN_HALF_WIDTH"),
        (
            "    def evaluate(self)",
            "    def more(self):\n        return 1\n\n    def evaluate(self)",
            "patched",
            "no hook",
        ),
        ("import torch\n", "import torch\nimport math\n", "patched", "math"),
        ("eye=[0.45, 0, 0.6]", "eye=[0.45, 0, 0.7]", "cameras", "_default_sensor_configs"),
        ("width=512, height=512", "width=256, height=256", "cameras", "_default_human_render"),
        ("CUBE_HALF_SIZE = 0.02", "CUBE_HALF_SIZE = 0.03", "rebuilt", "_load_scene uses"),
        ("base_color=[0.05,", "base_color=[0.5,", "rebuilt", "_load_scene changed"),
        ("p=[-0.615, 0, 0]", "p=[-0.6, 0, 0]", "rebuilt", "_load_agent changed"),
        ("max_episode_steps=50", "max_episode_steps=60", "rebuilt", "PushCubeEnv changed"),
        ('SUPPORTED_ROBOTS = ["panda"', 'SUPPORTED_ROBOTS = ["fetch"', "rebuilt", "SUPPORTED_ROBOTS"),
        (
            "self.robot_init_qpos_noise = robot",
            "self.robot_init_qpos_noise = 2 * robot",
            "rebuilt",
            "__init__",
        ),
        ("(BaseEnv):", "(BaseEnv, object):", "rebuilt", "PushCubeEnv changed"),
        ("def compute_normalized_dense_reward", "def compute_normalised", "rebuilt", "reward mode"),
    ],
)
def test_an_edit_of_the_example_gets_its_level(old: str, new: str, level: str, says: str) -> None:
    found = of_push_cube(old, new)
    assert found.level == level, found.reason
    assert says in found.reason


def test_two_edits_are_reported_separately_and_get_the_heavier_level() -> None:
    new = PUSH_CUBE.replace("torch.tanh(5 * distance)", "torch.tanh(6 * distance)").replace(
        "eye=[0.45,", "eye=[0.5,"
    )
    found = change(PUSH_CUBE, new, "PushCubeEnv")
    assert found.level == "cameras"
    assert "compute_dense_reward" in found.reason and "_default_sensor_configs" in found.reason


def task(body: str, top: str = "") -> str:
    """The text of a file with a task class with this body, and `top` above the class."""
    head = (
        "import functools\nimport numpy as np\nimport torch\nfrom mani_skill.envs.sapien_env import BaseEnv\n"
    )
    return f"{head}{textwrap.dedent(top)}\n\nclass Task(BaseEnv):\n{textwrap.indent(textwrap.dedent(body), '    ')}"


REWARD = """
def _load_scene(self, options):
    self.cube = self.scene.build()

def compute_dense_reward(self, obs, action, info):
    return {of} * info["distance"]
"""


def test_a_helper_of_the_reward_is_patched_and_one_also_used_by_the_scene_rebuilds() -> None:
    top = "def scaled(x):\n    return {} * x\n"
    body = REWARD.format(of="scaled(1)")
    assert change(task(body, top.format(1)), task(body, top.format(2))).level == "patched"
    shared = body.replace("self.scene.build()", "self.scene.build(scaled(3))")
    found = change(task(shared, top.format(1)), task(shared, top.format(2)))
    assert (found.level, found.reason) == ("rebuilt", "scaled changed, which _load_scene uses")


def test_references_are_followed_through_several_names() -> None:
    body = """
    def _load_scene(self, options):
        self.cube = self.scene.build(self._size())

    def _size(self):
        return SIZES["cube"]

    def evaluate(self):
        return {"big": self.cube.size > SIZES["cube"]}
    """
    top = "EDGE = {}\nSIZES = {{'cube': EDGE}}\n"
    found = change(task(body, top.format(1)), task(body, top.format(2)))
    assert found.level == "rebuilt" and "EDGE changed" in found.reason


def test_an_attribute_no_longer_written_but_still_read_rebuilds() -> None:
    body = "def _initialize_episode(self, env_idx, options):\n    {}\n\ndef evaluate(self):\n    return {{'g': self.goal}}\n"
    found = change(task(body.format("self.goal = 1")), task(body.format("pass")))
    assert found.level == "rebuilt" and "no longer writes goal" in found.reason


def test_a_changed_robot_of_the_file_rebuilds_though_no_code_names_it() -> None:
    top = "from mani_skill.agents.base_agent import BaseAgent\n\n\nclass Robot(BaseAgent):\n    uid = 'mine'\n    def reach(self):\n        return {}\n"
    body = "SUPPORTED_ROBOTS = ['mine']\ndef evaluate(self):\n    return {'r': self.agent.tcp}\n"
    assert change(task(body, top.format(1)), task(body, top.format(2))).level == "rebuilt"
    assert (
        change(task(body, top.format(1)), task(body.replace("'r'", "'s'"), top.format(1))).level == "patched"
    )


def test_reordered_enum_members_rebuild() -> None:
    members = "    A = enum.auto()\n", "    B = enum.auto()\n"
    body, head = (
        "def evaluate(self):\n    return {'m': Mode.A.value}\n",
        "import enum\n\n\nclass Mode(enum.Enum):\n",
    )
    found = change(task(body, head + "".join(members)), task(body, head + "".join(members[::-1])))
    assert found.level == "rebuilt" and "Mode" in found.reason


@pytest.mark.parametrize("members", ["    A = 1\n    B = 2\n", "    a: int\n    b: int\n"])
def test_another_order_of_members_that_only_the_scene_uses_rebuilds(members: str) -> None:
    head = "class Shape(Other):\n"
    body = "def _load_scene(self, options):\n    self.shape = Shape(1, 2)\n"
    lines = members.splitlines(keepends=True)
    found = change(task(body, head + "".join(lines)), task(body, head + "".join(lines[::-1])))
    assert found.level == "rebuilt" and "Shape" in found.reason
    assert change(task(body, head + members), task(body, head + members + "    # more\n")).level == "same"


def test_a_helper_module_beside_the_task_is_compared_too() -> None:
    texts = [
        {
            FILE: task(REWARD.format(of="far()"), "from beside import far\n"),
            "/author/beside.py": f"def far():\n    return {n}\n",
        }
        for n in (1, 2)
    ]
    found = find_change(texts[0], texts[1], FILE, "Task", BASE_ENV)
    assert (found.level, found.reason) == ("patched", "only far of beside.py changed")
    built = [{**t, FILE: t[FILE].replace("scene.build()", "scene.build(far())")} for t in texts]
    assert find_change(built[0], built[1], FILE, "Task", BASE_ENV).level == "rebuilt"


def test_a_name_used_by_a_library_class_while_building_rebuilds() -> None:
    body = "def _cube_color(self):\n    return {}\n"
    library = Inherited(BASE_ENV.names, frozenset({"_cube_color"}))
    assert change(task(body.format(1)), task(body.format(2)), inherited=library).level == "rebuilt"
    assert change(task(body.format(1)), task(body.format(2))).level == "patched"


@pytest.mark.parametrize("hook", ["self.cube.pose.p", "torch.rand(3)", "self._batched_episode_rng.uniform()"])
def test_cameras_that_depend_on_the_current_state_rebuild(hook: str) -> None:
    body = f"@property\ndef _default_sensor_configs(self):\n    return [Camera({hook}, {{}})]\n"
    assert change(task(body.replace("{}", "1")), task(body.replace("{}", "2"))).level == "rebuilt"


def test_a_file_that_cannot_be_read_is_no_error() -> None:
    assert change("def (", task("def evaluate(self):\n    return {}\n")).level == "rebuilt"
    assert change(task("x = 1\n"), "class Task(BaseEnv):\n    x = 1\n" + "\0").level == "rebuilt"
    assert change(task("x = 1\n"), task("x = 1\n") + "y = " + 3000 * "-" + "1\n").level == "rebuilt"


@pytest.mark.parametrize(
    ("statement", "has_one"),
    [
        ("torch.set_num_threads(8)", True),
        ("torch.backends.flag = True", True),
        ("np.seterr_of['all'] += 1", True),
        ("if SIZE:\n    torch.set_num_threads(8)", True),
        ("SIZE = max(1, 2)", False),
        ("import math", False),
    ],
)
def test_an_import_side_effect_missing_in_the_new_version_is_reported_at_its_line(
    statement: str, has_one: bool
) -> None:
    def removed(old: str, new: str) -> str:
        return removed_effects({FILE: old}, {FILE: new})

    base = task("x = 1\n", "SIZE = 1\n")
    old = f"{base}\n{statement}\n"
    line = base.count("\n") + 2
    assert removed(old, base) == (f"task.py:{line} ({statement.splitlines()[0]})" if has_one else "")
    assert removed(base, old) == removed(old, f"import re\n{old}") == removed(old, old) == ""


BESIDE = "def made():\n    return 1\n"


def changes_of(rows: str, **beside: str) -> dict[str, Change]:
    """The change of ``NN`` from 1 to 2 in each row's code, by the row: code of methods, or of the file above
    ``|``. In a row, ``;;`` ends a line and ``>`` begins a deeper one."""
    found: dict[str, Change] = {}
    for row in filter(None, map(str.strip, rows.strip().splitlines())):
        top, _, methods = row.rpartition("|")
        texts = [
            task(
                *(
                    re.sub("(?<=;;)>+", lambda deep: "    " * len(deep[0]), part)
                    .replace(";;", "\n")
                    .replace("NN", n)
                    for part in (methods, top)
                )
            )
            for n in "12"
        ]
        found[row] = change(texts[0], texts[1], "Task", BASE_ENV, **beside)
    return found


def levels_of(rows: str, **beside: str) -> dict[str, str]:
    return {row: found.level for row, found in changes_of(rows, **beside).items()}


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("def evaluate(self):;;>if not hasattr(self, 'w'):;;>>self.w = NN", "hasattr"),
        ("def evaluate(self):;;>if self.w is None:;;>>self.w = NN", "may keep"),
        ("def evaluate(self):;;>self.w = self.w or NN", "may keep"),
        ("def evaluate(self):;;>if self.done:;;>>return {};;>self.w = NN", "may keep"),
        ("def evaluate(self):;;>return self.kept.setdefault('w', NN)", "setdefault"),
        ("def evaluate(self):;;>new = torch.from_numpy(self.kept);;>if self.done:;;>>new[0] = NN", "may keep"),
        ("def evaluate(self):;;>new = torch.as_tensor(self.kept);;>if self.done:;;>>new[0] = NN", "may keep"),
        ("def evaluate(self):;;>new = torch.relu_(self.kept);;>if self.done:;;>>new[0] = NN", "may keep"),
        ("def evaluate(self):;;>new = self.kept[0];;>if self.done:;;>>new[0] = NN", "may keep"),
        ("def evaluate(self):;;>new = self._table();;>if self.done:;;>>new[0] = NN", "may keep"),
        ("@functools.lru_cache;;def table(self):;;>return NN;;def evaluate(self):;;>return self.table()", "lru_cache"),
        ("@functools.cached_property;;def table(self):;;>return NN;;def evaluate(self):;;>return self.table", "cached"),
        ("def evaluate(self, kept={}):;;>kept['w'] = NN;;>return kept", "default"),
        ("W = 0|def evaluate(self):;;>global W;;>W = NN", "W may be changed"),
        ("SEEN = {}|def evaluate(self):;;>SEEN['w'] = NN;;>return SEEN", "SEEN may be changed"),
        ("SEEN = [1]|def evaluate(self):;;>SEEN.append(NN)", "SEEN may be changed"),
        ("SEEN = [1]|def evaluate(self):;;>mine = SEEN;;>mine[0] = NN", "SEEN may be changed"),
        ("RNG = np.random.default_rng(0)|def evaluate(self):;;>return RNG.uniform() + NN", "RNG may be changed"),
        ("def evaluate(self):;;>return getattr(self, 'com' + 'pute')(NN)", "getattr"),
        ("def evaluate(self):;;>return eval('NN')", "eval"),
        ("class Mode:;;>A = 1|def evaluate(self):;;>return isinstance(self.x, Mode) + NN", "the class Mode"),
        ("def __init__(self):;;>super().__init__();;>self.w = self.first;;def evaluate(self):;;>self.first = NN", "super().__init__()"),
        # The function that keeps the value did not change.
        ("def _kept(self, w):;;>if self.w is None:;;>>self.w = w;;>return self.w;;def evaluate(self):;;>return self._kept(NN)", "_kept may keep"),
        ("def __getattr__(self, name):;;>return 1;;def evaluate(self):;;>return self.x + NN", "__getattr__"),
        ("from helpers import *|def evaluate(self):;;>return NN", "import *"),
    ],
)  # fmt: skip
def test_code_that_may_keep_the_old_version_alive_rebuilds_with_the_reason(row: str, says: str) -> None:
    (found,) = changes_of(row, helpers="def f():\n    return 1\n").values()
    assert found.level == "rebuilt" and says in found.reason, found


def test_a_write_that_later_calls_may_skip_rebuilds() -> None:
    ev = "def evaluate(self):"
    found = levels_of(
        f"""
        {ev};;>if self.f:;;>>self.w = NN
        {ev};;>while self.f:;;>>self.w = NN
        {ev};;>try:;;>>pass;;>except KeyError:;;>>self.w = NN
        {ev};;>try:;;>>self.w = NN;;>finally:;;>>pass
        {ev};;>match self.f:;;>>case 1:;;>>>self.w = NN
        {ev};;>for i in range(3):;;>>if i:;;>>>break;;>self.w = NN
        {ev};;>if self.f:;;>>raise ValueError;;>self.w = NN
        {ev};;>def inner():;;>>self.w = NN;;>return inner()
        {ev};;>del self.w;;>return NN
        {ev};;>if self.f:;;>>a, self.w = 1, NN
        {ev};;>if self.f:;;>>a, *self.w = 1, NN
        {ev};;>if self.f:;;>>for self.w in (1, NN):;;>>>pass
        {ev};;>if self.f:;;>>with open("x") as self.w:;;>>>return NN
        {ev};;>if self.f:;;>>self.w: int = NN
        {ev};;>if self.f:;;>>self.w += NN
        {ev};;>if self.f:;;>>self.w.add_(NN)
        {ev};;>if self.f:;;>>self.rows[0].append(NN)
        {ev};;>if self.f:;;>>torch.add(self.w, NN, out=self.w)
        {ev};;>if self.f:;;>>self.kept.update(a=NN)
        {ev};;>self.f and self.kept.append(NN)
        {ev};;>self.w = NN if self.f else 0
        {ev};;>yield NN
        {ev};;>return getattr(self, "w", NN)
        {ev};;>setattr(self, "w", NN)
        {ev};;>both = dict(a=self.kept);;>if self.f:;;>>both["a"]["x"] = NN
        {ev};;>mine = self.kept;;>if self.f:;;>>mine[0] = NN
        {ev};;>for mine in self.kept:;;>>if self.f:;;>>>mine[0] = NN
        {ev};;>with self.kept as mine:;;>>if self.f:;;>>>mine[0] = NN
        {ev};;>mine, k = self.kept;;>if self.f:;;>>mine[0] = NN
        {ev};;>mine: list = self.kept;;>if self.f:;;>>mine[0] = NN
        from beside import made|{ev};;>mine = made();;>if self.f:;;>>mine[0] = NN
        import beside|{ev};;>mine = beside.made();;>if self.f:;;>>mine[0] = NN
        from . import beside|{ev};;>mine = beside.made();;>if self.f:;;>>mine[0] = NN
        def made():;;>return 1|def evaluate(self, k=made()):;;>return NN
        def size():;;>return NN|{ev};;>if self.f:;;>>self.w = size()
        def _initialize_episode(self, env_idx, options):;;>if options.get("all"):;;>>print(NN)
        def _initialize_episode(self, env_idx, options):;;>if self.reconfigures:;;>>print(NN)
        """,
        beside=BESIDE,
    )
    assert {row: level for row, level in found.items() if level != "rebuilt"} == {} and len(found) == 37


def test_a_write_in_every_call_or_to_a_new_value_is_patched() -> None:
    ev = "def evaluate(self):"
    found = levels_of(
        f"""
        {ev};;>self.w = NN
        {ev};;>with torch.no_grad():;;>>self.w = NN
        {ev};;>for i in range(3):;;>>self.w = NN
        {ev};;>self.w.add_(NN);;>return self.w
        {ev};;>self.w[self.rows] = NN
        {ev};;>if self.f:;;>>w = NN;;>>return w
        {ev};;>return getattr(self, "w") + NN
        {ev};;>mine = self.kept.clone();;>if self.f:;;>>mine[0] = NN
        {ev};;>mine = np.zeros(3);;>if self.f:;;>>mine[0] = NN
        {ev};;>mine = [1, 2];;>if self.f:;;>>mine.append(NN)
        {ev};;>mine: list = [];;>if self.f:;;>>mine.append(NN)
        def evaluate(self, k=torch.zeros(1)):;;>return k + NN
        def compute_dense_reward(self, obs, action, info):;;>if self.f:;;>>info["w"] = NN
        @property;;def far(self):;;>return NN;;{ev};;>return self.far
        @staticmethod;;def far():;;>return NN;;{ev};;>return self.far()
        def _initialize_episode(self, env_idx, options):;;>if len(env_idx) > 3:;;>>print(NN)
        {ev};;>self.best = torch.maximum(self.best, self.d) + NN;;>return self.best
        {ev};;>out = {{}};;>if self.f:;;>>out["b"] = NN;;>return out
        def compute_dense_reward(self, obs, action, info):;;>r = torch.zeros(3);;>for i in (0, 1):;;>>if i:;;>>>r[i] = NN
        TABLE = [1.0, 2.0]|@torch.no_grad();;{ev};;>return TABLE[1] * NN
        def _get_obs_extra(self, info):;;>obs = super()._get_obs_extra(info);;>if self.f:;;>>obs["b"] = NN;;>return obs
        """,
        beside=BESIDE,
    )
    assert {row: level for row, level in found.items() if level != "patched"} == {} and len(found) == 21


def test_a_value_of_the_file_that_may_change_while_the_task_runs_rebuilds() -> None:
    ev = "def evaluate(self):"
    changes = levels_of(
        f"""
        KEPT = []|{ev};;>note(KEPT, NN)
        KEPT = {{}}|{ev};;>return {{"a": KEPT, "n": NN}}
        KEPT = []|{ev};;>self.mine = KEPT;;>return NN
        KEPT = [];;ALSO = KEPT|{ev};;>note(ALSO, NN)
        KEPT = dict()|{ev};;>note(x=KEPT, n=NN)
        KEPT = iter([1, 2])|{ev};;>return KEPT(NN)
        KEPT = [1]|{ev};;>del KEPT[0];;>return NN
        KEPT = {{1: 2}}|{ev};;>KEPT.setdefault(NN, 1)
        KEPT = {{1: 2}}|{ev};;>KEPT[1] += NN
        KEPT = (1, [])|{ev};;>note(KEPT, NN)
        KEPT = torch.zeros(3)|{ev};;>KEPT.add_(NN)
        KEPT = [i for i in range(3)]|{ev};;>KEPT.append(NN)
        {ev};;>Task.count = NN;;count = 0
        rows = [1];;{ev};;>self.rows.append(NN)
        rows = [1];;{ev};;>self.rows[0] = NN
        """
    )
    assert {row: level for row, level in changes.items() if level != "rebuilt"} == {} and len(changes) == 15
    stays = levels_of(
        f"""
        KEPT = [];;SIZE = len(KEPT)|{ev};;>return len(KEPT) + NN
        KEPT = [1, 2]|{ev};;>note(KEPT, NN)
        KEPT = [1, 2]|{ev};;>return KEPT[0] + NN
        KEPT = (1, 2)|{ev};;>return KEPT.index(NN)
        KEPT = []|{ev};;>return torch.tensor(KEPT) + NN
        KEPT = 3;;ALSO = KEPT|{ev};;>note(ALSO, NN)
        KEPT = np.pi|{ev};;>note(KEPT, NN)
        count = 0;;{ev};;>self.count = NN
        """
    )
    assert {row: level for row, level in stays.items() if level != "patched"} == {} and len(stays) == 8


@pytest.mark.parametrize(
    ("row", "level"),
    [
        # Other tasks of the file have no live env.
        ("class Other(BaseEnv):;;>def _load_scene(self, options):;;>>return NN|x = 1", "patched"),
        ("class Other(BaseEnv):;;>x = 1;;class More(Other):;;>def _load_scene(self, options):;;>>return NN|x = 1", "patched"),
        ("class Helper:;;>def size(self):;;>>return NN|def evaluate(self):;;>return {}", "rebuilt"),
        ("def size():;;>return NN|def evaluate(self):;;>return size()", "patched"),
        ("@note;;def size():;;>return NN|def evaluate(self):;;>return size()", "rebuilt"),
        ("compute_dense_reward = NN", "rebuilt"),
        ("_default_sensor_configs = [NN]", "rebuilt"),
        ("def __enter__(self):;;>return NN", "rebuilt"),
        ("def step(self, action):;;>return NN", "rebuilt"),
        ("def mine(self):;;>return NN", "patched"),
        ("def _before_control_step(self):;;>self.w = NN", "patched"),
        ("def __init__(self):;;>super().__init__();;>self.w = 1;;def evaluate(self):;;>return NN", "patched"),
        ("def __init__(self):;;>super().__init__();;>note();;def evaluate(self):;;>return NN", "rebuilt"),
        ("def __init__(self):;;>x = super().__init__();;def evaluate(self):;;>return NN", "rebuilt"),
        ("def __init__(self):;;>note();;>super().__init__();;def evaluate(self):;;>return NN", "patched"),
        # What another name leads to.
        ("def size():;;>return NN|def _load_scene(self, options):;;>getattr(self, 'size')", "rebuilt"),
        ("def size():;;>return NN|def _load_scene(self, options):;;>note('here.size')", "rebuilt"),
        ("SIZE = NN|def _load_scene(self, options: SIZE) -> SIZE:;;>pass", "patched"),
        ("SIZE = NN;;if note():;;>SIZE = 3|def evaluate(self):;;>return SIZE", "rebuilt"),
        ("def size():;;>return NN;;size = note(size)|def evaluate(self):;;>return size()", "rebuilt"),
        ("class Inner:;;>x = NN;;def evaluate(self):;;>return 1", "rebuilt"),
        ("import threading|def evaluate(self):;;>return NN", "patched"),
        ("def far():;;>import threading;;>return NN|def evaluate(self):;;>return far()", "rebuilt"),
        ("def evaluate(self):;;>return type('T', (), {}) or NN", "rebuilt"),
        ("def evaluate(self):;;>return type(self).__name__ + 'NN'", "patched"),
        ("if __name__ == '__main__':;;>note(NN)|x = 1", "same"),
        ("if __name__ == '__main__':;;>note(NN);;else:;;>note(3)|x = 1", "rebuilt"),
        ("note(NN)|x = 1", "rebuilt"),
        ("def evaluate(self):;;>'''NN'''", "same"),
        ("def evaluate(self):;;>'''NN''';;>return self.evaluate.__doc__", "patched"),
        # Cameras.
        ("@property;;def _default_sensor_configs(self):;;>return [NN];;def evaluate(self):;;>return self._sensors", "rebuilt"),
        ("@property;;def _default_sensor_configs(self):;;>return [self.near];;@property;;def near(self):;;>return NN", "cameras"),
        ("@property;;def _default_sensor_configs(self):;;>return [NN];;def evaluate(self):;;>return torch.rand(1)", "cameras"),
    ],
)  # fmt: skip
def test_what_may_have_built_the_env_decides_the_level(row: str, level: str) -> None:
    assert levels_of(row) == {row: level}


@pytest.mark.parametrize("head", ["(BaseEnv, metaclass=Meta)", "(BaseEnv)"])
def test_a_class_that_is_made_unusually_rebuilds(head: str) -> None:
    def text(n: int, decorator: str = "") -> str:
        return f"class Meta(type): pass\n{decorator}class Task{head}:\n    def evaluate(self):\n        return {n}\n"

    usual = head == "(BaseEnv)"
    assert change(text(1), text(2)).level == ("patched" if usual else "rebuilt")
    assert change(text(1, "@seal\n"), text(2, "@seal\n")).level == "rebuilt"
    register = "@register_env('A-v1')\n"
    assert change(text(1, register), text(2, register)).level == ("patched" if usual else "rebuilt")
    assert change("Task = note()\n", f"{text(2)}").level == "rebuilt"


def test_the_hooks_that_may_behave_differently_are_named() -> None:
    def hooks(old: str, new: str) -> tuple[frozenset[str], frozenset[str]]:
        found = of_push_cube(old, new)
        return found.hooks, found.tried_hooks

    assert hooks("5 * distance", "6 * distance") == (
        {"compute_dense_reward", "compute_normalized_dense_reward"},
        frozenset(),
    )
    assert hooks("2 * torch.rand((b, 2)) - 1", "torch.rand((b, 2)) - 1") == ({"_initialize_episode"},) * 2
    step = "def _after_control_step(self):\n    self.w = {}\n"
    found = change(task(step.format(1)), task(step.format(2)))
    assert found.hooks == found.tried_hooks == {"_after_control_step"}
    unchanged = change(PUSH_CUBE, PUSH_CUBE, "PushCubeEnv")
    assert unchanged.level == "same" and not unchanged.hooks and not unchanged.tried_hooks
    both = PUSH_CUBE.replace("2 * torch.rand((b, 2)) - 1", "torch.rand((b, 2))").replace(
        "eye=[0.45,", "eye=[0.5,"
    )
    assert change(PUSH_CUBE, both, "PushCubeEnv").hooks == {"_initialize_episode"}


def test_a_new_or_a_lost_reward_hook_rebuilds() -> None:
    one = "def compute_dense_reward(self, obs, action, info):\n    return 1\n"
    two = one + "def compute_sparse_reward(self, info):\n    return 1\n"
    for old, new in ((one, two), (two, one)):
        assert change(task(old), task(new)).level == "rebuilt"


def test_names_inherited_from_libraries_are_found_in_their_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    library, own = types.ModuleType("a_library"), types.ModuleType("an_author")
    library.__file__, own.__file__ = "/lib/a_library.py", FILE
    for module, text in (
        (library, LIBRARY),
        (own, "class Mine(Lib):\n    def _own(self):\n        self._own_use\n"),
    ):
        monkeypatch.setitem(sys.modules, module.__name__, module)
        vars(module).update({"BaseEnv": BaseEnv, "Lib": getattr(library, "Lib", None)})
        exec(compile(text, str(module.__file__), "exec"), vars(module))
    found = inherited_names(own.Mine, {FILE})
    assert {"_scene", "annotated", "of_class", "_load_scene", "step", "prop"} <= found.names
    assert "_own" not in found.names
    uses = {"by_method", "by_property", "by_setter", "by_static", "by_inner", "by_classmethod"}
    assert uses <= found.used_at_build and "_own_use" not in found.used_at_build
    assert "get_obs" not in found.used_at_build, "what BaseEnv itself uses"


LIBRARY = """
class Lib(BaseEnv):
    annotated: int
    def _scene(self):
        self.by_method
        return [lambda: self.by_inner]
    @property
    def prop(self):
        return self.by_property
    @prop.setter
    def prop(self, value):
        self.by_setter
    @staticmethod
    def of_static(x):
        x.by_static
    @classmethod
    def of_class(cls):
        cls.by_classmethod
"""
