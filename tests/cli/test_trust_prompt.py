"""The question in a terminal, as it is printed."""

from __future__ import annotations

import io

from rich.console import Console

from workbench.cli.output import print_question, print_texts
from workbench.trust.clearance import CodeFile, Since, TrustQuestion

MANY = tuple(CodeFile(f"m{k}.py", f"{k:012}", "") for k in range(60))


def printed(question: TrustQuestion, what: object = print_question) -> str:
    out = io.StringIO()
    assert callable(what)
    what(question, Console(file=out, width=80))
    return out.getvalue()


def test_every_file_is_named_with_its_hash_and_what_became_of_it() -> None:
    main = CodeFile("/w/push.py", "a" * 12, "", Since.CHANGED)
    said = printed(TrustQuestion("Push-v1", False, (main, *MANY), trusted_before=True, gone=("old.py",)))
    lines = said.splitlines()
    assert f"    /w/push.py  {main.hash}  changed since" in lines
    assert all(f"    {one.name}  {one.hash}" in lines for one in MANY)
    assert "It imports these modules next to it:" in lines and "removed since: old.py" in said
    said = printed(TrustQuestion("Push-v1", False, (main, *MANY), computed=True))
    assert "it may import every module next to it" in said and "It imports" not in said


def test_a_text_is_printed_as_it_is_and_no_more_than_text() -> None:
    text = "x = '[bold] :x: \x1b[2J \u202e'\n\treturn 1\n"
    said = printed(TrustQuestion("Push-v1", True, (CodeFile("push.py", "0" * 12, text),)), print_texts)
    assert r"x = '[bold] :x: \x1b[2J \u202e'" in said and "\x1b" not in said and "return 1" in said
