"""Mutation testing: plants single mistakes in a module and runs the tests that protect it on each.

Not a test: ``make mutants MODULES="page/door/access envs/snapshots/snapshot"`` runs it, ``MODULES=all`` all of `PROTECTED`. Cosmic Ray
makes the mutants; this script selects them, runs them in a copy of the tree, and knows which tests should find them.
"""

# pyright: reportMissingImports=false
# Only `make mutants` installs Cosmic Ray, not the set-up for lint and tests.

from __future__ import annotations

import argparse
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator
from parso.python.tree import Keyword

ROOT = Path(__file__).resolve().parents[1]
LAST_RESULTS = ROOT / "build" / "mutants"
"""Results of the last run, a file per module: ``--lived`` reruns the mutants that lived."""
MIN_KILLED_PERCENT = 85
"""Percentage of a module's mutants that must be killed."""

PROTECTED = {
    "episodes/writing/journal": "episodes/writing/test_journal.py",
    "episodes/reader/episode_wire": "episodes/test_episode_wire.py",
    "episodes/writing/finish_or_recover": "episodes/writing/test_recover.py episodes/writing/test_finish_or_recover.py",
    "library/trash": "library/test_trash.py",
    "episodes/document": "episodes/test_document.py episodes/test_checksums.py",
    "episodes/reader/reading": "episodes/reader/test_sources.py",
    "episodes/writing/from_journal": "episodes/writing/test_recover.py episodes/writing/test_episode_writer.py",
    "library/folder": "library/test_library.py -k 'not two_processes and not follows_the_folder'",
    "library/index": "library/test_index.py",
    "episodes/seal": "trust/test_clearance.py episodes/test_document.py",
    "episodes/writing/episode_writer": "episodes/writing/test_episode_writer.py",
    "machine/files": "episodes/test_new_file.py episodes/test_tags.py episodes/writing/test_publish.py"
    " machine/test_folders.py task/test_write_edits.py",
    "task/registry": "task/test_registry.py",
    "task/modules": "task/test_load.py task/test_task_content.py task/test_library_names.py"
    " task/test_named_modules.py",
    "source/parsed": "cameras/edit/test_which_camera.py cameras/edit/test_edits.py source/test_read_values.py",
    "source/read_values": "source/test_read_values.py cameras/edit/test_edits.py"
    " cameras/edit/test_which_camera.py",
    "source/traced_edits": "cameras/edit/test_edits.py cameras/edit/test_which_camera.py cameras/edit/test_rotations.py",
    "source/definitions": "source/test_read_values.py cameras/edit/test_edits.py"
    " cameras/edit/test_which_camera.py",
    "task/write_edits": "task/test_write_edits.py",
    "cameras/edit/camera_edit": "cameras/edit/test_which_camera.py cameras/edit/test_edits.py",
    "cameras/edit/plan": "cameras/edit/test_which_camera.py cameras/edit/test_edits.py",
    "cameras/edit/run_hooks": "cameras/edit/test_which_camera.py cameras/edit/test_edits.py",
    "task/copy": "task/test_copy_task.py",
    "task/watch": "task/test_watch.py",
    "envs/snapshots/snapshot": "envs/snapshots/test_snapshot.py",
    "envs/partial_reset": "envs/test_partial_reset.py",
    "envs/task_env": "envs/test_task_env.py",
    "envs/simulation/contact_queries": "envs/simulation/test_contact_queries.py",
    "envs/simulation/mirrors": "envs/simulation/test_batched_cpu.py envs/test_written_for_the_cpu.py envs/test_strict.py",
    "envs/simulation/cpu_system": "envs/simulation/test_batched_cpu.py envs/test_gpu_members.py envs/simulation/test_stepping.py envs/test_strict.py",
    "envs/simulation/strict_system": "envs/test_strict.py",
    "envs/scene/scene_index": "envs/scene/test_scene_index.py envs/test_state_columns.py envs/scene/test_merged_structs.py",
    "pictures/camera_report": "pictures/test_report.py",
    "envs/snapshots/packing": "envs/snapshots/test_packing.py",
    "envs/snapshots/task_state": "envs/snapshots/test_task_state.py",
    "envs/kept_rows": "envs/test_kept_rows.py",
    "envs/simulation/accessors": "envs/test_strict.py envs/test_written_for_the_cpu.py",
    "envs/outliers": "envs/test_outlier_watch.py",
    "envs/evaluate_entries": "envs/test_evaluate_entries.py task/test_return_problems.py",
    "envs/snapshots/cpu_state": "envs/snapshots/test_snapshot.py envs/snapshots/test_fresh_physics.py",
    "envs/state_columns": "envs/test_state_columns.py envs/test_inspect_env.py episodes/test_recorded_state.py",
    "pictures/render": "pictures/test_pictures.py pictures/test_step_pictures.py pictures/test_mounted_cameras.py",
    "jobs/scheduler": "jobs/test_pool.py",
    "jobs/local_processes": "jobs/test_pool.py",
    "machine/processes/wire": "machine/processes/test_wire.py machine/processes/test_line.py",
    "live/process/ask": "live/process/test_ask.py",
    "live/history/moments": "live/history/test_history.py live/history/test_env_table.py",
    "live/history/env_table": "live/history/test_env_table.py",
    "live/history/curves": "live/history/test_curves.py",
    "rescore/verdict": "rescore/test_verdict.py",
    "rescore/past_scores": "rescore/test_past_scores.py rescore/test_past_rescorer.py",
    "live/process/supervisor": "live/process/test_supervisor.py",
    "live/load_attempts": "live/test_versions.py",
    "live/loading": "live/test_versions.py live/test_live_state.py",
    "live/apply": "live/test_live_state.py live/test_timeline.py live/test_apply.py",
    "live/past": "live/test_timeline.py",
    "live/inspect_polling": "live/test_live_state.py",
    "actions/choose": "actions/test_given_actions.py",
    "record/live_recorder": "record/test_live_recorder.py",
    "record/state": "record/test_apply.py record/test_live_recorder.py",
    "record/saving_state": "record/test_apply.py record/test_live_recorder.py",
    "rescore/state": "record/test_apply.py",
    "rescore/past_jobs": "rescore/test_past_rescorer.py",
    "cameras/placements": "cameras/test_placements.py",
    "cameras/edit_state": "cameras/test_studio_state.py cameras/test_edit_state.py",
    "cameras/apply": "cameras/test_studio_state.py",
    "cameras/worker": "cameras/test_worker.py",
    "page/door/access": "page/door/test_access.py",
    "cameras/pose_math": "cameras/test_pose_math.py cameras/test_fields.py",
    "cameras/number_fields": "cameras/test_fields.py",
    "app/review_page": "app/test_review_page.py -k 'strip or timeline or opened'",
    "app/go_live": "app/test_go_live.py",
    "library/listing": "library/test_listing.py library/test_panel.py",
    "page/door/gated_server": "page/door/test_gated_server.py page/door/test_socket_and_renewal.py page/door/test_connection_limits.py::test_a_page_with_the_token_has_no_timeout"
    " page/door/test_connection_limits.py::test_refused_requests_are_counted_and_logged_once_per_kind"
    " page/door/test_connection_limits.py::test_a_repeated_message_is_logged_less_and_less_often"
    " -k 'not only_the_workbench_prints and not command and not palette and not concurrent_starts'",
    "rescore/result_parts": "rescore/test_recordings_panel.py rescore/test_past_panel.py",
    "page/widgets/parts": "page/widgets/test_parts.py",
    "page/widgets/paged": "page/widgets/test_paged.py",
    "page/door/responses": "page/door/test_replies.py",
    "live/panels/timeline_panel": "live/panels/test_timeline.py live/panels/test_timeline_strip.py",
    "page/door/file_response": "page/door/test_file_response.py",
}
"""Tests under ``tests/`` that should notice a mutant of a module under ``workbench/``; only fast ones, because each
mutant runs them all until one fails."""

# Operators that imitate human mistakes; Cosmic Ray's other replacements (a division for a concatenation) die of a
# TypeError, and would only improve the percentage of killed mutants.
_CORE = (
    *("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd"),
    *("ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ExceptionReplacer", "NumberReplacer"),
    *("ZeroIterationForLoop", "ReplaceUnaryOperator_Delete_Not", "ReplaceUnaryOperator_Delete_USub"),
    *(
        f"ReplaceBinaryOperator_{pair}"
        for pair in (
            *("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Mul", "Pow_Mul"),
            *("LShift_RShift", "RShift_LShift", "BitOr_BitAnd", "BitAnd_BitOr"),
        )
    ),
    *(
        f"ReplaceComparisonOperator_{pair}"
        for pair in (
            *("Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is"),
            *("Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE", "GtE_Gt", "GtE_Lt"),
        )
    ),
)


class LeaveOut(Operator):
    """Removes a line: a call, a raise, or an assignment to something that outlives the function."""

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        if node.type == "simple_stmt" and self._may_be_missed(node.children[0]):
            yield node.children[0].start_pos, node.children[0].end_pos

    def mutate(self, node: Any, index: int) -> Any:
        statement = node.children[0]
        node.children[0] = Keyword("pass", statement.start_pos, statement.get_first_leaf().prefix)
        return node

    @classmethod
    def examples(cls) -> tuple[()]:
        return ()

    @staticmethod
    def _may_be_missed(statement: Any) -> bool:
        if statement.type == "expr_stmt":
            target, operator = statement.children[:2]
            return (
                target.type in ("power", "atom_expr") or operator.type == "operator" and operator.value != "="
            )
        return statement.type in ("power", "atom_expr", "await_expr", "raise_stmt")


@dataclass(frozen=True)
class Mutant:
    module: str
    number: int
    """1-based line number."""
    line: str
    becomes: str
    """Line and replacement are stripped, so ``--lived`` finds the mutant again after the line has moved."""
    code: str
    """The whole file with the mutation."""


@dataclass(frozen=True)
class Outcome:
    """How a mutant ended."""

    number: int
    line: str
    becomes: str
    end: str
    """``killed``, ``timed out`` or ``lived``."""


def _is_declaration(node: Any) -> bool:
    """Whether the node does not affect behaviour in a test: an annotation, a decorator or a type alias."""
    child, parent = node, node.parent
    while parent is not None:
        if parent.type == "decorator":
            return True
        if parent.type in ("annassign", "tfpdef") and child is not parent.children[0]:
            # In ``name: kind = value`` only the value is code.
            before = parent.children[parent.children.index(child) - 1]
            if before.get_code().strip() == ":":
                return True
        if (
            parent.type == "funcdef"
            and parent.children[parent.children.index(child) - 1].get_code().strip() == "->"
        ):
            return True
        if parent.type == "if_stmt" and parent.children[1].get_code().strip() == "TYPE_CHECKING":
            return True
        child, parent = parent, parent.parent
    if node.type == "operator" and node.parent.type == "parameters":
        return True  # the star between parameters
    # A union type alias at module level.
    return node.type == "operator" and node.value == "|" and _at_the_top(node)


def _at_the_top(node: Any) -> bool:
    while node.parent is not None:
        if node.type in ("funcdef", "classdef", "lambdef"):
            return False
        node = node.parent
    return True


Place = tuple[tuple[int, int], tuple[int, int]]
"""Start and end of a mutation: 1-based line and column, each."""


def all_mutations(source: str) -> dict[Place, list[tuple[Operator, int]]]:
    """For each place, in file order: the operators that can change it, and the index of the occurrence in each."""
    at_place: defaultdict[Place, list[tuple[Operator, int]]] = defaultdict(list)
    nodes = list(ast_nodes(get_ast(source)))
    for operator in [*(get_operator(f"core/{name}")() for name in _CORE), LeaveOut()]:
        spots = [(node, *spot) for node in nodes for spot in operator.mutation_positions(node)]
        for occurrence, (node, start, end) in enumerate(spots):
            # In a file that uses Path a slash joins paths: with another operator nothing would run.
            joins = node.type == "operator" and node.value == "/" and "import Path\n" in source
            if not joins and not _is_declaration(node):
                at_place[start, end].append((operator, occurrence))
    return {place: at_place[place] for place in sorted(at_place)}


def _mutated(module: str, source: str, place: Place, operator: Operator, occurrence: int) -> Mutant | None:
    try:
        code = mutate_code(source, operator, occurrence)
    except AttributeError:
        return None  # Cosmic Ray has no other name for an exception of a module (asyncio.TimeoutError)
    assert code is not None, (module, place)
    mutant = _as_mutant(module, source, code, *place)
    return mutant if _compiles(mutant.code) else None


def _compiles(code: str) -> bool:
    try:
        compile(code, "mutant", "exec", dont_inherit=True)
    except SyntaxError:
        return False  # such as {*others} for {**others}: that needs no test
    return True


def _as_mutant(module: str, source: str, code: str, start: tuple[int, int], end: tuple[int, int]) -> Mutant:
    """Take only the changed place from Cosmic Ray's file: it joins earlier lines and drops their comments."""
    lines = source.splitlines(keepends=True)
    before = "".join(lines[: start[0] - 1]) + lines[start[0] - 1][: start[1]]
    after = lines[end[0] - 1][end[1] :] + "".join(lines[end[0] :])
    assert code.startswith(before.rstrip()) and code.endswith(after), (module, start, end)
    put = code[len(before.rstrip()) : len(code) - len(after)].strip()
    becomes = (lines[start[0] - 1][: start[1]] + put + lines[end[0] - 1][end[1] :]).strip()
    return Mutant(module, start[0], lines[start[0] - 1].strip(), becomes, before + put + after)


def sample(module: str, count: int, seed: int) -> list[Mutant]:
    """``count`` mutants of the module at as many different places as possible, deterministic for file and seed."""
    source = (ROOT / "workbench" / f"{module}.py").read_text(encoding="utf-8")
    chance = random.Random(f"{module} {seed}")
    places = list(all_mutations(source).items())
    chosen: list[Mutant] = []
    while len(chosen) < count and places:
        chance.shuffle(places)
        for place, slips in places:
            mutant = _mutated(module, source, place, *slips.pop(chance.randrange(len(slips))))
            if mutant is not None:
                chosen.append(mutant)
            if len(chosen) == count:
                break
        places = [(place, slips) for place, slips in places if slips]
    return sorted(chosen, key=lambda mutant: (mutant.number, mutant.becomes))


def copy_tree(into: Path) -> None:
    """Copy the files that git tracks or would track: a mutant is never written into the working tree."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, check=True, capture_output=True).stdout.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (into / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, into / name)


def run_tests(tree: Path, module: str, seconds: float) -> str:
    """``passed``, ``killed`` or ``timed out``."""
    scratch = tree.parent / "t"
    scratch.mkdir()
    environment = {
        **os.environ,
        "PYTHONPATH": str(tree),
        "TMPDIR": str(scratch),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    tests = [f"tests/{word}" if ".py" in word else word for word in shlex.split(PROTECTED[module])]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-m",
        "not slow and not browser",
        "-p",
        "no:cacheprovider",
    ]
    command += ["--hypothesis-seed=0", *tests]
    with open(tree.parent / "output.txt", "wb") as output:
        process = subprocess.Popen(
            command,
            cwd=tree,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            # Also processes that a killed test left behind.
            try:
                os.killpg(process.pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            process.wait()
    shutil.rmtree(scratch, ignore_errors=True)
    if code is None:
        return "timed out"
    return "passed" if code == 0 else "killed"


def try_module(tree: Path, module: str, mutants: list[Mutant]) -> list[Outcome]:
    """Run the module's tests on each mutant."""
    file = tree / "workbench" / f"{module}.py"
    clean = file.read_text(encoding="utf-8")
    started = time.monotonic()
    if run_tests(tree, module, 900) != "passed":
        sys.exit(f"{module}: its tests fail without a mutant\n" + (tree.parent / "output.txt").read_text())
    seconds = time.monotonic() - started
    print(f"{module}: {seconds:.0f} s for its tests", file=sys.stderr, flush=True)
    outcomes = []
    for mutant in mutants:
        file.write_text(mutant.code, encoding="utf-8")
        try:
            end = run_tests(tree, module, 30 + 4 * seconds)
        finally:
            file.write_text(clean, encoding="utf-8")
        outcomes.append(
            Outcome(mutant.number, mutant.line, mutant.becomes, "lived" if end == "passed" else end)
        )
        print(
            f"  {end if end != 'passed' else 'LIVED'}: {_as_diff(module, outcomes[-1])}",
            file=sys.stderr,
            flush=True,
        )
    return outcomes


def _as_diff(module: str, one: Outcome) -> str:
    return f"workbench/{module}.py:{one.number}: {one.line}  ->  {one.becomes}"


def report(module: str, outcomes: list[Outcome], seconds: float) -> bool:
    """Print how the mutants of a module ended; return whether enough of them were killed."""
    lived = [one for one in outcomes if one.end == "lived"]
    late = [one for one in outcomes if one.end == "timed out"]
    died = len(outcomes) - len(lived)
    share = 100 * died // len(outcomes) if outcomes else 100
    print(
        f"{module}: {len(outcomes)} mutants, {died} killed ({len(late)} by time), {len(lived)} lived, "
        f"{share} %, {seconds:.0f} s"
    )
    for one in late:
        print(f"  by time: {_as_diff(module, one)}")
    for one in lived:
        print(f"  NO TEST NOTICES: {_as_diff(module, one)}")
    return share >= MIN_KILLED_PERCENT


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("modules", nargs="+", choices=[*PROTECTED, "all"], metavar="module")
    parser.add_argument("--count", type=int, default=30, help="mutants per module")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lived", action="store_true", help="only mutants that lived in the last run")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the copy is removed
    good = True
    for module in PROTECTED if "all" in options.modules else options.modules:
        mutants = sample(module, options.count, options.seed)
        kept, last = LAST_RESULTS / f"{module.replace('/', '.')}.json", []
        if options.lived:
            last = [Outcome(**one) for one in json.loads(kept.read_text(encoding="utf-8"))]
            again = {(one.line, one.becomes) for one in last if one.end == "lived"}
            last = [one for one in last if (one.line, one.becomes) not in again]
            mutants = [mutant for mutant in mutants if (mutant.line, mutant.becomes) in again]
        started = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            tree = Path(folder) / "tree"
            tree.mkdir()
            copy_tree(tree)
            outcomes = try_module(tree, module, mutants)
        outcomes = last + outcomes
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps([asdict(one) for one in outcomes], indent=1), encoding="utf-8")
        good &= report(module, outcomes, time.monotonic() - started)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
