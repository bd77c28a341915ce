"""What every test relies on: rerun strict, a configuration folder of its own, a real Chromium by name, no processes left behind."""

from __future__ import annotations

import atexit
import gc
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Before anything imports rerun, which reads it once: a wrong argument raises instead of printing a warning.
os.environ["RERUN_STRICT"] = "1"
# For this process and all that it starts: what tests trust and seal must not get into the developer's own folder.
os.environ["XDG_CONFIG_HOME"] = tempfile.mkdtemp(prefix="workbench-test-config-")
# Nor what they opened last.
os.environ["XDG_STATE_HOME"] = os.path.join(os.environ["XDG_CONFIG_HOME"], "state")

import psutil
import pytest
from hypothesis import HealthCheck, settings

from tests.drive.waiting import until

atexit.register(shutil.rmtree, os.environ["XDG_CONFIG_HOME"], ignore_errors=True)

MANY_MODULES = 50

# Until the tests begin: what they import is no garbage, and neither are they. It takes a third of the time to collect them.
gc.disable()

pytest_plugins = [
    "tests.drive.tiers",
    "tests.drive.sessions",
    "tests.drive.servers",
    "tests.drive.recordings",
    "tests.drive.task_files",
]

# By itself hypothesis fails an example that takes 0.2 s, which a busy machine makes of any.
settings.register_profile("unhurried", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("unhurried")

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items[:] = browsers_apart(items)
    gpu_items = [item for item in items if item.get_closest_marker("gpu")]
    if not gpu_items:
        return
    import torch

    if not torch.cuda.is_available():
        for item in gpu_items:
            item.add_marker(pytest.mark.skip(reason="torch sees no CUDA device"))


ONE_AFTER_THE_OTHER = {
    **{
        f"tests/browser/test_{name}.py": "tests/browser/test_camera_reports.py"
        for name in ("by_keyboard", "layout", "marks", "page", "timeline")
    },
    **{
        f"tests/browser/test_{name}.py": "tests/browser/test_rescored_past.py"
        for name in ("first_steps", "help")
    },
}
"""Files that share a page's server with another (tests/browser/conftest.py), so that one process has to run both."""


EACH_ALONE = {"tests/test_every_command.py"}
"""Files of long tests that share nothing: in one process they would go on long after all others."""


def run_together(nodeid: str) -> str:
    """What runs in one process with this test: its file, or another with which that shares a server."""
    file = nodeid.split("::", 1)[0]
    return nodeid if file in EACH_ALONE else ONE_AFTER_THE_OTHER.get(file, file)


def browsers_apart(items: list[pytest.Item]) -> list[pytest.Item]:
    """The files with a browser spread among the others, which keep their order.

    A page, its server and its worker are three processes. Where two pages were open at once most of the time, their tests took 704 s of
    a process, and 497 spread.
    """
    files: dict[str, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(run_together(item.nodeid), []).append(item)
    with_browser, others = [], []
    for tests in files.values():
        has_one = any(test.get_closest_marker("browser") for test in tests)
        (with_browser if has_one else others).append(tests)
    count = len(others)
    places = [(i + 0.5) * count / max(len(with_browser), 1) for i in range(len(with_browser))]
    ordered = sorted([*zip(range(count), others), *zip(places, with_browser)], key=lambda at: at[0])
    return [test for _, tests in ordered for test in tests]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """As ``--dist loadfile``, but for those."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return run_together(nodeid)

    return Scheduling(config, log)


SIGHTS = Path(__file__).parents[1] / "test-results"
"""Where a failed test leaves what its pages showed."""


@pytest.hookimpl(tryfirst=True)
def pytest_fixture_setup() -> None:
    name_no_test()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call() -> None:
    name_no_test()


def name_no_test() -> None:
    """pytest's variable is another in each test, and a worker is forked only where the environment is as it was."""
    os.environ["PYTEST_CURRENT_TEST"] = "a test"


@pytest.fixture(autouse=True, scope="module")
def ids_are_free_again() -> Iterator[None]:
    """What a module's tests register, as tasks and robots, is gone after them: another file with the same id would count as a
    second one."""
    before = {name for known in _registries() for name in known}
    yield
    for known in _registries():
        for name in known.keys() - before:
            cls = getattr(known[name], "cls", None) or getattr(known[name], "agent_cls", None)
            if cls is not None and not cls.__module__.startswith("mani_skill."):
                del known[name]
                sys.modules["gymnasium"].registry.pop(name, None)


def _registries() -> list[dict[str, Any]]:
    """ManiSkill's ids of tasks and of robots, if it was imported."""
    tasks = sys.modules.get("mani_skill.utils.registration")
    robots = sys.modules.get("mani_skill.agents.registration")
    return [
        *([] if tasks is None else [tasks.REGISTERED_ENVS]),
        *([] if robots is None else [robots.REGISTERED_AGENTS]),
    ]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if "tests.drive.page" not in sys.modules:
        return report
    # Of a test that passes too, so that what it expected to raise is not shown with a later one's failure.
    sights = sys.modules["tests.drive.page"].seen_at_failure(report.failed)
    if report.failed and sights:
        folder = SIGHTS / re.sub(r"[^\w.-]+", "-", f"{item.nodeid}-{report.when}")[-150:]
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for number, sight in enumerate(sights):
            (folder / f"{number}.txt").write_text(sight.log)
            if sight.picture is not None:
                (folder / f"{number}.png").write_bytes(sight.picture)
        report.sections.append(("what its pages and terminals showed", f"is in {folder}"))
    return report


@pytest.fixture(scope="module")
def browser(chromium_path: str) -> Iterator[Browser]:
    """Not one for all files: a thread in which Playwright waits takes no other loop of asyncio."""
    from tests.drive.page import browser_at

    with browser_at(chromium_path) as browser:
        yield browser


@pytest.fixture(scope="module")
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the example task in a folder of its own, for tests that edit it."""
    example = Path(__file__).parents[1] / "tasks" / "push_cube.py"
    return Path(shutil.copy(example, tmp_path_factory.mktemp("author")))


_searched = 0
"""How many modules there were when garbage was last searched for among all objects."""


@pytest.fixture(scope="module", autouse=True)
def imported_modules_are_not_searched_for_garbage() -> None:
    """BaseEnv calls ``gc.collect()`` whenever it builds or closes: 0.25 s each over torch's own objects, and as long over what later
    tests import."""
    global _searched
    if len(sys.modules) > _searched + MANY_MODULES:
        _searched = len(sys.modules)
        gc.unfreeze()
        gc.collect()
        gc.freeze()
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def nothing_was_chosen_on_a_page_before() -> Iterator[None]:
    """A file of tests that presses every button closes the hints too, for whichever file the process runs next."""
    yield
    Path(os.environ["XDG_CONFIG_HOME"], "workbench", "choices.json").unlink(missing_ok=True)


@pytest.fixture(scope="session", autouse=True)
def no_process_left_behind() -> Iterator[None]:
    """Workers and browsers that tests started must be gone when the tests are."""
    yield
    if "workbench.episodes.reader.reading" in sys.modules:
        # Both serve the whole process, for as long as that lives.
        sys.modules["workbench.episodes.reader.reading"].stop_reading()
    if "workbench.live.process.worker_start" in sys.modules:
        sys.modules["workbench.live.process.worker_start"].worker_forks.end()
    until(lambda: not _children(), "the end of all processes that tests started", 10, seen=_children)


def _children() -> list[str]:
    left: list[str] = []
    for child in psutil.Process().children(recursive=True):
        try:
            command = " ".join(child.cmdline())
            if child.status() != psutil.STATUS_ZOMBIE:
                left.append(f"{child.pid} {command[:200]}")
        except psutil.NoSuchProcess:
            continue
    return left
