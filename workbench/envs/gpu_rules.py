"""Rules, their findings, the comments that silence them, and the rules of GPU simulation. Imports no simulator."""

from __future__ import annotations

import ast
import inspect
import linecache
import re
import tokenize
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, get_args

from workbench.machine.parse_python import parse_python

Degree = Literal["stop", "warn", "off"]
"""*stop* raises at the line that broke the rule. *warn* reports the line, and the task continues with
the same numbers as without rules, to the last bit. By default a rule stops if its breach makes every later
number wrong, as when the state of other envs is overwritten."""
DEGREES: tuple[Degree, ...] = get_args(Degree)
FailOn = Literal["stop", "warn", "never"]
"""The lowest degree of a finding that makes a command's exit code 1."""


def fails(degree: Degree, fail_on: FailOn) -> bool:
    """Whether a finding of this degree makes the exit code 1."""
    return fail_on != "never" and DEGREES.index(degree) <= DEGREES.index(fail_on)


@dataclass(frozen=True)
class Rule:
    """A rule that a task should keep, as reports and pages show it."""

    id: str
    degree: Degree
    """Default degree."""
    hook: str
    """The hook in which an author fixes a violation; ``class`` for the class and its file."""
    asks: str
    """What the task must do, in a sentence."""
    otherwise: str
    """What happens if the task does not, in a sentence."""
    solve: bool
    """Whether the rule needs planned episodes, which take minutes: checked only with ``--solve``."""


@dataclass(frozen=True)
class DeclaredRule(Rule):
    """A rule with its page, as the code declares it."""

    page: str
    """The sections *Why*, *Fix* and *How it is checked*, as Markdown."""


def declared_rule(id: str, degree: Degree, hook: str, text: str, *, solve: bool = False) -> DeclaredRule:
    """Make a rule from its text.

    Args:
        text: Markdown, indented like a docstring: a paragraph with `Rule.asks`, a paragraph with
            `Rule.otherwise`, then the sections of the page.
    """
    asks, otherwise, page = inspect.cleandoc(text).split("\n\n", 2)
    return DeclaredRule(
        id, degree, hook, " ".join(asks.split()), " ".join(otherwise.split()), solve=solve, page=page
    )


def degrees_of(choice: Degree | None) -> dict[str, Degree]:
    """The degree of each rule: `choice` for all rules; if it is None, each rule's default.

    Raises:
        ValueError: `choice` is not a degree.
    """
    if choice is not None and choice not in DEGREES:
        raise ValueError(f"rules must be 'stop', 'warn' or 'off', not {choice!r}")
    return {rule.id: rule.degree if choice is None else choice for rule in GPU_RULES.values()}


@dataclass(frozen=True)
class Finding:
    """Breaches of one rule at one place."""

    rule: str
    """Id of the rule."""
    degree: Degree
    message: str
    """Message of the first breach: what was done, its effect, and what to write instead."""
    file: str | None
    """File of the line; None if unknown."""
    line: int | None
    """1-based line in `file`."""
    code: str
    """The text of that line, stripped."""
    function: str
    """Function or hook of the line."""
    count: int
    """Number of breaches."""
    first_step: int
    """Control steps of the batch before the first breach. 0 for a breach in a reset before the first step,
    and in the trial reset and step of a new version on a page."""

    @property
    def key(self) -> tuple[str, str | None, str, str]:
        """Identity of the finding, which stays the same when lines around it move."""
        return self.rule, self.file, self.function, self.code


# --- silenced in the source ------------------------------------------------------------------------------
# ``# workbench: off[reward-rows] one env only, see the paper`` stands in the line of the finding, alone in
# the line above it, or in the line of the ``def`` or ``class`` around it. Without a reason it silences
# nothing.

_COMMENT = re.compile(r"#\s*workbench:\s*off\[([\w\s,-]*)\]\s*(.*)")


@dataclass(frozen=True)
class Silence:
    """One silencing comment."""

    line: int
    """1-based line of the comment."""
    rules: frozenset[str]
    reason: str
    alone: bool
    """Whether the line has only the comment."""


def silences(text: str) -> tuple[Silence, ...]:
    """The silencing comments in a file's text; empty if Python cannot parse the text."""
    return _read(text)[0]


def silence_of(file: str | None, line: int | None, rule: str) -> Silence | None:
    """The comment that silences a finding at this line; None if there is none."""
    if file is None or line is None or file.startswith("<"):
        return None
    found, scopes = _read("".join(linecache.getlines(file)))
    if not found:
        return None
    # A decorator belongs to its function: a finding may be placed at either.
    heads = {head for first, head, last in scopes if first <= line <= last}
    for one in found:
        here = one.line == line or one.line in heads or (one.alone and one.line == line - 1)
        if here and rule in one.rules and one.reason:
            return one
    return None


@lru_cache(maxsize=64)
def _read(text: str) -> tuple[tuple[Silence, ...], tuple[tuple[int, int, int], ...]]:
    """The comments, and (first, head, last) line of each function and class."""
    if "workbench:" not in text:
        return (), ()
    try:
        found = tuple(_comments(text))
        scopes = tuple(_scopes(parse_python(text)))
    except (SyntaxError, tokenize.TokenError, ValueError, RecursionError):
        return (), ()
    return found, scopes


def _comments(text: str) -> Iterator[Silence]:
    lines = iter(text.splitlines(keepends=True))
    for token in tokenize.generate_tokens(lambda: next(lines, "")):
        if token.type != tokenize.COMMENT or (match := _COMMENT.match(token.string)) is None:
            continue
        rules = frozenset(re.split(r"[\s,]+", match[1].strip())) - {""}
        alone = not token.line[: token.start[1]].strip()
        yield Silence(token.start[0], rules, match[2].strip(" -–:"), alone)


def _scopes(tree: ast.Module) -> Iterator[tuple[int, int, int]]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            yield first, node.lineno, node.end_lineno or node.lineno


# --- the rules -------------------------------------------------------------------------------------------

_WATCHED = """\
The rule watches all other checks, and six resets of random envs, each after two random actions. It watches a task that is open on a page, recorded or made with `workbench.make` in
the same way."""


def _gpu_rule(id: str, degree: Degree, hook: str, text: str) -> DeclaredRule:
    """Like `declared_rule`; replaces ``{watched}`` in the text by the sentences that several pages share."""
    rule = declared_rule(id, degree, hook, text)
    return replace(rule, page=rule.page.replace("{watched}", _WATCHED))


GPU_RULES: Mapping[str, DeclaredRule] = {
    rule.id: rule
    for rule in (
        # --- the state of other envs is overwritten
        _gpu_rule(
            "other-env-written",
            "stop",
            "_initialize_episode",
            """_initialize_episode(env_idx) writes the state of the envs in env_idx only.

            The episodes of other envs change.

            ## Why
            A trainer resets the envs whose episode is over, and no others. On the GPU all envs share one
            tensor of states, so a write without `env_idx` reaches envs that are in the middle of an episode.
            Their bodies jump, and the policy gets a transition that no action caused. With 4096 envs some env
            is reset at nearly every step, so nearly every episode is spoilt.

            ## Fix
            Give setters the rows of `env_idx`; ManiSkill's setters then reach those envs only.

            ```python fragment
            def _initialize_episode(self, env_idx, options):
                with torch.device(self.device):
                    b = len(env_idx)
                    p = torch.zeros((b, 3))
                    p[:, :2] = torch.rand((b, 2)) * 0.2 - 0.1
                    self.cube.set_pose(Pose.create_from_pq(p=p))
            ```

            ## How it is checked
            {watched}
            It compares the state of all envs before and after the hook, and watches setters while the hook
            runs. It does not see a write of the same value, and it needs more than one env.
            """,
        ),
        _gpu_rule(
            "rows-lost",
            "stop",
            "_initialize_episode",
            """The task's attributes still have a row for each env after a partial reset.

            The values of other envs are lost; the next use fails, or takes the wrong row.

            ## Why
            In a partial reset `env_idx` has fewer entries than there are envs. A tensor that is made with
            `len(env_idx)` rows and assigned to `self` replaces the rows of all envs. The next use fails with
            a mismatch of sizes, or indexes the row of another env. The first reset, which is of all envs,
            does not show the mistake.

            ## Fix
            Make the tensor for all envs once, and write the rows of `env_idx`.

            ```python fragment
            def _load_scene(self, options):
                self.target = torch.zeros((self.num_envs, 3), device=self.device)


            def _initialize_episode(self, env_idx, options):
                with torch.device(self.device):
                    self.target[env_idx] = torch.rand((len(env_idx), 3))
            ```

            ## How it is checked
            {watched}
            It compares the tensors, arrays, lists and poses on the task before and after each partial reset.
            It does not look into objects of other libraries.
            """,
        ),
        # --- the rest
        _gpu_rule(
            "stepped-in-reset",
            "warn",
            "_initialize_episode",
            """_initialize_episode does not call scene.step() while other envs are in the middle of an episode.

            The episodes of other envs advance.

            ## Why
            A physics step moves all envs at once: a GPU cannot step some of them. An env that is in the
            middle of its episode gets a step that its policy did not choose, and its count of steps does not
            include it. On the CPU each env has its own physics, and only the envs that are being reset are
            stepped. The habit comes from tasks with one env, where it is not a mistake.

            ## Fix
            Compute the settled pose and place the bodies there, slightly above the surface that carries them.

            ```python fragment
            def _initialize_episode(self, env_idx, options):
                with torch.device(self.device):
                    p = torch.zeros((len(env_idx), 3))
                    p[:, 2] = self.half_size[env_idx] + 1e-3
                    self.cube.set_pose(Pose.create_from_pq(p=p))
            ```

            ## How it is checked
            {watched}
            It watches steps of the physics within the hook while some envs are not being reset. A reset of
            all envs may step, since there are no other envs then.
            """,
        ),
        _gpu_rule(
            "apply-before-fetch",
            "warn",
            "step",
            """After a step, state is fetched before it is written and applied.

            Every body of every env goes back to where it was before the step.

            ## Why
            After a step the tensors of state still hold the values from before it, until they are fetched. An
            apply writes the whole tensors to the simulation. So everything that moved in that step is put
            back, in all envs: the bodies do not move, or jitter.

            ## Fix
            Fetch, write, apply, and fetch again.

            ```python fragment
            def _after_simulation_step(self):
                if self.gpu_sim_enabled:
                    self.scene._gpu_fetch_all()
                self.marker.set_pose(Pose.create_from_pq(p=self.agent.tcp.pose.p))
                if self.gpu_sim_enabled:
                    self.scene._gpu_apply_all()
                    self.scene._gpu_fetch_all()
            ```

            ## How it is checked
            {watched}
            It compares each apply with what the simulation holds; the batched CPU applies only what was
            written. It says nothing if no body moved in the step.
            """,
        ),
        _gpu_rule(
            "state-while-built",
            "warn",
            "_load_scene",
            """State (poses, velocities, qpos, drive targets) is read and set only after the scene is complete: in
            _after_reconfigure or _initialize_episode.

            The build fails: there are no tensors of state yet.

            ## Why
            While `_load_agent` and `_load_scene` run, GPU simulation has no tensors of state: reading or
            setting a pose there raises, and the build fails. The CPU backend reads and writes SAPIEN's own
            objects, so the task runs here: a drive target that is set in the build stays, and a pose that is
            read is the initial one.

            ## Fix
            Give a body its place with `builder.initial_pose`. In `_after_reconfigure` set what stays, and in
            `_initialize_episode` what each episode begins with.

            ```python fragment
            def _after_reconfigure(self, options):
                self.cabinet.set_joint_drive_targets(self.closed, joints=self.cabinet.active_joints)
            ```

            ## How it is checked
            The rule watches each read and write of state while the scene is built, in all that the checks
            build and whenever a task is opened, recorded or made with `workbench.make`.
            """,
        ),
        _gpu_rule(
            "refused-by-gpu",
            "warn",
            "_initialize_episode",
            """Masses, limits, damping and drives of joints are set, and bodies are removed, only while the scene
            is built; no static actor is moved; a call that sets values gets a row for each env that it changes.

            The call raises.

            ## Why
            Once GPU simulation runs, these calls raise, and training stops there. A stock CPU env carries
            them out, and so does the batched CPU, for the envs that are being reset. If a call gives rows of
            all envs while some are reset, the batched CPU takes the rows of the envs that are reset.

            ## Fix
            Make the call while the scene is built, with a value for each env. Build a body that moves with
            `build_kinematic` or `build`. In `_initialize_episode` take the rows of `env_idx`.

            ```python fragment
            self.marker.set_pose(Pose.create(self.cube.pose.raw_pose[env_idx]))
            ```

            ## How it is checked
            The rule watches each such call, in all that the checks run and whenever a task is opened,
            recorded or made with `workbench.make`. The message names what the GPU refuses.
            """,
        ),
        _gpu_rule(
            "one-env-only",
            "warn",
            "evaluate",
            """The task uses nothing that exists for one env only, such as scene.get_contacts() or
            scene.px.raycast().

            GPU simulation does not have what the task uses; the workbench opens the task with one env only.

            ## Why
            A CPU simulation of one env has members that GPU simulation lacks. A task that uses one of them
            runs with one env and cannot be trained on a GPU. The workbench opens the task with one env, and
            says so.

            ## Fix
            Use what ManiSkill has for a batch: contact impulses between two bodies, or on one body.

            ```python fragment
            force = torch.linalg.norm(self.scene.get_pairwise_contact_forces(self.cube, self.table), dim=1)
            ```

            ## How it is checked
            The rule watches each use of a member of SAPIEN's CPU system, in all that the checks run and
            whenever a task is opened, recorded or made with `workbench.make`. With several envs the use
            raises with the line, and the workbench opens the task again with one env.
            """,
        ),
        _gpu_rule(
            "rows-rewritten",
            "warn",
            "_initialize_episode",
            """_initialize_episode(env_idx) changes only the rows of env_idx in the task's attributes.

            Other envs continue with another target, counter or best value than they began with.

            ## Why
            A target, a counter or a best value that is drawn again for all envs changes for envs in the
            middle of an episode. Their reward compares with a target that they did not begin with, and a
            count of steps in success starts over. Nothing raises, and the success rate is lower than it
            should be.

            ## Fix
            Write the rows of `env_idx` only.

            ```python fragment
            def _initialize_episode(self, env_idx, options):
                with torch.device(self.device):
                    self.target[env_idx] = torch.rand((len(env_idx), 2))
                    self.steps_in_success[env_idx] = 0
            ```

            ## How it is checked
            {watched}
            It compares the tensors, arrays, lists and poses on the task before and after each partial reset,
            with a tolerance of 1e-5 for values that are computed again. It does not see a value that is drawn
            again and comes out the same.
            """,
        ),
        _gpu_rule(
            "applied-by-reset",
            "warn",
            "step",
            """State that is set outside _initialize_episode is applied before other envs are reset.

            The reset of other envs applies it, at a moment that the task did not choose.

            ## Why
            A pose that is set in `evaluate` or in a step hook is only a number in a tensor until it is
            applied. The reset of some other env applies all of the tensor, at a moment that depends on when
            that env's episode ends. So an env behaves differently next to other envs, and its episodes cannot
            be reproduced.

            ## Fix
            Apply right after the write, and fetch.

            ```python fragment
            def _after_control_step(self):
                self.door.set_qpos(self.wanted_qpos)
                if self.gpu_sim_enabled:
                    self.scene._gpu_apply_all()
                    self.scene._gpu_fetch_all()
            ```

            ## How it is checked
            {watched}
            Before each partial reset it looks for states that were set and not applied in the envs that are
            not being reset. It leaves out targets of drives, since they are applied at each step.
            """,
        ),
        _gpu_rule(
            "not-applied",
            "warn",
            "step",
            """State that is set outside _initialize_episode is applied with scene._gpu_apply_all() before anything is
            fetched; scene._gpu_fetch_all() follows.

            Physics never sees the state; pictures do.

            ## Why
            On the GPU a setter writes into a tensor, and physics reads that tensor when it is applied.
            Between resets only the task applies it. The body is drawn at its new pose but collides at its old
            one; after the next fetch it is drawn at its old pose again. On the CPU of stock ManiSkill the same line works,
            so the mistake shows first on the cluster.

            ## Fix
            Apply and fetch after the write. If only pictures should show the pose, say so with a comment that
            silences the rule.

            ```python fragment
            def _after_control_step(self):
                self.target.set_pose(Pose.create_from_pq(p=self.target_p))
                if self.gpu_sim_enabled:
                    self.scene._gpu_apply_all()
                    self.scene._gpu_fetch_all()
            ```

            ## How it is checked
            {watched}
            At each fetch it compares the tensors with what was applied. It looks at joint forces (qf) before
            each step.
            """,
        ),
        _gpu_rule(
            "link-pose-set",
            "warn",
            "step",
            """A task moves links by the qpos and the root pose of their articulation.

            The simulation ignores a link's pose; pictures do not.

            ## Why
            A link's pose follows from the qpos and the root pose of its articulation. The GPU has no way to
            set it alone: the number stays in the tensor until the next fetch overwrites it. Pictures taken
            before that show the link in the wrong place.

            ## Fix
            Set the qpos of the articulation, or its root pose.

            ```python fragment
            def _initialize_episode(self, env_idx, options):
                qpos = self.cabinet.qpos.clone()
                qpos[env_idx] = self.closed_qpos[env_idx]
                self.cabinet.set_qpos(qpos[env_idx])
            ```

            ## How it is checked
            {watched}
            At each fetch it compares the poses of links that are not roots with what the simulation has.
            """,
        ),
        _gpu_rule(
            "read-before-fetch",
            "warn",
            "step",
            """After a step, state is fetched before it is read.

            A read gives the state before the step.

            ## Why
            After a physics step the tensors hold the state before it. ManiSkill fetches once for each control
            step; a hook that runs between two substeps reads old numbers. On the CPU of stock ManiSkill the
            same line reads new ones, so a controller or a check in such a hook works there and lags by a step
            on the GPU.

            ## Fix
            Fetch before you read, in hooks that run between substeps.

            ```python fragment
            def _after_simulation_step(self):
                if self.gpu_sim_enabled:
                    self.scene._gpu_fetch_all()
                self.highest = torch.maximum(self.highest, self.cube.pose.p[:, 2])
            ```

            ## How it is checked
            {watched}
            It compares each read of a pose, velocity, qpos or qvel with the state of the simulation. It says
            nothing if the body did not move.
            """,
        ),
        _gpu_rule(
            "link-before-update",
            "warn",
            "step",
            """After qpos or a root pose was set, the task calls gpu_update_articulation_kinematics() before it
            reads links.

            The links still have their old poses.

            ## Why
            Setting qpos moves no link until the kinematics are updated. A pose of the gripper that is read
            right after `set_qpos` is the one from before. Objects that are placed relative to it stand in the
            wrong place in each episode, and only on the GPU.

            ## Fix
            Apply, update the kinematics and fetch before you read links.

            ```python fragment
            def _initialize_episode(self, env_idx, options):
                self.agent.robot.set_qpos(self.rest_qpos[env_idx])
                if self.gpu_sim_enabled:
                    self.scene._gpu_apply_all()
                    self.scene.px.gpu_update_articulation_kinematics()
                    self.scene._gpu_fetch_all()
                self.tcp_at_rest[env_idx] = self.agent.tcp.pose.p[env_idx]
            ```

            ## How it is checked
            {watched}
            It watches reads of links after a qpos or a root pose was set. A read of the root is not a breach,
            since the root pose is always up to date.
            """,
        ),
        _gpu_rule(
            "behind-the-tensors",
            "warn",
            "step",
            """The task sets state through ManiSkill's objects, not through SAPIEN's.

            Nothing happens: the GPU simulation does not read SAPIEN's objects.

            ## Why
            SAPIEN's own objects (`_objs`, `_bodies`, entities) write into a CPU scene, which does not
            simulate when ManiSkill runs on the GPU. The line does nothing there, without an error. On the CPU
            it works for the one env that the object belongs to.

            ## Fix
            Use the setters of ManiSkill's `Actor`, `Link` and `Articulation`: they write all envs, or those
            that are being reset.

            ```python fragment
            def _initialize_episode(self, env_idx, options):
                with torch.device(self.device):
                    p = torch.zeros((len(env_idx), 3))
                    self.cube.set_pose(Pose.create_from_pq(p=p))  # not: for obj in self.cube._objs: obj.set_pose(...)
            ```

            ## How it is checked
            {watched}
            It watches setters of SAPIEN's physical bodies once the scene is built. It leaves out cameras,
            lights and what is set while the scene is built.
            """,
        ),
        _gpu_rule(
            "controller-targets",
            "warn",
            "step",
            """A controller declares in sets_target_qpos and sets_target_qvel which drive targets it sets.

            Each step raises AttributeError.

            ## Why
            In GPU simulation ManiSkill applies the drive targets of a robot after its controller has set
            them, and reads these two attributes to know which. `BaseController` does not define them: if a
            controller does not either, each step of its robot raises AttributeError on a GPU. On the CPU
            nothing reads them.

            ## Fix
            Give the class both, as ManiSkill's own controllers do.

            ```python fragment
            class MyController(PDJointPosController):
                sets_target_qpos = True
                sets_target_qvel = False
            ```

            ## How it is checked
            The rule watches each step that the checks make, and each step of a task that is open on a page,
            recorded or made with `workbench.make`. The finding is at the line of the controller's class.
            """,
        ),
        _gpu_rule(
            "evaluate-rows",
            "stop",
            "evaluate",
            """evaluate() returns a row for each env.

            The value is broadcast over the envs, or an error comes up somewhere else.

            ## Why
            `success` and `fail` end episodes, one row for each env. A single bool is broadcast: when one env
            succeeds, all 4096 are reset. A tensor of shape (N, 1) becomes (N, N) in the first operation with
            a tensor of shape (N,).

            ## Fix
            Reduce over the last dimension, not over the envs, and return bool tensors of shape (N,).

            ```python fragment
            def evaluate(self):
                distance = torch.linalg.norm(self.cube.pose.p - self.goal.pose.p, dim=1)
                return {"success": distance < 0.025}
            ```

            ## How it is checked
            {watched}
            It looks at each return of `evaluate`: it must be a dict, with `success` and `fail` as tensors of
            shape (N,). The rule `info-rows` looks at other entries. With one env a single bool passes.
            """,
        ),
        _gpu_rule(
            "evaluate-flags",
            "warn",
            "evaluate",
            """The entries success and fail of evaluate() are bool tensors.

            ManiSkill's wrappers, such as ManiSkillVectorEnv with record_metrics, fail on entries of another dtype.

            ## Why
            ManiSkill's `step` accepts numbers for them. Its wrappers do not: `ManiSkillVectorEnv` with
            `record_metrics=True` uses them as a mask, and fails or picks the wrong rows.

            ## Fix
            Compare, or append `.bool()`.

            ```python fragment
            return {"success": distance < 0.02}
            ```

            ## How it is checked
            The rule looks at each `evaluate` that the checks run, and at each one of a task that is open on a
            page, recorded or made with `workbench.make`.
            """,
        ),
        _gpu_rule(
            "reward-rows",
            "warn",
            "compute_dense_reward",
            """The reward is a floating tensor with a number for each env.

            The reward is broadcast over the envs, to (N, N) in a trainer.

            ## Why
            A reward of shape (N, 1) minus a value estimate of shape (N,) is a matrix (N, N). The loss is then
            a mean over 16 million wrong numbers, and nothing raises. A reward of integers or bools fails in
            trainers that add noise or scale in place.

            ## Fix
            Return a floating tensor of shape (N,).

            ```python fragment
            def compute_dense_reward(self, obs, action, info):
                distance = torch.linalg.norm(self.cube.pose.p - self.agent.tcp.pose.p, dim=1)
                reward = 1 - torch.tanh(5 * distance)
                reward[info["success"]] = 2
                return reward
            ```

            ## How it is checked
            {watched}
            It looks at each reward of the open mode. ManiSkill's own sparse reward, which is `success`
            itself, passes. With one env a reward of shape () passes, and one of shape (1, 1) does not.
            """,
        ),
        _gpu_rule(
            "observation-rows",
            "warn",
            "_get_obs_extra",
            """Observations have a row for each env.

            An observation without a row for each env is broadcast over the envs, or an error comes up somewhere
            else.

            ## Why
            Observations are flattened and joined along the last dimension. A leaf without a row for each env
            is broadcast, so that all envs see the same number, or the join fails with a message about sizes
            that names no leaf.

            ## Fix
            Return a dict of tensors of shape (N, ...); repeat a value that is the same for all envs.

            ```python fragment
            def _get_obs_extra(self, info):
                return {
                    "tcp_pose": self.agent.tcp.pose.raw_pose,
                    "goal_height": torch.full((self.num_envs, 1), self.goal_height, device=self.device),
                }
            ```

            ## How it is checked
            {watched}
            It looks at each return of `_get_obs_extra` and `_get_obs_agent` in the open observation mode. It
            does not look at pictures of sensors, which ManiSkill makes itself.
            """,
        ),
    )
}
"""The rules of GPU simulation, by id. Envs check them in all code of the task that runs."""
