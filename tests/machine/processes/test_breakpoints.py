"""``breakpoint()`` without a terminal raises at its own line, unless PYTHONBREAKPOINT says otherwise."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from workbench.machine.processes.child_environment import child_environment, python_command

pytestmark = pytest.mark.usefixtures("child_process")

BEGIN = "from workbench.machine.processes.debugger import refuse_breakpoints\nrefuse_breakpoints('remove this line')\n"


@pytest.mark.parametrize(
    ("named", "call", "raises"),
    [
        ("", "breakpoint()", True),
        ("0", "breakpoint()", False),
        ("0", "from pdb import set_trace\nset_trace(header='here')", True),
    ],
)
def test_breakpoint_raises_at_its_line_or_follows_pythonbreakpoint(
    named: str, call: str, raises: bool, tmp_path: Path
) -> None:
    file = tmp_path / "task.py"
    file.write_text(f"{BEGIN}{call}\nprint('went on')\n")
    done = subprocess.run(
        python_command(str(file)),
        env=child_environment(PYTHONBREAKPOINT=named),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert ("went on" in done.stdout) != raises
    line = len(BEGIN.splitlines()) + len(call.splitlines())
    assert (f"line {line}, in <module>\n    {call.splitlines()[-1]}" in done.stderr) == raises
