"""Task files are found by their text, in bounded time, without running them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.task import find
from workbench.task.find import TaskFileReader, find_task_files, is_below, read_task_file

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


def test_a_search_ends_early_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c", "deep/d", "deep/er/e"):
        task(tmp_path / f"{name}.py")
    whole = find_task_files(tmp_path)
    assert len(whole.files) == 5 and not whole.left_out
    for name, value, found in (
        ("MAX_FILES_READ", 3, 3),
        ("MAX_FOUND", 2, 2),
        ("TIMEOUT_SECONDS", -1.0, 0),
        ("MAX_DEPTH", 1, 4),
        ("MAX_DEPTH", 2, 5),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(find, name, value)
            some = find_task_files(tmp_path)
            assert [one.path for one in some.files] == [one.path for one in whole.files[:found]], name
            assert bool(some.left_out) is (name != "MAX_DEPTH")


def test_a_file_is_read_again_only_if_it_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, reader = task(tmp_path / "a.py"), TaskFileReader()
    read, kept = find.read_task_file, []
    monkeypatch.setattr(find, "read_task_file", lambda path: kept.append(path) or read(path))
    for _ in range(2):
        found = reader.read(file)
        assert found is not None and found.classes == ("Task",)
    assert kept == [file]
    stamp = file.stat()
    file.write_text("class Othr(BaseEnv): pass\n")
    os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    found = reader.read(file)
    assert found is not None and found.classes == ("Othr",) and len(kept) == 2
    file.unlink()
    assert reader.read(file) is None
    task(file)
    assert reader.read(file) is not None


def test_classes_in_branches_count_and_base_env_itself_does_not(tmp_path: Path) -> None:
    text = """
if FAST:
    class A(BaseEnv): pass
else:
    class B(BaseEnv): pass
try:
    class C(A): pass
except ImportError:
    pass
with note():
    @register_env("D-v1", "E-v1")
    class D: pass
class BaseEnv(Env): pass
def made():
    class F(BaseEnv): pass
"""
    found = read_task_file(task(tmp_path / "a.py", text))
    assert found is not None and (found.classes, found.ids) == (("A", "B", "C", "D"), ("D-v1",))
    broken = read_task_file(task(tmp_path / "b.py", "x = 1\nclass Push(BaseEnv):\n    def evaluate(self:\n"))
    assert broken is not None and broken.not_python and broken.line == 3
