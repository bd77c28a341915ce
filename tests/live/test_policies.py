"""The list of policies: when it is read, how it follows the folder, and what is kept for the next run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.drive.session import FakeWorkerSession
from tests.drive.waiting import until
from workbench.live import policies
from workbench.live.commands import ChooseActions, SetPolicy
from workbench.live.events import FileSaved, PagesCounted
from workbench.live.messages import Settings
from workbench.live.policies import KnownPolicies, ListPolicies, PoliciesListed, Wanted, apply
from workbench.live.run import first_run
from workbench.machine.preferences import used_policies
from workbench.task.description import TaskOptions

ACT = "def act(obs):\n    pass\n"


def test_policies_are_listed_while_a_page_is_open_and_policies_act() -> None:
    run = first_run("push.py", TaskOptions(), 1, Settings(action_source="policy"))
    folder = Path.cwd()
    known, effects = apply(KnownPolicies(), FileSaved(), run)
    assert effects == []
    known, effects = apply(known, FileSaved(), replace(run, pages=1))
    assert effects == [ListPolicies(Wanted(folder, None))]
    known, effects = apply(known, PoliciesListed(("a.py:act",)), replace(run, pages=2))
    assert known.found == ("a.py:act",) and effects == []
    acts = replace(run, pages=1, settings=Settings(action_source="policy", policy="a.py:act"))
    known, effects = apply(known, FileSaved(), acts)
    assert effects == [ListPolicies(Wanted(folder, "a.py:act"))]
    for changed in (replace(acts, pages=0), replace(acts, settings=Settings())):
        after, effects = apply(known, FileSaved(), changed)
        assert effects == [ListPolicies(None)] and after.found == known.found
        assert apply(after, FileSaved(), changed) == (after, [])


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of the command; must be requested before `fake`."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setattr(policies, "LIST_SECONDS", 0.02)
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    return here


def test_the_list_follows_the_folder_and_a_used_policy_is_kept(here: Path, fake: FakeWorkerSession) -> None:
    def listed(*wanted: str) -> None:
        until(lambda: fake.view.known_policies == wanted, f"{wanted}", seen=lambda: fake.view.known_policies)

    (here / "b.py").write_text(ACT)
    fake.session.dispatch(PagesCounted(1))
    fake.session.do(ChooseActions(source="policy"))
    listed("b.py:act")
    (here / "a.py").write_text(ACT)
    listed("a.py:act", "b.py:act")
    fake.session.do(SetPolicy(policy="b.py:act"))
    listed("b.py:act", "a.py:act")
    assert used_policies(here) == ("b.py:act",)
    fake.session.do(SetPolicy(policy="not_there.py:act"))
    (here / "c.py").write_text(ACT)
    listed("b.py:act", "a.py:act", "c.py:act")
    assert used_policies(here) == ("b.py:act",), "a missing policy is not kept"
    (here / "b.py").unlink()
    listed("a.py:act", "c.py:act")
