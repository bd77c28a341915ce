"""Which code of a recording may run, when the user is asked, and where answers are stored; runs no recorded code."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.drive.episodes import begin, made, write
from workbench.episodes.document import write_into_description
from workbench.episodes.episode import EpisodeInfo
from workbench.episodes.reader.read_episode import read_episode
from workbench.episodes.recorded_source import reference_of
from workbench.episodes.seal import KEY_FILE, InstallationSeal, made_here
from workbench.episodes.writing.finish_or_recover import recover
from workbench.machine.folders import user_folder
from workbench.review.recorded_scene import SceneError, SceneProcess
from workbench.task.content import read_content
from workbench.task.reference import RecordedTask
from workbench.trust.clearance import (
    Clearances,
    CodeToRun,
    Consent,
    NotCleared,
    Since,
    TrustQuestion,
    paths_in_arguments,
)
from workbench.trust.store import TrustStore

pytestmark = pytest.mark.thorough

TEXT = "import helper\nclass Push: ...\n"


class Answering:
    """Gives a fixed answer and records the questions."""

    def __init__(self, answer: Consent = Consent.NO) -> None:
        self.answer, self.asked = answer, list[TrustQuestion]()

    def __call__(self, question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        self.asked.append(question)
        return self.answer


@pytest.fixture(autouse=True)
def own_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    another_user(tmp_path / "config", monkeypatch)


def another_user(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Switch to an installation that made none of the recordings."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """The .json of a recording, with its task file and a module next to it."""
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "push.py").write_text(TEXT)
    (folder / "helper.py").write_text("A = 1\n")
    texts = {str(folder / name): (folder / name).read_text() for name in ("push.py", "helper.py")}
    episode = made(2, source_file=str(folder / "push.py"), source=texts, env_kwargs={"robot_uids": "panda"})
    return write(folder / "recordings", episode, pictures=False)


@pytest.fixture
def foreign(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    another_user(tmp_path / "another", monkeypatch)
    return recording


def info_of(recording: Path) -> EpisodeInfo:
    return read_episode(recording).info


def text_of(info: EpisodeInfo) -> CodeToRun:
    return CodeToRun(reference_of(info), info, recorded_text=True)


def todays(recording: Path) -> CodeToRun:
    return replace(text_of(info_of(recording)), recorded_text=False)


def as_recorded(recording: Path) -> CodeToRun:
    return text_of(info_of(recording))


def asked(wanted: CodeToRun, answer: Consent = Consent.NO) -> list[TrustQuestion]:
    person = Answering(answer)
    try:
        Clearances(ask=person).clear(wanted)
    except NotCleared:
        assert answer is Consent.NO
    return person.asked


def edit(recording: Path, **values: Any) -> None:
    document = json.loads(recording.read_bytes()) | {"workbench_checksum": None}
    document["workbench"].update(values)
    recording.write_text(json.dumps(document))


# --- when the user is asked ------------------------------------------------------------------------------------


def test_a_local_recording_needs_no_question_even_if_its_file_has_changed(recording: Path) -> None:
    assert made_here(info_of(recording)) is InstallationSeal.CONTENT_AND_PLACE
    file = recording.parents[1] / "push.py"
    file.write_text(f"{TEXT}# edited since\n")
    assert Clearances().clear(todays(recording)) == str(file)
    assert asked(as_recorded(recording)) == []
    write_into_description(recording, ("good",), "a note")
    assert asked(todays(recording)) == [] and asked(as_recorded(recording)) == []


def test_a_local_recording_vouches_only_for_its_own_file(recording: Path, tmp_path: Path) -> None:
    other = listed(tmp_path, "evil\n")
    wanted = CodeToRun(RecordedTask("push.py", str(other)), info_of(recording))
    (question,) = asked(wanted)
    assert question.file == str(other)


def test_a_foreign_recording_asks_with_file_hash_and_modules(child_process: None, foreign: Path) -> None:
    file = foreign.parents[1] / "push.py"
    (question,) = asked(todays(foreign))
    assert question.file == str(file) and not question.trusted_before and not question.followed
    assert [one.name for one in question.modules] == ["helper.py"]
    assert [one.text for one in question.files] == [TEXT, "A = 1\n"]
    file.write_bytes(TEXT.replace("\n", "\r\n").encode())  # the same text in other bytes
    (question,) = asked(todays(foreign))
    paths = (file, file.with_name("helper.py"))
    said = subprocess.run(["sha256sum", *paths], capture_output=True, text=True, check=True).stdout
    assert [one.hash for one in question.files] == [line[:12] for line in said.splitlines()]
    (question,) = asked(as_recorded(foreign))
    assert (question.file, question.task, question.recorded_text) == ("push.py", "Push-v1", True)


def test_without_a_user_to_ask_the_answer_is_no(foreign: Path) -> None:
    for wanted in (todays(foreign), as_recorded(foreign)):
        with pytest.raises(NotCleared, match=r"push\.py .* was not allowed to run") as refused:
            Clearances().clear(wanted)
        assert refused.value.question is not None
        assert Clearances(all_trusted=True).clear(wanted)
    assert not TrustStore().trusts(read_content(foreign.parents[1] / "push.py")), "--trust stores nothing"


def test_a_file_named_by_the_user_needs_no_question(foreign: Path) -> None:
    file = foreign.parents[1] / "push.py"
    assert Clearances(lambda: [file]).clear(todays(foreign)) == str(file)
    assert Clearances().clear(CodeToRun("any_file.py", info_of(foreign))) == "any_file.py"
    installed = RecordedTask("PickCube-v1")
    assert Clearances().clear(CodeToRun(installed, info_of(foreign))) == installed


def test_an_answer_applies_to_the_same_texts_anywhere(foreign: Path, tmp_path: Path) -> None:
    file, helper = foreign.parents[1] / "push.py", foreign.parents[1] / "helper.py"
    clearances = Clearances(ask=Answering(Consent.ONCE))
    cleared = clearances.clear(todays(foreign))
    assert isinstance(cleared, RecordedTask) and cleared.approved == {str(file): TEXT, str(helper): "A = 1\n"}
    clearances.clear(todays(foreign))
    assert len(asked(todays(foreign))) == 1, "another run asks again"
    assert len(asked(todays(foreign), Consent.ALWAYS)) == 1
    assert asked(todays(foreign)) == [] and asked(as_recorded(foreign)) == [], "the same texts"
    copy = tmp_path / "copy"
    shutil.copytree(file.parent, copy)
    assert asked(todays(copy / "recordings" / foreign.name)) == [], "the same texts elsewhere"
    helper.write_text("A = 2\n")
    assert since(foreign) == {"push.py": Since.SAME, "helper.py": Since.CHANGED}
    helper.write_text("A = 1\n")
    (file.parent / "zebra.py").write_text("")
    file.write_text(f"{TEXT}import zebra\n")
    found = since(foreign)
    assert found == {"push.py": Since.CHANGED, "helper.py": Since.SAME, "zebra.py": Since.NEW}
    assert list(found) == ["push.py", "zebra.py", "helper.py"], "new files come first"
    file.write_text("class Push: ...\n")
    assert since(foreign) == {"push.py": Since.CHANGED} and asked(todays(foreign))[0].gone == ("helper.py",)
    file.write_text(TEXT)
    assert asked(todays(foreign)) == []


def since(recording: Path) -> dict[str, Since]:
    """Change of each file since it was trusted, from the only question about the recording."""
    (question,) = asked(todays(recording))
    assert question.trusted_before and not question.nothing_known
    return {Path(one.name).name: one.since for one in question.files}


def test_following_a_file_is_a_separate_question(foreign: Path, tmp_path: Path) -> None:
    live = replace(todays(foreign), followed=True)
    (question,) = asked(todays(foreign), Consent.ALWAYS)
    assert not question.followed and not question.agreed
    (question,) = asked(live)
    assert question.followed and question.agreed and not question.trusted_before
    person = Answering(Consent.ONCE)
    clearances = Clearances(ask=person)
    assert isinstance(clearances.clear(live), RecordedTask) and clearances.clear(live)
    assert len(person.asked) == 1, "the answer holds until the program ends"
    assert len(asked(live, Consent.ALWAYS)) == 1 and asked(live) == []
    copy = tmp_path / "copy"
    shutil.copytree(foreign.parents[1], copy)
    there = todays(copy / "recordings" / foreign.name)
    assert asked(there) == []
    assert len(asked(replace(there, followed=True))) == 1, "saves of this copy were not agreed to"
    assert Clearances(all_trusted=True).clear(live)


def test_an_answer_about_a_file_that_changed_meanwhile_runs_nothing(foreign: Path) -> None:
    file = foreign.parents[1] / "push.py"

    def ask(question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        file.with_name("helper.py").write_text("A = 3\n")
        return Consent.ONCE

    with pytest.raises(NotCleared, match="changed while you were asked about it; try again"):
        Clearances(ask=ask).clear(todays(foreign))


@pytest.mark.parametrize("env_id", ["/w/evil.py", "evil.py:Evil", "..\\evil"])
def test_a_path_instead_of_an_id_is_never_opened_and_the_refusal_has_advice(
    foreign: Path, env_id: str
) -> None:
    wanted = CodeToRun(RecordedTask(env_id), info_of(foreign))
    with pytest.raises(NotCleared, match="never opened: .* with --task FILE"):
        Clearances(all_trusted=True).clear(wanted)


@pytest.mark.parametrize(
    "values",
    [
        {"env_kwargs": {"episode_json": "/etc/passwd"}},
        {"reset_options": {"~/model": 1}},
        {"env_kwargs": {"model": "evil.urdf"}},
    ],
)
def test_foreign_arguments_cannot_name_files(
    foreign: Path, values: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(foreign.parent)
    (foreign.parent / "evil.urdf").write_text("")
    file = foreign.parents[1] / "push.py"
    edit(foreign, **values)
    for wanted in (todays(foreign), as_recorded(foreign), CodeToRun(str(file), info_of(foreign))):
        with pytest.raises(NotCleared, match="names files .*--trust") as refused:
            Clearances(ask=Answering(Consent.ALWAYS)).clear(wanted)
        assert refused.value.trust_helps
        Clearances(all_trusted=True).clear(wanted)
    (scene,) = SceneProcess()([read_episode(foreign)], lambda: None, lambda *_: None)
    assert isinstance(scene, SceneError) and "only numbers and curves" in str(scene)


# --- the seal ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {"task": "Other-v1"},
        {"source": {"push.py": "evil", "helper.py": "A = 1\n"}},
        {"env_kwargs": {"robot_uids": "evil"}},
        {"side_files": {"mesh.obj": "0" * 12}},
        {"made_here": None},
        {"made_here": {"content": "0" * 64, "place": "0" * 64}},
    ],
)
def test_an_edited_recording_loses_its_seal(recording: Path, values: dict[str, Any]) -> None:
    assert json.loads(recording.read_bytes())["workbench"]["made_here"]["content"]
    edit(recording, **values)
    assert made_here(info_of(recording)) is InstallationSeal.NO
    if "source" in values:
        assert len(asked(as_recorded(recording))) == 1


def test_a_returned_recording_with_a_changed_file_next_to_it_asks(recording: Path, tmp_path: Path) -> None:
    back = tmp_path / "back"
    shutil.copytree(recording.parents[1], back)
    returned = back / "recordings" / recording.name
    shutil.rmtree(recording.parents[1])
    assert made_here(info_of(returned)) is InstallationSeal.CONTENT
    cleared = Clearances().clear(todays(returned))
    assert isinstance(cleared, RecordedTask) and cleared.file == str(back / "push.py")
    (back / "helper.py").write_text("evil\n")
    assert len(asked(todays(returned))) == 1
    assert asked(as_recorded(returned)) == []


def test_a_foreign_journal_is_recovered_without_a_seal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = str(tmp_path / "push.py")
    for folder, is_ours in ((tmp_path / "ours", True), (tmp_path / "theirs", False)):
        begin(folder, made(3, source_file=file, source={file: "x"}))
        if not is_ours:
            another_user(tmp_path / "another", monkeypatch)
        (files,) = recover(folder)
        assert (made_here(info_of(files.json)) is not InstallationSeal.NO) is is_ours


# --- storage of the key and of the answers --------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["", "no key\n", None])
def test_without_the_key_a_recording_is_foreign_and_the_next_gets_a_new_key(
    recording: Path, key: str | None, tmp_path: Path
) -> None:
    path = user_folder() / KEY_FILE
    path.unlink() if key is None else path.write_text(key)
    assert len(asked(todays(recording))) == 1
    again = write(tmp_path / "again", made(2), pictures=False)
    assert made_here(info_of(again)) is not InstallationSeal.NO and len(path.read_text()) == 64
    assert path.with_name(f"{KEY_FILE}.broken").exists() is (key is not None)


# --- a file that was chosen from a list -----------------------------------------------------------


def listed(tmp_path: Path, text: str = TEXT) -> Path:
    folder = tmp_path / "elsewhere"
    folder.mkdir(exist_ok=True)
    (folder / "push.py").write_text(text)
    (folder / "helper.py").write_text("A = 1\n")
    return folder / "push.py"


def test_a_listed_file_asks_once_with_its_text_and_modules(tmp_path: Path) -> None:
    file, person = listed(tmp_path), Answering(Consent.ALWAYS)
    cleared = Clearances(ask=person).clear_file(file, "Push")
    assert isinstance(cleared, RecordedTask)
    assert str(cleared) == f"{file}:Push" and cleared.approved == read_content(file).texts
    (question,) = person.asked
    assert question.listed and question.followed and not question.recorded_text
    assert [one.name for one in question.files] == [str(file), "helper.py"] and question.files[0].text == TEXT
    # Also in a later run.
    Clearances(ask=person).clear_file(file)
    assert len(person.asked) == 1
    listed(tmp_path, TEXT + "# another\n")
    Clearances(ask=person).clear_file(file)
    assert len(person.asked) == 2 and person.asked[1].files[0].since is Since.CHANGED


def test_a_refusal_of_all_is_not_asked_again_and_a_refusal_of_one_is_for_its_text_only(foreign: Path) -> None:
    info = info_of(foreign)
    codes = [
        text_of(replace(info, source={file: f"{text}# {number}\n" for file, text in info.source.items()}))
        for number in (1, 2, 2, 3)
    ]
    for answer, questions in ((Consent.NONE, 1), (Consent.NO, 3)):
        person = Answering(answer)
        cleared = Clearances(ask=person).clear_all(codes)
        assert all(isinstance(one, NotCleared) for one in cleared) and len(cleared) == len(codes)
        assert [question.more for question in person.asked] == [2, 1, 0][:questions]


def test_no_opens_nothing_and_once_lasts_for_this_run(tmp_path: Path) -> None:
    file, person = listed(tmp_path), Answering(Consent.NO)
    clearances = Clearances(ask=person)
    with pytest.raises(NotCleared, match="was not allowed to run"):
        clearances.clear_file(file)
    person.answer = Consent.ONCE
    clearances.clear_file(file)
    clearances.clear_file(file)
    assert len(person.asked) == 2
    person.answer = Consent.NO
    with pytest.raises(NotCleared):
        Clearances(ask=person).clear_file(file)
    with pytest.raises(NotCleared):
        Clearances().clear_file(listed(tmp_path, TEXT + "#\n"))


def test_a_file_that_the_user_named_and_that_cannot_be_read_or_changes_meanwhile(tmp_path: Path) -> None:
    file, person = listed(tmp_path), Answering(Consent.ALWAYS)
    link = tmp_path / "link.py"
    link.symlink_to(file)
    for clearances in (Clearances(lambda: [link], person), Clearances(ask=person, all_trusted=True)):
        assert clearances.clear_file(file) == str(file)
        assert clearances.clear_file(file, "Push") == f"{file}:Push"
    assert person.asked == [] and Clearances(ask=person).asks and not Clearances().asks
    with pytest.raises(NotCleared) as refused:
        Clearances(ask=person).clear_file(tmp_path / "gone.py")
    assert refused.value.question is None and person.asked == []

    def edit_and_agree(question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        file.write_text("evil\n")
        return Consent.ONCE

    with pytest.raises(NotCleared, match="try again"):
        Clearances(ask=edit_and_agree).clear_file(file)


def test_a_file_that_may_run_is_asked_about_only_for_its_saves(foreign: Path) -> None:
    helper = foreign.parents[1] / "helper.py"
    for text in ("A = 2\n", "A = 1\n"):  # two versions may run
        helper.write_text(text)
        asked(todays(foreign), Consent.ALWAYS)
    (question,) = asked(replace(todays(foreign), followed=True))
    assert question.agreed and not question.trusted_before
    person = Answering(Consent.ALWAYS)
    Clearances(ask=person).clear_file(foreign.parents[1] / "push.py")
    (question,) = person.asked
    assert question.agreed and question.followed and not question.trusted_before and not question.task


def test_each_recording_gets_the_answer_to_its_own_text(foreign: Path) -> None:
    """Five recordings: two of one text, one that needs no question, one refused, and one without a text."""
    info = info_of(foreign)

    def code(text: str) -> CodeToRun:
        return text_of(replace(info, source={file: f"{text} # {file}\n" for file in info.source}))

    codes = [code("yes"), CodeToRun("PickCube-v1", info), code("no"), code("yes"), code("yes too")]
    codes.append(text_of(replace(info, source={})))
    questions: list[TrustQuestion] = []

    def ask(question: TrustQuestion, stopped: Callable[[], bool]) -> Consent:
        questions.append(question)
        return Consent.ONCE if question.files[0].text.startswith("yes") else Consent.NO

    cleared = Clearances(ask=ask).clear_all(codes)
    assert [isinstance(one, NotCleared) for one in cleared] == [False, False, True, False, False, True]
    assert cleared[1] == "PickCube-v1" and cleared[0] is codes[0].reference
    assert [question.more for question in questions] == [2, 1, 0]
    refused, lacking = cleared[2], cleared[5]
    assert isinstance(refused, NotCleared) and refused.question == questions[1]
    assert isinstance(lacking, NotCleared) and lacking.question is None and not lacking.trust_helps


def test_a_call_that_was_stopped_asks_nothing(foreign: Path) -> None:
    person = Answering(Consent.ALWAYS)
    with pytest.raises(NotCleared):
        Clearances(ask=person).clear(todays(foreign), lambda: True)
    assert person.asked == [] and len(asked(todays(foreign))) == 1


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ({"robot_uids": "panda", "size": 0.5, "flag": True, "none": None, "dots": "v1.0"}, []),
        ({"a": [{"b": ("../c", "d")}], "e": {"f\\g": 1}}, ["../c", "f\\g"]),
        ({"a": "~/x", "b": "a\0.b", "c": "here.urdf", "d": "gone.urdf"}, ["~/x", "here.urdf"]),
    ],
)
def test_texts_that_look_like_paths_are_found_wherever_they_are(
    foreign: Path, arguments: dict[str, Any], found: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(foreign.parent)
    (foreign.parent / "here.urdf").touch()
    info = info_of(foreign)
    for given in ({"env_kwargs": arguments}, {"env_kwargs": {}, "reset_options": arguments}):
        assert sorted(paths_in_arguments(replace(info, **given))) == sorted(found)
    assert paths_in_arguments(replace(info, env_kwargs={}, control_mode="/x")) == ["/x"]


def test_only_the_newest_answers_know_their_files(foreign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of older answers, only the hash is kept, so the question cannot mark what has changed."""
    monkeypatch.setattr("workbench.trust.store.MAX_ENTRIES_WITH_FILES", 2)
    monkeypatch.setattr("workbench.trust.store.MAX_ENTRIES", 3)
    helper = foreign.parents[1] / "helper.py"
    contents = []
    for number in range(4):
        helper.write_text(f"A = {number}\n")
        contents.append(read_content(foreign.parents[1] / "push.py"))
        TrustStore().trust(contents[-1])
    for _ in range(3):
        TrustStore().trust(contents[1])
    kept = TrustStore()
    assert [kept.trusts(one) for one in contents] == [False, True, True, True]
    assert kept.trusted_before(contents[0]) == contents[1].file_sums, "the newest answer"
    assert kept.trusted_before(contents[1]) == contents[3].file_sums
    helper.write_text("A = 9\n")
    for number in range(2):
        TrustStore().trust(replace(contents[0], main=f"/other{number}.py", texts={f"/other{number}.py": ""}))
    (question,) = asked(todays(foreign))
    assert question.trusted_before and question.nothing_known
