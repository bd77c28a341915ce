"""A camera's settings written into the author's file, as the smallest edit that says them.

Text in, text out, in the server process, which executes nothing of the author's and imports no simulator. What it knows
of the cameras, and the proof of an edit, comes from a worker that runs the hooks with a text (`Run`; there it is
`run_hooks`). `plan_edit` and its siblings give a `SourceEdit`, to be shown and then handed to `apply`, or a `Refusal`
with the reason and a snippet to copy.
"""

from workbench.authoring.camera_source.disk import apply, not_writable, revert
from workbench.authoring.camera_source.hooks import snippet
from workbench.authoring.camera_source.members import (
    override_text,
    plan_add,
    plan_duplicate,
    plan_override,
    plan_remove,
    plan_rename,
)
from workbench.authoring.camera_source.plan import plan_edit
from workbench.authoring.camera_source.result import Refusal, SourceEdit

__all__ = [
    "Refusal",
    "SourceEdit",
    "apply",
    "not_writable",
    "override_text",
    "plan_add",
    "plan_duplicate",
    "plan_edit",
    "plan_override",
    "plan_remove",
    "plan_rename",
    "revert",
    "snippet",
]
