"""A task in a package, opened by module name: followed like a file, and imported only by the worker."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.drive.session import TASKS, wait_until
from workbench.app.session import Session
from workbench.task.description import TaskOptions

pytestmark = pytest.mark.usefixtures("child_process")

PLAIN = {"render_backend": "none"}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a package, and next to it files named like libraries."""
    folder = tmp_path_factory.mktemp("project").resolve()
    package = folder / "lab_with_tasks"
    (package / "tasks").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "tasks" / "__init__.py").write_text("from .minimal import *\n")
    (package / "sizes.py").write_text("HALF = 0.02\n")
    text = (TASKS / "minimal.py").read_text()
    (package / "tasks" / "minimal.py").write_text(
        text.replace("import torch\n", "import torch\nfrom ..sizes import HALF\n", 1)
    )
    for name in ("numpy", "json", "torch", "sapien"):
        (folder / f"{name}.py").write_text("raise SystemExit('a file in the current folder ran')\n")
    before = Path.cwd()
    os.chdir(folder)
    yield folder
    os.chdir(before)


@pytest.mark.slow
def test_a_task_of_a_package_opens_and_is_followed(project: Path) -> None:
    class_name = "MinimalEnv"
    session = Session(
        f"lab_with_tasks.tasks:{class_name}",
        TaskOptions(2, env_kwargs=PLAIN),
        recordings=project / "recordings",
    )
    try:
        view = wait_until(session, lambda v: v.task is not None or v.problem is not None, "the task")
        assert view.problem is None
        file = project / "lab_with_tasks" / "tasks" / "minimal.py"
        assert (view.task.file, view.task.class_name) == (str(file), class_name)
        for changed, text in (
            (file, file.read_text() + "\n# seen\n"),
            (project / "lab_with_tasks" / "sizes.py", "HALF = 0.03\n"),
        ):
            before = session.view().task_serial
            changed.write_text(text)
            view = wait_until(session, lambda v, s=before: v.task_serial > s, f"the new {changed.name}")
            assert view.problem is None and view.task.source[str(changed)] == text
        assert not [name for name in sys.modules if name.startswith("lab_with_tasks")]
    finally:
        session.close()
