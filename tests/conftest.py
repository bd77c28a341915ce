"""Setup for every test: strict rerun, a separate configuration folder, a shared browser, no processes left behind."""

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

# Before anything imports rerun, which reads this once: a wrong argument raises instead of printing a warning.
os.environ["RERUN_STRICT"] = "1"
# For this process and its children: consents and seals of tests must not get into the developer's own folder.
os.environ["XDG_CONFIG_HOME"] = tempfile.mkdtemp(prefix="workbench-test-config-")
# Nor recent tasks.
os.environ["XDG_STATE_HOME"] = os.path.join(os.environ["XDG_CONFIG_HOME"], "state")

# pytest-xdist sets these in its processes: a console of rich that is made meanwhile would keep this size.
os.environ.pop("COLUMNS", None)
os.environ.pop("LINES", None)

import psutil
import pytest
from hypothesis import HealthCheck, settings

from tests.drive.waiting import until

atexit.register(shutil.rmtree, os.environ["XDG_CONFIG_HOME"], ignore_errors=True)

MANY_MODULES = 50

# Off during collection: imports and collected tests are not garbage, and searching them takes a third of the time.
gc.disable()

pytest_plugins = [
    "tests.drive.tiers",
    "tests.drive.sessions",
    "tests.drive.servers",
    "tests.drive.recordings",
    "tests.drive.task_files",
]

# By default hypothesis fails an example that takes 0.2 s, as any may on a busy machine. It also draws other examples in each
# run: then a fault found by chance blames the commit that happens to be tested. `make test-order` looks for new ones.
settings.register_profile("new-examples", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same-examples", settings.get_profile("new-examples"), derandomize=True)
settings.load_profile("same-examples")

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


SHARED_SERVER_FILES = {
    **{
        f"tests/browser/test_{name}.py": "tests/browser/test_camera_reports.py"
        for name in ("by_keyboard", "layout", "marks", "page", "timeline")
    },
    **{
        f"tests/browser/test_{name}.py": "tests/browser/test_rescored_past.py"
        for name in ("first_steps", "help")
    },
}
"""Files that share a page's server with another file (tests/browser/conftest.py), so one process must run both."""


SPLIT_FILES = {"tests/test_every_command.py"}
"""Files of long independent tests, scheduled one by one: as one unit they would finish long after all others."""


def run_together(nodeid: str) -> str:
    """Scheduling unit of a test: its file, or the file with which that shares a server."""
    file = nodeid.split("::", 1)[0]
    return nodeid if file in SPLIT_FILES else SHARED_SERVER_FILES.get(file, file)


def browsers_apart(items: list[pytest.Item]) -> list[pytest.Item]:
    """Spread the files with a browser evenly among the others, which keep their order.

    A page, its server and its worker are three processes. With two pages open at once most of the time, their tests take 704 s of
    process time; spread, 497 s.
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
    """``--dist loadfile`` with the units of `run_together`."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return run_together(nodeid)

    return Scheduling(config, log)


FAILURE_PICTURES = Path(__file__).parents[1] / "test-results"
"""Where a failed test leaves what its pages showed."""


@pytest.hookimpl(tryfirst=True)
def pytest_fixture_setup() -> None:
    name_no_test()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call() -> None:
    name_no_test()


def name_no_test() -> None:
    """Keep the environment constant: pytest's variable differs per test, and a worker is forked only in an unchanged one."""
    os.environ["PYTEST_CURRENT_TEST"] = "a test"


@pytest.fixture(autouse=True, scope="module")
def ids_are_free_again() -> Iterator[None]:
    """Unregister the tasks and robots of a module's tests: the same id in another test file would count as a duplicate."""
    before = {name for known in _registries() for name in known}
    yield
    for known in _registries():
        for name in known.keys() - before:
            cls = getattr(known[name], "cls", None) or getattr(known[name], "agent_cls", None)
            if cls is not None and not cls.__module__.startswith("mani_skill."):
                del known[name]
                sys.modules["gymnasium"].registry.pop(name, None)


def _registries() -> list[dict[str, Any]]:
    """ManiSkill's registries of tasks and robots, if it was imported."""
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
    # Also after a passing test, so that its expected exceptions are not shown with a later failure.
    sights = sys.modules["tests.drive.page"].seen_at_failure(report.failed)
    if report.failed and sights:
        folder = FAILURE_PICTURES / re.sub(r"[^\w.-]+", "-", f"{item.nodeid}-{report.when}")[-150:]
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
    """A browser for each file: a thread in which Playwright waits cannot run another asyncio loop."""
    from tests.drive.page import browser_at

    with browser_at(chromium_path) as browser:
        yield browser


@pytest.fixture(scope="module")
def task_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the example task in a separate folder, for tests that edit it."""
    example = Path(__file__).parents[1] / "tasks" / "push_cube.py"
    return Path(shutil.copy(example, tmp_path_factory.mktemp("author")))


_searched = 0
"""Number of loaded modules at the last full garbage collection."""


@pytest.fixture(scope="module", autouse=True)
def imported_modules_are_not_searched_for_garbage() -> None:
    """BaseEnv calls ``gc.collect()`` on each build and close: 0.25 s for torch's own objects, and as much for later
    imports."""
    global _searched
    if len(sys.modules) > _searched + MANY_MODULES:
        _searched = len(sys.modules)
        gc.unfreeze()
        gc.collect()
        gc.freeze()
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def nothing_was_chosen_on_a_page_before() -> Iterator[None]:
    """Reset page choices: a test file that presses every button also closes the hints for the next file in the process."""
    yield
    Path(os.environ["XDG_CONFIG_HOME"], "workbench", "choices.json").unlink(missing_ok=True)


@pytest.fixture(scope="session", autouse=True)
def no_process_left_behind() -> Iterator[None]:
    """Fail if workers or browsers of the tests are still running at the end."""
    yield
    if "workbench.episodes.reader.reading" in sys.modules:
        # Both serve the whole process for its lifetime.
        sys.modules["workbench.episodes.reader.reading"].stop_reading()
    if "workbench.live.process.fork_client" in sys.modules:
        sys.modules["workbench.live.process.fork_client"].worker_forks.end()
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
