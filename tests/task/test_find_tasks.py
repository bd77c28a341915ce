"""Task files are found by their text, in bounded time, without running them."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.task.find import find_task_files, is_below, read_task_file

REGISTERED = (
    'open({mark!r}, "w")\n@register_env("Push-v1", max_episode_steps=50)\nclass PushEnv(BaseEnv):\n    pass\n'
)


def task(path: Path, text: str = "class Task(BaseEnv): pass\n") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def names(folder: Path) -> list[str]:
    root = folder.resolve()
    return [str(one.path.relative_to(root)) for one in find_task_files(folder).files]


def test_a_task_is_found_by_its_decorator_or_its_base_class_and_does_not_run(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    task(tmp_path / "push.py", REGISTERED.format(mark=str(mark)))
    task(tmp_path / "sub/pull.py", "class A(sapien_env.BaseEnv[int]): pass\nclass B(A): pass\n")
    task(tmp_path / "sub/other.py", "@register_env(uid='Other-v1')\nclass Other(PickCubeEnv): pass\n")
    task(tmp_path / "tools.py", "from mani_skill.envs.sapien_env import BaseEnv\ndef f(e: BaseEnv): pass\n")
    found = {one.path.name: one for one in find_task_files(tmp_path).files}
    assert list(found) == ["push.py", "other.py", "pull.py"], "nearest first"
    assert (found["push.py"].ids, found["push.py"].classes) == (("Push-v1",), ("PushEnv",))
    assert (found["pull.py"].ids, found["pull.py"].classes) == ((), ("A", "B"))
    assert (found["other.py"].ids, found["other.py"].classes) == (("Other-v1",), ("Other",))
    assert not mark.exists()


def test_hidden_folders_environments_packages_and_links_are_left_out(tmp_path: Path) -> None:
    work = tmp_path / "work"
    for folder in (".git", "env/lib", "lib/site-packages/p", "node_modules", "__pycache__", "conda"):
        task(work / folder / "task.py")
    (work / "env/pyvenv.cfg").touch()
    (work / "conda/conda-meta").mkdir()
    task(work / ".hidden.py")
    outside = task(tmp_path / "outside/secret.py")
    (work / "link.py").symlink_to(outside)
    (work / "linked").symlink_to(outside.parent)
    (work / "circle").symlink_to(work)
    assert names(work) == []
    mine = task(work / "mine.py")
    assert names(work) == ["mine.py"]
    assert is_below(mine, work) and not is_below(work / "link.py", work)


def test_a_file_that_does_not_parse_is_listed_if_it_looks_like_an_unfinished_task(
    tmp_path: Path,
) -> None:
    task(tmp_path / "broken.py", "class Push(BaseEnv):\n    def evaluate(self:\n")
    task(tmp_path / "noise.py", "BaseEnv ((((")
    task(tmp_path / "open.py", "class Push(BaseEnv:\n")
    task(tmp_path / "of_module.py", "class Push(sapien_env.BaseEnv, Mixin\n")
    task(tmp_path / "registered.py", "@register_env('Push-v1')\nclass Push(Base:\n")
    assert names(tmp_path) == ["broken.py", "of_module.py", "open.py", "registered.py"]
    assert names(tmp_path / "gone") == []


@settings(max_examples=200)
@given(st.binary(max_size=300) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace")))
def test_no_text_breaks_the_search(tmp_path_factory: pytest.TempPathFactory, raw: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "any.py"
    file.write_bytes(b"# BaseEnv register_env\n" + raw)
    found = read_task_file(file)
    assert found is None or found.path == file
    file.write_bytes(b"class Task(BaseEnv): pass\nx = '''" + raw)
    read_task_file(file)
