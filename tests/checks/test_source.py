"""Rules of the class, its registration and its source, each with a task that breaks it and one that keeps it."""

from __future__ import annotations

from pathlib import Path

from tests.checks.checked import Checked, the_finding

REGISTERED = '@register_env("WorkbenchPushCube-v1", max_episode_steps=50)'
RESET = "            b = len(env_idx)\n"
EVALUATE = "        height = self.cube.pose.p[:, 2] - CUBE_HALF_SIZE\n"
BUILT = '        self.cube = builder.build(name="cube")\n'


def test_a_class_without_an_id(checked: Checked) -> None:
    finding = the_finding(checked("registered", (REGISTERED, "")))
    assert finding.code.startswith("class PushCubeEnv") and '@register_env("PushCube-v1"' in finding.message
    assert checked("versioned-id", (REGISTERED, "")).state == "not_applicable"


def test_an_id_without_a_version(checked: Checked) -> None:
    finding = the_finding(checked("versioned-id", ("WorkbenchPushCube-v1", "WorkbenchPushCube")))
    assert finding.code.startswith("@register_env") and "'WorkbenchPushCube-v1'" in finding.message


def test_no_time_limit(checked: Checked) -> None:
    finding = the_finding(checked("time-limit", (", max_episode_steps=50", "")))
    assert finding.code == '@register_env("WorkbenchPushCube-v1")'


def test_the_id_of_another_task(checked: Checked) -> None:
    finding = the_finding(checked("id-taken", ("WorkbenchPushCube-v1", "PushCube-v1")))
    assert "'PushCube-v1'" in finding.message


def test_robots_that_are_not_said(checked: Checked) -> None:
    line = 'SUPPORTED_ROBOTS = ["panda", "fetch"]'
    finding = the_finding(checked("supported-robots", (line, "")))
    assert "SUPPORTED_ROBOTS = ['panda']" in finding.message
    finding = the_finding(checked("supported-robots", (line, 'SUPPORTED_ROBOTS = ["fetch"]')))
    assert finding.code == 'SUPPORTED_ROBOTS = ["fetch"]' and "'panda'" in finding.message


def test_a_reward_mode_without_its_method(checked: Checked) -> None:
    finding = the_finding(
        checked("reward-modes", ("def compute_normalized_dense_reward", "def compute_norm_dense_reward"))
    )
    assert finding.code.startswith("SUPPORTED_REWARD_MODES")
    assert "('dense', 'sparse', 'none')" in finding.message
    finding = the_finding(checked("reward-modes", ('"normalized_dense", ', '"normalised_dense", ')))
    assert "'normalised_dense'" in finding.message


def test_a_typo_on_a_builder(checked: Checked) -> None:
    typo = (
        "builder.initial_pose = sapien.Pose(p=[0, 0, CUBE",
        "builder.inital_pose = sapien.Pose(p=[0, 0, CUBE",
    )
    finding = the_finding(checked("unknown-name", typo))
    assert finding.code.startswith("builder.inital_pose") and "Write 'initial_pose'." in finding.message


def test_methods_that_do_not_exist(checked: Checked) -> None:
    calls = "        if self.num_envs > 99:\n            self.{}\n"
    for call, write in (
        (
            "get_pairwise_contact_forces(self.cube, self.goal)",
            "Write self.scene.get_pairwise_contact_forces().",
        ),
        ("evalute()", "Write self.evaluate()."),
        ("scene.create_actor_bulder()", "Write self.scene.create_actor_builder()."),
    ):
        finding = the_finding(checked("unknown-name", (EVALUATE, EVALUATE + calls.format(call))))
        assert write in finding.message and finding.function == "evaluate"


def test_names_that_are_set_somewhere_or_asked_for_exist(checked: Checked) -> None:
    set_later = f"{RESET}            self.draw_goal = lambda: None\n            self.draw_goal()\n"
    asked = f"{RESET}            if hasattr(self, 'draw_goal'):\n                self.draw_goal()\n"
    for text in (set_later, asked):
        assert checked("unknown-name", (RESET, text)).state == "kept"


def test_random_numbers_that_no_seed_reaches(checked: Checked) -> None:
    for line, drawn in (
        ("x = np.random.rand()", "np.random.rand()"),
        ("x = np.random.default_rng().random()", "np.random.default_rng()"),
        ("import random; x = random.uniform(0, 1)", "random.uniform()"),
    ):
        finding = the_finding(checked("unseeded-random", (RESET, f"{RESET}            {line}\n")))
        assert finding.message.startswith(drawn) and "torch.rand" in finding.message
        assert finding.function == "_initialize_episode"
    finding = the_finding(
        checked("unseeded-random", (BUILT, f"{BUILT}        self.size = np.random.rand()\n"))
    )
    assert "_batched_episode_rng" in finding.message


def test_random_numbers_that_are_seeded_or_drawn_elsewhere(checked: Checked) -> None:
    seeded = f"{RESET}            x = np.random.RandomState(3).rand() + self._batched_episode_rng[0].rand()\n"
    assert checked("unseeded-random", (RESET, seeded)).state == "kept"
    script = "\ndef try_out():\n    return np.random.rand()\n"
    assert checked("unseeded-random", ("\n\n@register_env", f"{script}\n\n@register_env")).state == "kept"


def test_calls_of_one_backend(checked: Checked) -> None:
    for call, of in (
        ("self.scene._gpu_apply_all()", "GPU simulation only"),
        ("self.scene.px.gpu_fetch_rigid_dynamic_data()", "GPU simulation only"),
        ("self.scene.get_contacts()", "CPU simulation only"),
        ("self.cube._objs[0].pose", "CPU simulation only"),
    ):
        finding = the_finding(checked("backend-only-call", (EVALUATE, f"{EVALUATE}        {call}\n")))
        assert of in finding.message and finding.code == call


def test_calls_of_one_backend_behind_its_condition(checked: Checked) -> None:
    below = "        if self.gpu_sim_enabled:\n            self.scene._gpu_apply_all()\n"
    after = (
        "        if not self.gpu_sim_enabled:\n            return {}\n        self.scene._gpu_fetch_all()\n"
    )
    at_load = "        self.first = self.cube._objs[0].pose\n"
    edits = (EVALUATE, EVALUATE + below + after), (BUILT, BUILT + at_load)
    assert checked("backend-only-call", *edits).state == "kept"


def test_a_file_that_is_missing(checked: Checked) -> None:
    at = "        builder.add_box_collision("
    for written, named in (
        ('builder.add_visual_from_file("cup.glb")', "cup.glb"),
        ('builder.add_visual_from_file(filename=str(Path(__file__).parent / "cup.glb"))', "/cup.glb"),
        ('folder = os.path.dirname(__file__); x = os.path.join(folder, f"{MESH}.obj")', "/bowl.obj"),
    ):
        imports = (
            "import numpy as np",
            'import os\nfrom pathlib import Path\nimport numpy as np\nMESH = "bowl"',
        )
        finding = the_finding(checked("missing-file", imports, (at, f"        {written}\n{at}")))
        assert named in finding.message and finding.degree == "stop" and finding.function == "_load_scene"


def test_files_that_exist_or_are_made(checked: Checked, tmp_path: Path) -> None:
    (tmp_path / "cup.glb").write_bytes(b"")
    at = "        builder.add_box_collision("
    imports = "import numpy as np", "from pathlib import Path\nimport numpy as np"
    found = 'x = Path(__file__).parent / "cup.glb"'
    assert checked("missing-file", imports, (at, f"        {found}\n{at}")).state == "kept"
    made = 'if self.num_envs > 99:\n            open("log.csv", "w")\n        np.savez("made.npz")'
    assert checked("missing-file", imports, (at, f"        {made}\n{at}")).state == "kept"
    relative = 'if self.num_envs > 99:\n            builder.add_visual_from_file("cup.glb")'
    finding = the_finding(checked("missing-file", imports, (at, f"        {relative}\n{at}")))
    assert "a process starts anywhere" in finding.message


def test_a_download_that_is_not_declared(checked: Checked) -> None:
    imports = "import numpy as np", "from mani_skill import ASSET_DIR\nimport numpy as np"
    named = BUILT, f'{BUILT}        self.models = ASSET_DIR / "assets/mani_skill2_ycb/info_pick_v0.json"\n'
    finding = the_finding(checked("undeclared-assets", imports, named))
    assert "asset_download_ids=['ycb']" in finding.message and finding.code.startswith("self.models")
    declared = "max_episode_steps=50)", "max_episode_steps=50, asset_download_ids=['ycb'])"
    assert checked("undeclared-assets", imports, named, declared).state == "kept"
    optional = f'{BUILT}        if self.num_envs > 99:\n            self.models = "ycb:024_bowl"\n'
    assert checked("undeclared-assets", (BUILT, optional)).state == "kept"
