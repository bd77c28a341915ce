"""The source of actions on the Run tab: which policies can be chosen."""

from __future__ import annotations

from tests.drive.live import Live
from tests.drive.scenes import running
from workbench.live.commands import SetPolicy
from workbench.live.messages import Settings
from workbench.live.panels.run_panel import CHOOSE


def test_a_policy_is_chosen_from_the_known_ones_while_policies_act(live_page: Live) -> None:
    known = ("a.py:act", "b.py:act")

    def draw(source: str, policy: str | None = None, known: tuple[str, ...] = known) -> None:
        settings = Settings(action_source=source, policy=policy)  # type: ignore[arg-type]
        live_page.show(running(2, settings=settings, known_policies=known))

    draw("policy", known=())
    assert live_page.shows("Policy") and not live_page.shows("Known")
    draw("policy", "b.py:act")
    assert [*live_page.field("Known").options.values()] == ["", *known]
    assert live_page.typed("Known") == live_page.typed("Policy") == "b.py:act"
    draw("policy", "mine:act")
    assert live_page.typed("Known") == CHOOSE
    live_page.set("Known", "a.py:act")
    assert live_page.session.asked[-1] == SetPolicy(policy="a.py:act")
    draw("random")
    assert not live_page.shows("Policy") and not live_page.shows("Known")
