"""A folder of foreign recordings: no code that it names or contains runs before the user agrees."""

# pyright: reportOptionalMemberAccess=false

from __future__ import annotations

import json
import os
import pty
import select
import shutil
import sys
import tempfile
from html import unescape
from pathlib import Path

import pytest

from tests.drive.session import rescored
from tests.drive.waiting import until
from tests.episodes.foreign_h5 import write as write_foreign
from workbench.cli.main import main
from workbench.cli.output import Exit
from workbench.cli.rescore import RescoreOptions, rescore_all
from workbench.episodes.reader.reading import find_all_sources
from workbench.library.folder import Library
from workbench.live.questions_without_task import MakeScene
from workbench.live.timeline_commands import StopRescoring
from workbench.live.worker.make_scene import make
from workbench.record.job import record
from workbench.record.job_worker import RecordOptions
from workbench.rescore.recording_jobs import Rescorer
from workbench.rescore.result_parts import status_html
from workbench.review.playback import Review
from workbench.review.recorded_scene import SceneProcess
from workbench.task.description import TaskOptions
from workbench.trust.clearance import Clearances, Consent, NotTrusted, TrustQuestion

pytestmark = pytest.mark.usefixtures("child_process")

TEXT = (Path(__file__).parents[2] / "tasks" / "push_cube.py").read_text()
HELPER = "OPENED = open(__file__ + '.ran', 'a').write('x')\n"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a task, a module that leaves a mark when imported, and two episodes of the task."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "push_cube.py").write_text(TEXT.replace("import torch\n", "import torch\nimport marks\n", 1))
    (folder / "marks.py").write_text(HELPER)
    options = TaskOptions(2, "cpu", 20, {"render_backend": "none"})
    task, out = str(folder / "push_cube.py"), folder / "recordings"
    record(RecordOptions(task, out, episodes=2, pictures=False, max_steps=3, options=options))
    assert (folder / "marks.py.ran").exists()
    return folder


@pytest.fixture
def foreign(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same folder on an installation that recorded none of it."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    folder = tmp_path / "foreign"
    shutil.copytree(recorded, folder)
    (folder / "marks.py.ran").unlink()
    return folder


def ran(folder: Path) -> bool:
    """Whether the task, from the folder or from its recordings, was imported since the last call."""
    marks = [*folder.glob("*.ran"), *Path(tempfile.gettempdir()).glob("workbench-recorded-*/*.ran")]
    for mark in marks:
        mark.unlink()
    return bool(marks)


# --- opening a row -----------------------------------------------------------------------------------


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    """What the file evil.py in the same folder leaves behind when it runs."""
    mark = tmp_path / "evil_ran"
    (tmp_path / "evil.py").write_text(f"open({str(mark)!r}, 'w').write('ran')\n")
    return mark


def test_a_path_instead_of_an_id_is_not_loaded_when_its_row_is_opened(mark: Path) -> None:
    folder = mark.parent
    pair = write_foreign(folder).with_suffix(".json")
    document = json.loads(pair.read_text())
    document["env_info"]["env_id"] = str(folder / "evil.py")
    pair.write_text(json.dumps(document))
    library = Library(folder)
    review = Review(library, make_scene=SceneProcess())
    try:
        library.refresh()
        (row,) = library.view().rows
        review.open((row.id,))
        until(lambda: "no env" in "".join(one.scene for one in review.view().opened), "the explanation")
    finally:
        review.close()
        library.close()
    assert not mark.exists()


@pytest.mark.parametrize(
    "named", ["{file}", "{file}:Evil", "./evil.py", "evil.py", "evil:Evil-v0", "~/evil.py"]
)
def test_no_notation_of_a_name_in_a_recording_opens_a_file(
    tmp_path: Path, mark: Path, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    wanted = MakeScene(named.format(file=tmp_path / "evil.py"), (), {}, 0, {}, {})
    with pytest.raises(Exception, match="There is no env"):
        make(wanted)
    assert not mark.exists()


# --- rescoring -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("recorded_source", [False, True])
def test_rescoring_in_a_program_runs_no_code_without_consent(foreign: Path, recorded_source: bool) -> None:
    what = RescoreOptions((foreign / "recordings",), recorded_source=recorded_source)
    with pytest.raises(NotTrusted) as refused:
        rescore_all(what)
    assert len(refused.value.questions) == 1 and not ran(foreign)
    verdicts, _ = rescore_all(what, clearances=Clearances(all_trusted=True))
    assert [verdict.differs for verdict in verdicts] == [False, False]


def run(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main(["rescore", *arguments])
    printed = capfd.readouterr()
    return int(ended.value.code or 0), printed.out + printed.err


@pytest.mark.slow
def test_without_a_terminal_it_is_refused_with_its_own_exit_code(
    foreign: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    recordings = str(foreign / "recordings")
    for more in ([], ["--recorded-source"]):
        code, printed = run([recordings, *more], capfd)
        assert code == Exit.NOT_TRUSTED == 4 and not ran(foreign)
        assert "--trust" in printed and "push_cube.py" in printed
    (foreign / "numpy.py").write_text("A = 1\n")
    code, printed = run([recordings, "--trust"], capfd)
    assert code == 0 and ran(foreign)
    assert printed.count(f"{foreign / 'numpy.py'} has the name of a library") == 1
    assert run([recordings], capfd)[0] == Exit.NOT_TRUSTED, "--trust applies to one run"
    assert run([recordings, "--task", str(foreign / "push_cube.py")], capfd)[0] == 0 and ran(foreign)


@pytest.mark.slow
def test_in_a_terminal_it_asks_and_stores_the_answer(foreign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keyboard, terminal = pty.openpty()

    def rescored(typed: str) -> tuple[int, str]:
        os.write(keyboard, f"{typed}\n".encode())
        with open(terminal, closefd=False) as read, open(terminal, "w", closefd=False) as written:
            monkeypatch.setattr(sys, "stdin", read)
            monkeypatch.setattr(sys, "stdout", written)
            with pytest.raises(SystemExit) as ended:
                main(["rescore", str(foreign / "recordings")])
            monkeypatch.undo()
            monkeypatch.setenv("XDG_CONFIG_HOME", str(foreign.parent / "config"))
        printed = b""
        while select.select([keyboard], [], [], 0.2)[0]:
            printed += os.read(keyboard, 100_000)
        return int(ended.value.code or 0), printed.decode()

    for no in ("n", "", "perhaps"):
        code, printed = rescored(no)
        assert code == Exit.NOT_TRUSTED and not ran(foreign)
    assert "marks.py" in printed and str(foreign / "push_cube.py") in printed and "Run it?" in printed
    assert HELPER.strip() not in printed
    code, printed = rescored("show\nn")
    assert code == Exit.NOT_TRUSTED and not ran(foreign) and HELPER.strip() in printed
    code, printed = rescored("a")
    assert code == 0 and ran(foreign) and "Run it?" in printed
    code, printed = rescored("n")
    assert code == 0 and ran(foreign) and "Run it?" not in printed
    (foreign / "marks.py").write_text(HELPER + "# changed\n")
    code, printed = rescored("n")
    assert code == Exit.NOT_TRUSTED and not ran(foreign)
    changed = next(line for line in printed.splitlines() if "marks.py" in line)
    unchanged = next(line for line in printed.splitlines() if "push_cube.py" in line)
    assert "changed since" in changed and "changed since" not in unchanged
    os.close(keyboard)
    os.close(terminal)


@pytest.mark.slow
def test_on_a_page_it_asks_and_no_skips_only_that_recording(foreign: Path, recorded: Path) -> None:
    asked: list[TrustQuestion] = []
    answers = iter([Consent.NO, Consent.ONCE])

    def ask(question: TrustQuestion, stopped: object) -> Consent:
        asked.append(question)
        return next(answers)

    (foreign / "numpy.py").write_text("A = 1\n")
    rescorer = Rescorer(Clearances(ask=ask))
    try:
        rescorer.start(find_all_sources((foreign / "recordings",)))
        view = rescored(rescorer, "failed")
        assert view.why and not ran(foreign)
        rescorer.start(find_all_sources((foreign / "recordings",)))
        view = rescored(rescorer, "done", "failed")
        assert view.state == "done" and len(view.verdicts) == 2, view
        (said,) = view.warnings
        assert f"{foreign / 'numpy.py'} has the name of a library" in said
        assert said in unescape(status_html(view))
        assert ran(foreign) and [[one.name for one in q.modules] for q in asked] == [["marks.py"]] * 2
    finally:
        rescorer.close()


def test_a_question_on_a_page_can_be_withdrawn(foreign: Path) -> None:
    asking = []

    def ask(question: TrustQuestion, stopped) -> Consent:
        asking.append(question)
        until(stopped, "the withdrawal")
        return Consent.NO

    rescorer = Rescorer(Clearances(ask=ask))
    try:
        rescorer.start(find_all_sources((foreign / "recordings",)))
        until(lambda: asking, "the question")
        assert rescorer.view.state == "asking"
        rescorer.do(StopRescoring())
        rescored(rescorer, "stopped")
    finally:
        rescorer.close()
    assert len(asking) == 1 and not ran(foreign)
