"""Links that open the author's editor: which URL templates are accepted, and which files are linked."""

from __future__ import annotations

from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from workbench.page.widgets.editor_links import EDITORS, editor_link, parse_editor
from workbench.page.widgets.templates import render

REMOTE = "vscode://vscode-remote/ssh-remote+lab{file}:{line}"


def test_a_url_template_is_used_unchanged_with_file_and_line() -> None:
    link = editor_link(parse_editor(REMOTE), "/home/me/push it.py", 88, lambda path: True)
    assert link.address == "vscode://vscode-remote/ssh-remote+lab/home/me/push%20it.py:88"
    assert link.copied == "/home/me/push it.py:88" and not link.new_tab
    web = editor_link("http://127.0.0.1:63342/api/file{file}:{line}", "/a.py", None, lambda path: True)
    assert web.address.endswith("/a.py:1") and web.new_tab


@pytest.mark.parametrize(
    "text",
    [
        "javascript:alert('{file}')",
        "JavaScript:{file}",
        " javascript:{file}",
        "java\nscript:{file}",
        "data:text/html,{file}",
        "vbscript:{file}{line}",
        "file://{file}",
        "{file}",
        "/usr/bin/code {file}",
        "vscode://file",
        "emacs",
        "",
    ],
)
def test_a_script_or_an_invalid_url_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="--editor takes vscode, cursor, pycharm, none or an address"):
        parse_editor(text)


def test_only_files_that_the_server_knows_are_linked() -> None:
    known = {"/home/me/push.py"}.__contains__
    assert (
        editor_link(EDITORS["vscode"], "/home/me/push.py", 3, known).address
        == "vscode://file/home/me/push.py:3"
    )
    for file in ("/etc/passwd", "/home/me/../me/push.py", None):
        assert editor_link(EDITORS["vscode"], file, 3, known).address == ""
    assert editor_link(EDITORS["none"], "/home/me/push.py", 3, known).address == ""


@given(
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="/\0"), min_size=1).filter(
        lambda name: name not in (".", "..")  # names of folders
    )
)
def test_any_file_name_stays_one_path_and_cannot_escape_its_attribute(name: str) -> None:
    link = editor_link(EDITORS["vscode"], f"/home/me/{name}", 7, lambda path: True)
    parts = urlsplit(link.address)
    assert (parts.scheme, parts.netloc, parts.query, parts.fragment) == ("vscode", "file", "", "")
    assert unquote(parts.path) == f"/home/me/{name}:7"
    problem = SimpleNamespace(file=f"/home/me/{name}", line=7, code="", message="", traceback="")
    html = render("banner", subject="", doing="", problem=problem, kept="", link=lambda file, line: link)
    assert html.count("<a ") == 1 and html.count('href="vscode://file/home/me/') == 1
    assert "<script" not in html
