"""The trust question as printed in a terminal."""

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


def test_every_file_is_named_with_its_hash_and_its_change() -> None:
    main = CodeFile("/w/push.py", "a" * 12, "", Since.CHANGED)
    output = printed(TrustQuestion("Push-v1", False, (main, *MANY), trusted_before=True, gone=("old.py",)))
    lines = output.splitlines()
    assert f"    /w/push.py  {main.hash}  changed since" in lines
    assert all(f"    {one.name}  {one.hash}" in lines for one in MANY)
    assert "It imports these modules next to it:" in lines and "removed since: old.py" in output
    output = printed(TrustQuestion("Push-v1", False, (main, *MANY), computed=True))
    assert "it may import every module next to it" in output and "It imports" not in output


def test_a_file_is_printed_unchanged_and_as_plain_text() -> None:
    text = "x = '[bold] :x: \x1b[2J \u202e'\n\treturn 1\n"
    output = printed(TrustQuestion("Push-v1", True, (CodeFile("push.py", "0" * 12, text),)), print_texts)
    assert r"x = '[bold] :x: \x1b[2J \u202e'" in output and "\x1b" not in output and "return 1" in output
