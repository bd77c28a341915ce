"""The code that opening a task file would run is found without running it; for a recording's file only that code runs."""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import Path

import pytest

from workbench.task import content
from workbench.task.content import CannotRead, TaskContent, read_content, source_hash
from workbench.task.load import load_task
from workbench.task.problem import TaskError
from workbench.task.reference import RecordedTask

TASK = "from mani_skill.envs.sapien_env import BaseEnv\nclass Lift(BaseEnv):\n    pass\n"


def lay(folder: Path, **texts: str) -> Path:
    """Write these modules, ``a__b`` for ``a/b.py``. Each except task.py creates a marker file when run. Returns task.py."""
    for name, text in texts.items():
        path = folder / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + f"\nopen({str(folder / f'{path.stem}.ran')!r}, 'w').close()\n")
    return folder / "task.py"


def ran(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.ran")}


def recorded(file: Path) -> RecordedTask:
    found = read_content(file)
    return RecordedTask("Lift-v1", found.main, "Lift", found.texts)


@pytest.mark.parametrize(
    ("imports", "found"),
    [
        ("import alone", {"alone.py"}),
        ("import alone, far.near", {"alone.py", "far/near.py"}),
        ("from far import near", {"far/near.py"}),
        ("def hook():\n    from alone import *", {"alone.py"}),
        (
            "try:\n    import alone\nexcept ImportError:\n    import pack.one",
            {"alone.py", "pack/__init__.py", "pack/one.py"},
        ),
        ("from pack import *", {"pack/__init__.py", "pack/one.py"}),
        ("import chain", {"chain.py", "alone.py"}),
        ("import numpy, json", set()),
        # Within a package, the package's own module wins over a library of that name.
        ("import bag", {"bag/__init__.py", "bag/random.py"}),
    ],
)
def test_modules_are_found_by_their_imports(tmp_path: Path, imports: str, found: set[str]) -> None:
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("from . import one\n")
    (tmp_path / "pack" / "one.py").write_text("")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "__init__.py").write_text("from . import random\n")
    file = lay(tmp_path, task=imports, alone="", chain="import alone", far__near="", other="", bag__random="")
    assert set(read_content(file).modules) == found
    assert ran(tmp_path) == set()


@pytest.mark.parametrize(
    "text",
    [
        "import importlib\nimportlib.import_module('oth' + 'er')",
        "from importlib import import_module as get\nget('oth' + 'er')",
        "__import__('other')",
        "import sys\nsys.path.insert(0, 'x')",
        "exec(open('other.py').read())",
    ],
)
def test_computed_imports_count_all_neighbour_files_and_are_reported(tmp_path: Path, text: str) -> None:
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / "hidden.py").write_text("")
    content = read_content(lay(tmp_path, task=text, other="", deep__er=""))
    assert content.modules == ("deep/er.py", "other.py")
    assert any("task.py:" in what and "other code" in what for what in content.unseen)


def test_files_that_are_not_ordinary_text_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.py")
    (tmp_path / "zero.py").symlink_to("/dev/zero")
    (tmp_path / "long.py").write_bytes(b"#" * (17 << 20))
    (tmp_path / "bytes.py").write_bytes(b"\xff\xfe\x00")
    for name in ("pipe", "zero", "long", "bytes", "gone"):
        with pytest.raises(CannotRead, match="/dev/zero" if name == "zero" else f"{name}.py"):
            read_content(tmp_path / f"{name}.py")
    (tmp_path / "task.py").write_text("import pipe")
    assert read_content(tmp_path / "task.py").modules == (), "a pipe is no module"
    (tmp_path / "deep.py").write_text("-" * 100_000 + "1")
    assert "deep.py" in read_content(tmp_path / "deep.py").unseen[0]


def test_only_the_approved_code_runs(tmp_path: Path) -> None:
    file = lay(tmp_path, task=f"import alone, far.near\n{TASK}", alone="A = 1", far__near="", json="")
    agreed = recorded(file)
    evil = f"open({str(tmp_path / 'evil.ran')!r}, 'w').close()"
    for path in (file, tmp_path / "alone.py", tmp_path / "far" / "near.py"):
        path.write_text(evil)
    (tmp_path / "far" / "__init__.py").write_text(evil)
    before = list(sys.path)
    loaded = load_task(agreed)
    assert ran(tmp_path) == {"task", "alone", "near"} and loaded.class_name == "Lift"
    assert sys.path == before, "other files in that folder could be imported"


def test_unapproved_code_does_not_run_however_it_is_imported(tmp_path: Path) -> None:
    hidden = "get = globals()['__builtins__']; get = get if isinstance(get, dict) else vars(get)\nget['__imp' + 'ort__']('other')"
    file = lay(tmp_path, task=f"{TASK}{hidden}", other="")
    with pytest.raises(TaskError, match="not among the files that you approved"):
        load_task(recorded(file))
    # An earlier task may have put the folder on the path.
    sys.path.insert(0, str(tmp_path))
    try:
        with pytest.raises(TaskError, match="other"):
            load_task(recorded(file))
    finally:
        sys.path.remove(str(tmp_path))
    assert "other" not in ran(tmp_path)


@pytest.mark.parametrize(
    "name", ["{file}", "{file}:Lift", "task.py", "../task.py", "no.such.module:Lift-v0", ""]
)
def test_without_approval_only_a_registered_id_is_opened(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = lay(tmp_path, task=TASK)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TaskError, match="no installed package"):
        load_task(RecordedTask(name.format(file=file)))
    with pytest.raises(TaskError, match="no installed package"):
        load_task(RecordedTask("Lift-v1", str(file), "Lift"))
    assert ran(tmp_path) == set()
    assert load_task(RecordedTask("PickCube-v1")).class_name == "PickCubeEnv"


def test_a_module_refused_for_a_recording_is_found_for_a_task_opened_later(
    tmp_path: Path,
) -> None:
    hidden = "__builtins__['__imp' + 'ort__']('other')"
    file = lay(tmp_path, task=TASK, other="")
    load_task(recorded(file))
    mine = tmp_path / "mine.py"
    mine.write_text(f"{TASK}{hidden}")
    assert load_task(str(mine)).class_name == "Lift" and "other" in ran(tmp_path)


def test_modules_above_the_file_count_and_those_outside_of_its_packages_do_not(tmp_path: Path) -> None:
    for package in ("pack", "pack/sub"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("")
    imports = "from . import near\nfrom .. import up\nfrom ..beside import far\nfrom ... import outside\nfrom .... import more\n"
    lay(tmp_path, pack__sub__near="", pack__up="", pack__beside="far = 1", outside="", pack__unused="")
    file = tmp_path / "pack" / "sub" / "task.py"
    file.write_text(f"import outside\n{imports}")
    content = read_content(file)
    assert content.modules == (
        "../../outside.py",
        "../__init__.py",
        "../beside.py",
        "../up.py",
        "__init__.py",
        "near.py",
    )
    assert not content.computed
    assert next(iter(content.texts)) == content.main == str(file)


def test_sums_are_those_of_the_files_and_the_hash_that_of_the_texts(tmp_path: Path) -> None:
    def content_of(name: str, text: bytes) -> TaskContent:
        (tmp_path / name).mkdir()
        (tmp_path / name / "task.py").write_text("import alone\n")
        (tmp_path / name / "alone.py").write_bytes(text)
        return read_content(tmp_path / name / "task.py")

    unix, dos = content_of("unix", b"A = 1\nB = 2\n"), content_of("dos", b"A = 1\r\nB = 2\r\n")
    assert list(unix.file_sums) == ["task.py", "alone.py"] and unix.hash == dos.hash
    assert dos.file_sums["alone.py"] == hashlib.sha256(b"A = 1\r\nB = 2\r\n").hexdigest()
    assert unix.file_sums["alone.py"] != dos.file_sums["alone.py"]
    assert content_of("edited", b"A = 1\nB = 3\n").hash != unix.hash
    (tmp_path / "unix" / "unused.py").write_text("A = 3\n")
    assert read_content(tmp_path / "unix" / "task.py").hash == unix.hash
    assert dos.texts[str(tmp_path / "dos" / "alone.py")] == "A = 1\nB = 2\n"
    recorded = TaskContent("task.py", {"task.py": "x\n", "alone.py": "y\n"})
    assert recorded.file_sums == {name: hashlib.sha256(text).hexdigest() for name, text in (("task.py", b"x\n"), ("alone.py", b"y\n"))}  # fmt: skip
    other = TaskContent("alone.py", {"alone.py": "y\n", "task.py": "x\n"})
    assert recorded.hash != other.hash, "another file of the same texts is opened"
    joined = [TaskContent("t", {"t": "", "a": "bc"}), TaskContent("t", {"t": "", "ab": "c"})]
    assert joined[0].hash != joined[1].hash


def test_the_hash_of_a_source_does_not_depend_on_the_folder() -> None:
    texts = {"/here/task.py": "x = 1\n", "/lib/other.py": "y = 1\n"}
    there = {"/house/task.py": "x = 1\n", "/lib/other.py": "y = 1\n"}
    assert source_hash(texts, Path("/here")) == source_hash(there, Path("/house"))
    assert len(source_hash(texts, Path("/here"))) == 12
    for changed in (
        {**texts, "/lib/other.py": "y = 2\n"},
        {"/here/task.py": "x = 1\n", "/lib/more.py": "y = 1\n"},
    ):
        assert source_hash(changed, Path("/here")) != source_hash(texts, Path("/here"))


def test_compiled_modules_are_reported_and_too_many_modules_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = lay(tmp_path, task="import fast, alone", alone="")
    (tmp_path / "fast.cpython-311.so").touch()
    (tmp_path / "fast.txt").touch()
    (unseen,) = read_content(file).unseen
    assert "fast.cpython-311.so" in unseen
    assert read_content(lay(tmp_path, task="import importlib\nimportlib.import_module('x')")).computed
    monkeypatch.setattr(content, "MAX_MODULES", 2)
    read_content(lay(tmp_path, task="import alone"))
    with pytest.raises(CannotRead):
        read_content(lay(tmp_path, task="import alone, other", other=""))
