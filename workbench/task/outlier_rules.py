"""Rules that outliers of a loaded task break, and the hooks that these rules guard."""

from __future__ import annotations

import linecache

from workbench.envs.gpu_rules import Degree, Finding, silence_of
from workbench.envs.outliers import OUTLIER_RULES
from workbench.task.load import LoadedTask
from workbench.task.problem import hook_definition

_OTHER_HOOKS = {
    "reward-finite": ("compute_normalized_dense_reward", "compute_sparse_reward"),
    "reward-normalized": ("compute_dense_reward", "compute_sparse_reward"),
    "bodies-stay": (
        "_initialize_episode",
    ),  # authors do not write `step`: a body that flies off was placed in a reset
}
"""Hooks to blame, in order, if the author has not defined the rule's own hook."""


def rules_of_outliers(loaded: LoadedTask, choice: Degree | None) -> dict[str, Finding]:
    """The rules that an outlier can break, by id. Each value is a template of a finding, placed at the hook
    that the rule guards. Rules that are off, or silenced at the hook, are left out.

    Args:
        choice: degree of all rules; None for each rule's own degree.
    """
    found: dict[str, Finding] = {}
    for name in sorted(OUTLIER_RULES):
        rule = OUTLIER_RULES[name]
        degree = choice or rule.degree
        definition = hook_definition(
            loaded.cls, (rule.hook, *_OTHER_HOOKS.get(name, ())), loaded.source_files
        )
        hook, (file, line) = ("", (None, None)) if definition is None else definition
        if degree == "off" or silence_of(file, line, name) is not None:
            continue
        code = "" if file is None or line is None else linecache.getline(file, line).strip()
        found[name] = Finding(name, degree, "", file, line, code, hook, 0, 0)
    return found
