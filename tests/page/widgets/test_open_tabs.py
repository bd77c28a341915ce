"""Which pages have which tab open."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

from workbench.page.widgets.open_tabs import OpenTabs
from workbench.page.widgets.visitors import Visitor


@dataclass
class Stub:
    """The open pages."""

    pages: list[Visitor] = field(default_factory=list)

    def all(self) -> list[Visitor]:
        return self.pages

    def comes(self, number: int) -> Visitor:
        page = Visitor(f"page {number}", cast(Any, type("", (), {"client_id": number})()))
        self.pages.append(page)
        return page


def test_a_tab_may_be_shown_until_every_page_has_reported_another() -> None:
    stub = Stub()
    tabs = OpenTabs(cast(Any, stub))
    assert tabs.may_show("Run") and tabs.pages_at("Run") == set() and not tabs.shows("on this tab", "Run")
    one, two = stub.comes(1), stub.comes(2)
    tabs.said(one, "Cameras")
    assert tabs.may_show("Run"), "the other page has not reported yet"
    tabs.said(two, "Cameras")
    assert not tabs.may_show("Run") and tabs.may_show("Cameras")
    assert tabs.pages_at("Cameras") == {1, 2}
    tabs.said(two, "Run")
    assert (tabs.pages_at("Cameras"), tabs.pages_at("Run")) == ({1}, {2})
    assert tabs.may_show("Run") and tabs.may_show("Cameras")
    for where, shown in (("off", False), ("on this tab", True), ("on all tabs", True)):
        assert tabs.shows(cast(Any, where), "Run") is shown
    assert not tabs.shows("on this tab", "Log") and tabs.shows("on all tabs", "Log")
    stub.pages.remove(two)
    assert tabs.pages_at("Run") == set() and not tabs.may_show("Run")
