"""Rules for the class, its registration and its source, with mistakes that break them and code that only looks similar."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.checks.checked import EXAMPLE, Checked, check_rules, the_finding
from workbench.checks.results import RuleResult
from workbench.envs.gpu_rules import Finding

REGISTERED = '@register_env("WorkbenchPushCube-v1", max_episode_steps=50)'
RESET = "            b = len(env_idx)\n"
EVALUATE = "        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE\n"
BUILT = '        self.cube = builder.build(name="cube")\n'
IMPORTS = (
    "import numpy as np\n",
    (
        "import os\nimport random\nfrom pathlib import Path\n\nimport numpy as np\nfrom mani_skill import ASSET_DIR\n\n"
        'MESH = "bowl"\n'
    ),
)
NEVER = "if self.num_envs > 99: "
"""Prefix for code that is parsed by the check but never runs."""


def source_results(folder: Path, *edits: tuple[str, str]) -> dict[str, RuleResult]:
    """Results of all source rules on one text with all of these edits."""
    rules = ("versioned-id", "time-limit", "supported-robots", "reward-modes", "unknown-name", "unseeded-random",
             "backend-only-call", "missing-file", "undeclared-assets")  # fmt: skip
    text = EXAMPLE.read_text()
    for old, new in edits:
        assert old in text, old
        text = text.replace(old, new)
    (folder / "task.py").write_text(text)
    return check_rules(rules, str(folder / "task.py"), num_envs=2, seeds=1, render_backend="none")


@pytest.mark.parametrize(
    ("env_id", "advised"),
    [
        ("PushCup-v1.5", "PushCup-v1"),
        ("PushCup-v", "PushCup-v1"),
        ("PushCup-v2x", "PushCup-v2x-v1"),
        ("PushCup-v12", None),
    ],
)
def test_an_id_ends_in_a_version_that_is_a_whole_number(
    env_id: str, advised: str | None, checked: Checked
) -> None:
    result = checked("versioned-id", ("WorkbenchPushCube-v1", env_id))
    assert [repr(advised) in finding.message for finding in result.findings] == [True] * (advised is not None)


def lines(place: str, *statements: str) -> tuple[str, str]:
    """An edit that adds statements below the line `place`."""
    indent = place[: len(place) - len(place.lstrip())]
    return place, place + "".join(f"{indent}{statement}\n" for statement in statements)


def test_each_mistake_is_found_at_its_line(tmp_path: Path) -> None:
    (tmp_path / "lid.glb").write_bytes(b"")
    results = source_results(
        tmp_path,
        IMPORTS,
        ("    agent: Panda | Fetch\n", '    agent: Panda | Fetch\n    POT = "pot.glb"\n'),
        (REGISTERED, '@register_env("WorkbenchPushCube")'),
        ('SUPPORTED_ROBOTS = ["panda", "fetch"]', 'SUPPORTED_ROBOTS = ["fetch"]'),
        ('"normalized_dense", ', '"normalised_dense", '),
        lines(
            RESET, "x = np.random.rand()", "x = np.random.default_rng().random()", "x = random.uniform(0, 1)"
        ),
        lines(
            BUILT,
            "builder.inital_pose = 3",
            "self.size = np.random.rand()",
            f'{NEVER}builder.add_visual_from_file("cup.glb")',
            'x = str(Path(__file__).parent / "mug.glb")',
            'x = os.path.join(os.path.dirname(__file__), f"{MESH}.obj")',
            'x = Path(__file__).resolve().parents[0].joinpath("jug.glb")',
            'name = "pan" + ".glb"',
            f"{NEVER}builder.add_visual_from_file(filename=name)",
            "x = Path(__file__).parent / self.POT",
            f'{NEVER}builder.add_visual_from_file("lid.glb")',
            'self.models = ASSET_DIR / "assets/mani_skill2_ycb/info_pick_v0.json"',
        ),
        lines(
            EVALUATE,
            f"{NEVER}self.get_pairwise_contact_forces(self.cube, self.goal)",
            f"{NEVER}self.evalute()",
            f"{NEVER}self.scene.create_actor_bulder()",
            f"{NEVER}self.scene._gpu_apply_all()",
            f"{NEVER}self.scene.px.gpu_fetch_rigid_dynamic_data()",
            f"{NEVER}self.scene.get_contacts()",
            "self.cube._objs[0].pose",
        ),
    )

    def findings_by_code(rule: str) -> dict[str, Finding]:
        assert results[rule].state == "broken", results[rule]
        return {finding.code.removeprefix(NEVER): finding for finding in results[rule].findings}

    (code,) = findings_by_code("versioned-id")
    assert (
        code.startswith("@register_env")
        and "'WorkbenchPushCube-v1'" in findings_by_code("versioned-id")[code].message
    )
    assert [*findings_by_code("time-limit")] == ['@register_env("WorkbenchPushCube")']
    assert "'panda'" in findings_by_code("supported-robots")['SUPPORTED_ROBOTS = ["fetch"]'].message
    assert "'normalised_dense'" in next(iter(findings_by_code("reward-modes").values())).message
    for code, named in {
        "builder.inital_pose = 3": "initial_pose",
        "self.get_pairwise_contact_forces(self.cube, self.goal)": "self.scene.get_pairwise_contact_forces()",
        "self.evalute()": "self.evaluate()",
        "self.scene.create_actor_bulder()": "self.scene.create_actor_builder()",
    }.items():
        assert named in findings_by_code("unknown-name")[code].message
    drawn = findings_by_code("unseeded-random")
    assert drawn.keys() == {
        *("x = np.random.rand()", "x = np.random.default_rng().random()", "x = random.uniform(0, 1)"),
        "self.size = np.random.rand()",
    }
    assert "torch.rand" in drawn["x = np.random.rand()"].message
    assert "_batched_episode_rng" in drawn["self.size = np.random.rand()"].message
    backends = {
        code: "GPU" in finding.message.split("simulation only")[0]
        for code, finding in findings_by_code("backend-only-call").items()
    }
    assert backends == {
        "self.scene._gpu_apply_all()": True,
        "self.scene.px.gpu_fetch_rigid_dynamic_data()": True,
        "self.scene.get_contacts()": False,
        "self.cube._objs[0].pose": False,
    }
    missing = [finding.message for finding in results["missing-file"].findings]
    for name in ("cup.glb", "/mug.glb", "/bowl.obj", "/jug.glb", "pan.glb", "/pot.glb"):
        assert any(f"{name}." in one for one in missing), name
    # A file beside the task's is there only for who starts in its folder.
    assert (
        "Path(__file__).parent / 'lid.glb'"
        in findings_by_code("missing-file")['builder.add_visual_from_file("lid.glb")'].message
    )
    assert len(missing) == 7
    assert {finding.degree for finding in results["missing-file"].findings} == {"stop"}
    assert "asset_download_ids=['ycb']" in next(iter(findings_by_code("undeclared-assets").values())).message


def test_code_that_only_looks_like_a_mistake_is_not_reported(tmp_path: Path) -> None:
    (tmp_path / "cup.glb").write_bytes(b"")
    results = source_results(
        tmp_path,
        IMPORTS,
        ("max_episode_steps=50)", "max_episode_steps=50, asset_download_ids=['ycb'])"),
        lines(
            RESET,
            "self.draw_goal = lambda: None",
            "self.draw_goal()",
            "if hasattr(self, 'draw_more'): self.draw_more()",
            "x = np.random.RandomState(3).rand() + self._batched_episode_rng[0].rand()",
        ),
        lines(
            BUILT,
            "builder.colour = 3",
            "self.colour = builder.colour",
            "self.first = self.cube._objs[0].pose",
            'x = Path(__file__).parent / "cup.glb"',
            f'{NEVER}open("log.csv", "w")',
            'self.models = ASSET_DIR / "assets/mani_skill2_ycb/info_pick_v0.json"',
            'x = 3 if self.num_envs < 99 else ASSET_DIR / "tasks/partnet_mobility/dataset/1.urdf"',
        ),
        lines(
            EVALUATE,
            "if self.gpu_sim_enabled: self.scene._gpu_apply_all()",
            "self.gpu_sim_enabled and self.scene._gpu_fetch_all()",
            "x = None if not self.gpu_sim_enabled else self.scene._gpu_fetch_all()",
            "if self.num_envs > 99: self.on_gpu(), self.on_gpu_only()",
        ),
        (
            "    def evaluate(self)",
            "    def on_gpu(self):\n        if not self.gpu_sim_enabled:\n            return\n        self.scene._gpu_apply_all()\n\n"
            "    def on_gpu_only(self):\n        assert self.gpu_sim_enabled\n        self.scene._gpu_apply_all()\n\n"
            "    def evaluate(self)",
        ),
        ("\n\n@register_env", "\ndef try_out():\n    return np.random.rand()\n\n\n@register_env"),
    )
    assert {rule: result.findings for rule, result in results.items() if result.findings} == {}


def test_a_call_after_a_guard_that_ends_nothing_is_reported(tmp_path: Path) -> None:
    guard = "    def on_gpu(self):\n        if not self.gpu_sim_enabled:\n            pass\n        self.scene._gpu_apply_all()\n\n"
    results = source_results(
        tmp_path,
        ("    def evaluate(self)", f"{guard}    def evaluate(self)"),
        lines(EVALUATE, f"{NEVER}self.on_gpu()"),
        (
            "    def compute_normalized_dense_reward",
            "    def get_reward(self, **k): ...\n\n    def compute_normalized",
        ),
        ('"normalized_dense", ', '"normalised_dense", '),
    )
    finding = the_finding(results["backend-only-call"])
    assert finding.function == "on_gpu" and results["reward-modes"].state == "not_applicable"


def test_a_class_without_an_id_and_with_another_tasks_id(checked: Checked) -> None:
    finding = the_finding(checked("registered", (REGISTERED, "")))
    assert finding.code.startswith("class PushCubeEnv") and '@register_env("PushCube-v1"' in finding.message
    finding = the_finding(checked("id-taken", ("WorkbenchPushCube-v1", "PushCube-v1")))
    assert "'PushCube-v1'" in finding.message


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (('SUPPORTED_ROBOTS = ["panda", "fetch"]', ""), "SUPPORTED_ROBOTS = ['panda']"),
        (
            ("def compute_normalized_dense_reward", "def compute_norm_dense_reward"),
            "('dense', 'sparse', 'none')",
        ),
    ],
)
def test_a_missing_robot_or_reward_mode_is_named_with_a_fix(
    checked: Checked, edit: tuple[str, str], named: str
) -> None:
    rule = "supported-robots" if "ROBOTS" in edit[0] else "reward-modes"
    assert named in the_finding(checked(rule, edit)).message
