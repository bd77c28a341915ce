"""Loading a task class, repeatedly; a failed load leaves the process unchanged."""

from __future__ import annotations

import gc
import inspect
import os
import platform
import sys
import traceback
import weakref
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import pytest
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.utils.registration import REGISTERED_ENVS

from tests.task.refusal import refused
from tests.task.registered import registered
from workbench.task.load import load_task, undo_load, with_late_imports

pytestmark = pytest.mark.thorough

Write = Callable[..., Path]

PUSH = """
@register_env("AuthorPush-v1", max_episode_steps=7, some_default=3)
class PushEnv(BaseEnv):
    goal_radius = 0.1

    def evaluate(self):
        return {}
"""


def test_a_file_gives_its_class_and_its_registration(write: Write) -> None:
    path = write("push.py", PUSH, task=True)
    task = load_task(str(path))
    assert (task.env_id, task.class_name, task.max_episode_steps) == ("AuthorPush-v1", "PushEnv", 7)
    assert task.default_kwargs == {"some_default": 3}
    assert (task.file, task.source_files, task.followed) == (path, (path,), True)
    assert task.source == {str(path): path.read_text()}
    assert len(task.source_hash) == 12
    assert (task.others, task.replaced) == ((), ())
    assert gym.spec("AuthorPush-v1").max_episode_steps == 7
    assert sys.modules[task.cls.__module__].__file__ == str(path)


def test_a_registered_id_gives_the_built_in_class_and_its_source() -> None:
    task = load_task("PickCube-v1")
    assert task.cls is REGISTERED_ENVS["PickCube-v1"].cls
    assert (task.class_name, task.max_episode_steps, task.followed) == ("PickCubeEnv", 50, False)
    assert task.file is not None and task.file.name == "pick_cube.py"
    assert "class PickCubeEnv" in task.source[str(task.file)]


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("PikCube-v1", "PickCube-v1"),
        ("CartPole-v1", "gymnasium"),
        ("", "no task named"),
        ("nowhere/push.py", "nor does its folder"),
        ("push.py:", "after the colon"),
        ("bad\0name.py", "not a path"),
        (os.devnull, "not an ordinary file"),
    ],
)
def test_a_wrong_reference_is_refused_with_a_message(reference: str, words: str) -> None:
    problem = refused(reference)
    assert words in problem.message
    assert (problem.stage, problem.line) == ("import", None)
    assert len(problem.message) <= 500


def test_the_last_registered_class_is_loaded_and_the_others_are_named(write: Write) -> None:
    path = write(
        "push.py",
        """
        class Base(BaseEnv):
            pass

        @register_env("AuthorOne-v1")
        class One(Base):
            pass

        @register_env("AuthorTwo-v1")
        class Two(Base):
            pass

        class Later(Base):
            pass

        NotATask = int
        """,
        task=True,
    )
    task = load_task(str(path))
    assert task.env_id == "AuthorTwo-v1"
    assert set(task.others) == {"Base", "Later", "One"}
    assert load_task(f"{path}:One").env_id == "AuthorOne-v1"
    unregistered = load_task(f"{path}:Later")
    assert (unregistered.env_id, unregistered.max_episode_steps) == ("Later", None)
    assert "did you mean Later?" in refused(f"{path}:Latr").message
    assert "not a class that inherits BaseEnv" in refused(f"{path}:NotATask").message
    assert "One" in refused(f"{path}:Zebra").message


def test_a_file_without_a_task_says_what_it_has_instead(write: Write) -> None:
    head = "from mani_skill.agents.robots import Panda\nfrom mani_skill.envs.tasks import PushCubeEnv\n"
    messages = {
        text: refused(write("odd.py", text)).message
        for text in ("# later\n\n", "x = 1\n", head, f"{head}class Arm(Panda):\n    uid = 'arm'\n")
    }
    empty, other, imported, robot = messages.values()
    assert len({*messages.values()}) == 4 and "PushCubeEnv" in imported and "Arm" in robot
    assert "PushCubeEnv" not in robot + empty + other and "Panda" not in imported


def test_the_classes_to_try_next_are_of_the_same_kind_and_no_bases(write: Write) -> None:
    path = write(
        "push.py",
        """
        class Base(BaseEnv): pass
        class Loose(BaseEnv): pass
        @register_env("AuthorOne-v1")
        class One(Base): pass
        @register_env("AuthorTwo-v1")
        class Two(Base): pass
        @register_env("AuthorThree-v1")
        class Three(One): pass
        """,
        task=True,
    )
    assert load_task(str(path)).alternatives == ("Two",)
    assert load_task(f"{path}:Three").alternatives == ()
    path.write_text(path.read_text().split("@register_env")[0] + "class Last(Base): pass\n")
    again = load_task(str(path))
    assert (again.class_name, again.alternatives) == ("Last", ("Loose",))
    assert again.chosen == "Last" and again.others == ("Base", "Loose")


def test_assets_of_a_registration_belong_to_the_task(write: Write) -> None:
    registered = PUSH.replace("some_default=3", 'asset_download_ids=["ycb"]')
    assert load_task(str(write("push.py", registered, task=True))).asset_ids == ("ycb",)
    assert load_task("PickCube-v1").asset_ids == ()


def test_a_class_registered_with_gymnasium_alone_has_its_id_and_limit(write: Write) -> None:
    text = "import gymnasium\nclass Lone(BaseEnv):\n    pass\ngymnasium.register('Lone-v3', entry_point=Lone, max_episode_steps=11, kwargs={'a': 1})\n"
    try:
        task = load_task(str(write("lone.py", text, task=True)))
    finally:
        gym.registry.pop("Lone-v3", None)
    assert (task.env_id, task.max_episode_steps, task.default_kwargs) == ("Lone-v3", 11, {"a": 1})


def test_a_class_of_an_installed_module_is_opened_but_not_followed() -> None:
    task = load_task("mani_skill.envs.tasks.tabletop.push_cube:PushCubeEnv")
    assert (task.env_id, task.class_name, task.followed) == ("PushCube-v1", "PushCubeEnv", False)
    for wrong in ("mani_skill.envs.tasks.tabletop.push_cube:PushCubEnv", "no_such_module_x:Task"):
        refused(wrong)
    assert "PushCubeEnv" in refused("mani_skill.envs.tasks.tabletop.push_cube:PushCubEnv").message


# --- saved again ---------------------------------------------------------------------------------


def test_two_saves_of_the_same_size_within_a_second_are_two_versions(write: Write) -> None:
    path = write("push.py", PUSH, task=True)
    helper = write("helper.py", "WIDTH = 0\n")
    path.write_text("import helper\n" + path.read_text())
    stamp = path.stat()
    for number in range(5):
        helper.write_text(f"WIDTH = {number}\n")
        path.write_text(
            path.read_text().replace("0.1", f"0.{number}").replace(f"0.{number - 1}", f"0.{number}")
        )
        for file in (path, helper):
            os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        task = load_task(str(path))
        assert task.cls.goal_radius == number / 10  # type: ignore[attr-defined]
        assert sys.modules["helper"].WIDTH == number
    assert not (path.parent / "__pycache__").exists()


def test_the_registries_hold_the_new_version_and_no_dropped_id(write: Write) -> None:
    path = write("push.py", PUSH, task=True)
    first = load_task(str(path)).cls
    second = load_task(str(path))
    assert second.cls is not first
    assert REGISTERED_ENVS["AuthorPush-v1"].cls is second.cls
    assert second.replaced == ()
    # gymnasium refuses a versioned id while the unversioned one is registered, and the reverse.
    for env_id in ("AuthorPush", "AuthorPush-v2", "AuthorPush"):
        path.write_text(path.read_text().replace("AuthorPush-v1", env_id).replace("AuthorPush-v2", env_id))
        path.write_text(path.read_text().replace('"AuthorPush"', f'"{env_id}"'))
        task = load_task(str(path))
        assert (
            [name for name in REGISTERED_ENVS if name.startswith("AuthorPush")] == [task.env_id] == [env_id]
        )


def test_a_built_in_id_is_overridden_and_restored(write: Write) -> None:
    built_in = REGISTERED_ENVS["PickCube-v1"].cls
    path = write("push.py", PUSH.replace("AuthorPush-v1", "PickCube-v1"), task=True)
    task = load_task(str(path))
    assert REGISTERED_ENVS["PickCube-v1"].cls is task.cls
    assert gym.spec("PickCube-v1").max_episode_steps == 7
    assert [one.name for one in task.replaced] == ["PickCube-v1"]
    path.write_text(path.read_text().replace("PickCube-v1", "AuthorPush-v1"))
    load_task(str(path))
    assert REGISTERED_ENVS["PickCube-v1"].cls is built_in
    assert gym.spec("PickCube-v1").max_episode_steps == 50


def test_an_agent_in_the_file_is_replaced_by_a_save(write: Write) -> None:
    robot = """
    from mani_skill.agents.registration import register_agent
    from mani_skill.agents.robots import Panda

    @register_agent()
    class Robot(Panda):
        uid = "author_robot"
        fingers = 2
    """
    helper = write("robot.py", robot)
    path = write("push.py", "import robot\n" + PUSH, task=True)
    load_task(str(path))
    helper.write_text(helper.read_text().replace("fingers = 2", "fingers = 3"))
    load_task(str(path))
    assert REGISTERED_AGENTS["author_robot"].agent_cls.fingers == 3  # type: ignore[attr-defined]


# --- modules beside the file ---------------------------------------------------------------------


def test_edited_helpers_are_reloaded_wherever_they_are(write: Write) -> None:
    helpers = {
        "shapes.py": "from shapes import SIZE as a",
        "parts/__init__.py": "from parts import SIZE as b",
        "parts/arm.py": "from parts.arm import SIZE as c",
        "loose/leg.py": "from loose import leg; d = leg.SIZE",
        "new_helper.py": "from new_helper import SIZE as e",
    }
    path = write("push.py", "\n".join(helpers.values()) + "\n" + PUSH, task=True)
    for number in (1, 2, 3):
        for name in helpers:
            write(name, f"SIZE = {number}\n")
        task = load_task(str(path))
        module = sys.modules[task.cls.__module__]
        assert [getattr(module, name) for name in "abcde"] == [number] * 5
    assert set(task.source_files) == {path, *(path.parent / name for name in helpers)}
    assert task.source_files[0] == path
    write("shapes.py", "SIZE = 4\n")
    assert load_task(str(path)).source_hash != task.source_hash


def test_a_helper_of_another_tasks_folder_is_not_used(write: Write) -> None:
    write("one/helper.py", "WHERE = 1\n")
    write("two/helper.py", "WHERE = 2\n")
    text = "from helper import WHERE\n"
    one = write("one/push.py", text + PUSH, task=True)
    two = write("two/pull.py", text + PUSH.replace("AuthorPush", "AuthorPull"), task=True)
    for path, where in ((one, 1), (two, 2), (one, 1)):
        task = load_task(str(path))
        assert sys.modules[task.cls.__module__].WHERE == where
    assert {"AuthorPush-v1", "AuthorPull-v1"} <= set(REGISTERED_ENVS)


def test_a_file_in_a_package_may_import_relatively(write: Write) -> None:
    write("project/__init__.py", "")
    write("project/common.py", "SIZE = 1\n")
    write("project/tasks/__init__.py", "from .push import PushEnv\n")
    helper = write("project/tasks/helper.py", "SIZE = 1\n")
    path = write(
        "project/tasks/push.py",
        "from ..common import SIZE\nfrom .helper import SIZE as OWN\n" + PUSH,
        task=True,
    )
    task = load_task(str(path))
    assert task.cls.__module__ == "project.tasks.push"
    helper.write_text("SIZE = 2\n")
    task = load_task(str(path))
    assert sys.modules["project.tasks.push"].OWN == 2
    assert sys.modules["project.tasks"].PushEnv is task.cls
    assert task.source_files[0] == path and helper in task.source_files


def test_a_module_imported_inside_a_hook_is_found_and_followed(write: Write) -> None:
    helper = write("late.py", "SIZE = 1\n")
    body = "    @staticmethod\n    def size():\n        import late\n        return late.SIZE\n"
    path = write("push.py", PUSH + body, task=True)
    task = load_task(str(path))
    assert task.source_files == (path,)
    assert task.cls.size() == 1  # type: ignore[attr-defined]
    later = with_late_imports(task)
    assert later.source_files == (path, helper)
    assert later.source_hash != task.source_hash
    helper.write_text("SIZE = 2\n")
    assert load_task(str(path)).cls.size() == 2  # type: ignore[attr-defined]


def test_given_texts_replace_files_on_disk_and_missing_files(write: Write) -> None:
    helper = write("helper.py", "SIZE = 1\n")
    lazy = write("lazy.py", "SIZE = 1\n")
    body = "    @staticmethod\n    def sizes():\n        import lazy\n        return helper.SIZE, lazy.SIZE\n"
    path = write("push.py", "import helper\n" + PUSH + body, task=True)
    task = load_task(str(path))
    task.cls.sizes()  # type: ignore[attr-defined]
    good = with_late_imports(task)
    path.write_text("broken(")
    helper.unlink()
    lazy.write_text("SIZE = 2\n")
    again = load_task(str(path), source=good.source)
    assert again.cls.sizes() == (1, 1)  # type: ignore[attr-defined]
    assert with_late_imports(again).source_hash == good.source_hash
    assert inspect.getsource(again.cls).startswith("@register_env")
    path.unlink()
    assert load_task(str(path), source=good.source).env_id == "AuthorPush-v1"


def test_files_with_crlf_a_byte_order_mark_or_a_coding_line_are_read_as_python_reads_them(
    write: Write,
) -> None:
    path = write("push.py", PUSH + '    name = "Würfel"\n', task=True)
    text = path.read_text()
    for raw in (
        text.replace("\n", "\r\n").encode(),
        b"\xef\xbb\xbf" + text.encode(),
        ("# -*- coding: latin-1 -*-\n" + text).encode("latin-1"),
    ):
        path.write_bytes(raw)
        task = load_task(str(path))
        assert task.cls.name == "Würfel"  # type: ignore[attr-defined]
        assert task.source[str(path)].endswith(text)


# --- a load that fails ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "stage", "message", "code"),
    [
        ("def f(:\n    pass\n", "syntax", "SyntaxError", "def f(:"),
        ("x = 1\n\n1 / 0\n", "import", "ZeroDivisionError: division by zero", "1 / 0"),
        ("def f():\n    raise ValueError\nf()\n", "import", "ValueError", "raise ValueError"),
        (
            "import no_such_module_anywhere\n",
            "import",
            "neither in the file's folder",
            "import no_such_module_anywhere",
        ),
        ("import healper\n", "import", "there is helper.py in the file's folder", "import healper"),
        (
            "from typing import gone\n",
            "import",
            f"Python {platform.python_version()}",
            "from typing import gone",
        ),
        ("exit()\n", "import", "__main__", "exit()"),
        ("def f(): f()\nf()\n", "import", "RecursionError", "def f(): f()"),
        ("import ast\nast.parse('1 +')\n", "import", "SyntaxError", "ast.parse('1 +')"),
        ("x = '\0'\n", "syntax", "null byte", None),
    ],
)
def test_an_error_in_the_file_is_reported_at_its_line(
    text: str, stage: str, message: str, code: str | None, write: Write
) -> None:
    write("helper.py", "SIZE = 1\n")
    problem = refused(write("push.py", text))
    assert problem.stage == stage
    assert message in problem.message
    assert problem.file is not None and problem.file.endswith("push.py")
    assert code is None or problem.code == code
    assert problem.line is not None
    assert "\n" not in problem.message
    assert "importlib" not in problem.traceback and "workbench" not in problem.traceback.replace(
        "workbench_task", ""
    )
    assert len(problem.traceback.splitlines()) < 250


def test_an_error_in_a_helper_is_reported_at_the_helpers_line(write: Write) -> None:
    helper = write("helper.py", "SIZE = 1\nSIZE = = 2\n")
    path = write("push.py", "import helper\n" + PUSH, task=True)
    problem = refused(path)
    assert (problem.stage, problem.file, problem.line, problem.code) == (
        "syntax",
        str(helper),
        2,
        "SIZE = = 2",
    )
    helper.write_text("def grow():\n    return [][1]\n\ngrow()\n")
    problem = refused(path)
    assert (problem.stage, problem.file, problem.line, problem.code) == (
        "import",
        str(helper),
        2,
        "return [][1]",
    )


def test_the_same_id_twice_is_an_error_that_names_both_lines(write: Write) -> None:
    path = write("push.py", PUSH + PUSH.replace("class PushEnv", "class Other"), task=True)
    problem = refused(path)
    text = path.read_text().splitlines()
    lines = [number for number, line in enumerate(text, 1) if line.startswith("@register_env")]
    assert f"line {lines[0]} (PushEnv)" in problem.message and f"line {lines[1]} (Other)" in problem.message
    assert problem.line in (lines[1], lines[1] + 1)
    assert "AuthorPush-v1" not in REGISTERED_ENVS


def test_keyboard_interrupt_passes_through_and_leaves_no_trace(write: Write) -> None:
    before = registered()
    path = write("push.py", PUSH + "\nraise KeyboardInterrupt\n", task=True)
    with pytest.raises(KeyboardInterrupt):
        load_task(str(path))
    assert registered() == before


def test_a_failed_load_changes_nothing(write: Write) -> None:
    write("helper.py", "SIZE = 1\n")
    write("lazy.py", "SIZE = 1\n")
    body = """
    def look(self):
        import lazy
        return helper.SIZE, lazy.SIZE, self.fail
    """
    path = write("push.py", "import helper\n" + PUSH + body, task=True)
    good = load_task(str(path))
    before, modules = registered(), dict(sys.modules)
    path_before, finders = list(sys.path), list(sys.meta_path)

    write("helper.py", "SIZE = 2\n")
    path.write_text(
        "from mani_skill.agents.registration import register_agent\n"
        "from mani_skill.agents.robots import Panda\n"
        + path.read_text().replace("AuthorPush-v1", "PickCube-v1")
        + "\n@register_agent()\nclass Robot(Panda):\n    uid = 'author_robot'\n\n1 / 0\n"
    )
    refused(path)
    assert registered() == before
    assert {name: sys.modules.get(name) for name in modules} == modules
    assert (sys.path, sys.meta_path) == (path_before, finders)
    assert REGISTERED_ENVS["AuthorPush-v1"].cls is good.cls
    assert sys.modules["helper"].SIZE == 1
    with pytest.raises(AttributeError) as caught:
        good.cls.look(object())  # type: ignore[attr-defined]
    shown = traceback.format_exception(caught.value)[-2]
    assert "return helper.SIZE, lazy.SIZE, self.fail" in shown
    assert inspect.getsource(good.cls).startswith('@register_env("AuthorPush-v1"')


def test_a_load_whose_class_cannot_be_built_is_undone(write: Write) -> None:
    helper = write("helper.py", "SIZE = 1\n")
    path = write("push.py", "import helper\n" + PUSH, task=True)
    good = load_task(str(path))
    before, modules = registered(), dict(sys.modules)
    for number in range(3):
        helper.write_text("SIZE = 2\n")
        path.write_text(path.read_text() + f"\nNUMBER = {number}\n")
        bad = load_task(str(path))
        assert sys.modules["helper"].SIZE == 2
        assert undo_load(bad) and not undo_load(bad)
        assert registered() == before
        assert {name: sys.modules.get(name) for name in modules} == modules
        assert "NUMBER" not in inspect.getsource(sys.modules[good.cls.__module__])
    assert with_late_imports(good).source_hash == good.source_hash
    again = load_task(str(path))
    assert not undo_load(good)
    load_task(str(write("other.py", PUSH.replace("AuthorPush", "AuthorOther"), task=True)))
    assert not undo_load(again)
    assert not undo_load(load_task("PickCube-v1"))


def test_old_versions_are_freed(write: Write) -> None:
    path = write("push.py", PUSH, task=True)
    versions = []
    for _ in range(5):
        versions.append(weakref.ref(load_task(str(path)).cls))
    gc.collect()
    # The newest version runs, and the previous one would return if the newest were undone.
    assert [version() is None for version in versions] == [True, True, True, False, False]


def test_a_failed_save_does_not_take_an_id_back_from_another_file(write: Write) -> None:
    one = write("one/push.py", PUSH, task=True)
    two = write("two/push.py", PUSH, task=True)
    load_task(str(one))
    newer = load_task(str(two))
    assert REGISTERED_ENVS["AuthorPush-v1"].cls is newer.cls
    text = one.read_text()
    one.write_text(text + "\n1 / 0\n")
    before = registered()
    refused(one)
    assert registered() == before
    assert REGISTERED_ENVS["AuthorPush-v1"].cls is newer.cls
    one.write_text(text)
    again = load_task(str(one))
    assert undo_load(again) and registered() == before


def test_a_failed_load_removes_its_search_path_entries(write: Write, folder: Path) -> None:
    head = "import sys\nsys.path.insert(0, 'first')\nsys.path.append('last')\nimport helper\n"
    path = write("push.py", head + "1 / 0\n")
    write("helper.py", "SIZE = 1\n")
    search_path, finders, modules = list(sys.path), list(sys.meta_path), set(sys.modules)
    assert str(folder) not in search_path
    refused(path)
    assert (sys.path, sys.meta_path) == (search_path, finders)
    assert "helper" not in sys.modules and set(sys.modules) == modules
    # The second failure in a row, and one after a version that works.
    refused(path)
    assert (sys.path, sys.meta_path) == (search_path, finders)
    good = load_task(str(write("push.py", head + PUSH, task=True)))
    search_path, finders = list(sys.path), list(sys.meta_path)
    for _ in range(2):
        path.write_text(path.read_text() + "sys.path.append('more')\n1 / 0\n")
        refused(path)
        assert (sys.path, sys.meta_path) == (search_path, finders)
    assert REGISTERED_ENVS["AuthorPush-v1"].cls is good.cls
