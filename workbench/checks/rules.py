"""The rules of `workbench check`, with those of GPU simulation in one table. Imports no simulator."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping

from workbench.envs import gpu_rules as core_rules
from workbench.envs.gpu_rules import Degree, Rule
from workbench.envs.outliers import OUTLIER_RULES

_TABLE = (
    # --- the class and its file -----------------------------------------------------------------------
    Rule(
        "registered",
        "warn",
        "The class inherits BaseEnv and is registered with @register_env.",
        "ManiSkill's own commands and trainers, and its time limit for many envs, do not know it; without any id, gym.make cannot make it.",
        "class",
    ),
    Rule(
        "versioned-id",
        "warn",
        "The registered id ends in a version (-v1).",
        "Results from before and after a change of the task cannot be told apart.",
        "class",
    ),
    Rule(
        "time-limit",
        "warn",
        "@register_env has max_episode_steps.",
        "Episodes end at success or failure only: a policy that reaches neither never resets.",
        "class",
    ),
    Rule(
        "id-taken",
        "warn",
        "No other task or robot has a name that the file registers, unless it overrides that on purpose.",
        "Stock ManiSkill skips the registration, and gym.make gives the other task.",
        "class",
    ),
    Rule(
        "supported-robots",
        "warn",
        "SUPPORTED_ROBOTS lists the robots, with the default of robot_uids among them.",
        "ManiSkill warns about each env, and nobody knows which robots were tried.",
        "class",
    ),
    Rule(
        "reward-modes",
        "warn",
        "Each of SUPPORTED_REWARD_MODES has its method.",
        "The first step in that mode raises NotImplementedError.",
        "class",
    ),
    Rule(
        "unknown-name",
        "warn",
        "Attributes that are set on builders, and methods that are called on self and the scene, exist.",
        "A typo on a builder (inital_pose) is ignored silently; a call that does not exist fails when it is reached.",
        "class",
    ),
    Rule(
        "unseeded-random",
        "warn",
        "Random numbers come from torch in _initialize_episode, and from self._batched_episode_rng where the scene is built.",
        "The same seed gives another episode each time: nothing can be reproduced.",
        "class",
    ),
    Rule(
        "backend-only-call",
        "warn",
        "Calls that only one backend has stand behind `if self.gpu_sim_enabled:` or its opposite.",
        "The task runs on the CPU or on the GPU, and fails on the other.",
        "class",
    ),
    Rule(
        "missing-file",
        "stop",
        "Files that the task names exist.",
        "It cannot be built on another machine.",
        "class",
    ),
    Rule(
        "undeclared-assets",
        "warn",
        "Assets that need a download are named in asset_download_ids.",
        "ManiSkill asks for the download at a prompt, which a cluster does not have, or does not find the files.",
        "class",
    ),
    # --- _load_agent, _load_scene --------------------------------------------------------------------------
    Rule(
        "robot-pose",
        "warn",
        "_load_agent gives the robot an initial pose.",
        "It is built at the origin, inside whatever stands there, and the GPU starts with the collision.",
        "_load_agent",
    ),
    Rule(
        "initial-pose",
        "warn",
        "Every builder has an initial_pose before it is built.",
        "Bodies are built inside each other at the origin, and the GPU's simulation makes its first step there.",
        "_load_scene",
    ),
    Rule(
        "overlap-at-load",
        "warn",
        "Bodies do not overlap where they are built, before the first reset.",
        "The GPU's simulation makes its first step there: it may begin with an explosion, and needs more memory for contacts.",
        "_load_scene",
    ),
    Rule(
        "kinematic-never-moved",
        "warn",
        "A body that is never moved is built static.",
        "A kinematic body costs GPU memory and time in each of thousands of envs.",
        "_load_scene",
    ),
    Rule(
        "body-names",
        "warn",
        "Each body has a name of its own.",
        "The second that is merged under a name takes the place of the first, in the scene and in the state.",
        "_load_scene",
    ),
    Rule(
        "too-many-links",
        "warn",
        "An articulation has at most 64 links.",
        "PhysX on the GPU refuses more.",
        "_load_scene",
    ),
    Rule(
        "hull-fills-hollow",
        "warn",
        "A hollow mesh is not replaced by its convex hull for collisions.",
        "Nothing can be put into a bowl or a box: an invisible lid is in the way.",
        "_load_scene",
    ),
    Rule(
        "decomposition-at-load",
        "warn",
        "Convex decompositions are made once, not at every build.",
        "The first process on each machine waits for it, seconds to minutes a mesh, and needs the package coacd.",
        "_load_scene",
    ),
    Rule(
        "heavy-mesh",
        "warn",
        "Drawn meshes have at most 100,000 triangles.",
        "Pictures are slow, and each env of a GPU renderer needs its memory.",
        "_load_scene",
    ),
    Rule(
        "merged-actors",
        "warn",
        "Of actors that are made per env and merged, only the merged one is in the state.",
        "The state dict has leaves of another batch size: it cannot be saved, sliced or restored.",
        "_load_scene",
    ),
    Rule(
        "hidden-objects",
        "warn",
        "_hidden_objects has actors without collision shapes, and the merged actor in place of its parts.",
        "Poses are wrong and sensors see what is hidden; or every picture fails.",
        "_load_scene",
    ),
    Rule(
        "reconfigures",
        "warn",
        "A scene that is built at random is rebuilt now and then (reconfiguration_freq), at one env at each reset.",
        "A single env trains on the same objects forever.",
        "_load_scene",
    ),
    Rule(
        "env-spacing",
        "warn",
        "What moves stays within half of the spacing between envs (scene_config, sim_config.spacing).",
        "On the GPU all envs share one space: bodies of neighbours meet.",
        "_default_sim_config",
    ),
    # --- _initialize_episode ---------------------------------------------------------------------------------
    Rule(
        "batch-of-reset",
        "warn",
        "_initialize_episode makes tensors of len(env_idx) rows, not of self.num_envs.",
        "A partial reset, which every trainer does, fails or writes rows of other envs.",
    ),
    Rule(
        "runs",
        "stop",
        "Resets of any subset of envs with any seed, and steps with any action, work.",
        "Training ends there.",
    ),
    Rule(
        "overlap-at-reset",
        "warn",
        "Bodies do not overlap after a reset.",
        "They are pushed apart in the first steps, often far away, and the policy learns from that.",
    ),
    Rule(
        "falls-at-reset",
        "warn",
        "Bodies stay where a reset puts them while the robot holds still.",
        "Episodes begin with falling, drifting or exploding bodies, in another state than the reset says.",
    ),
    Rule(
        "robot-holds",
        "warn",
        "The robot holds the pose of a reset while its targets are not changed.",
        "It sags or swings before the policy acts; stiffness, damping or force limits are too low.",
    ),
    Rule(
        "outside-reach",
        "warn",
        "What the robot is to touch lies within its reach.",
        "Some episodes cannot be solved.",
    ),
    Rule(
        "unit-quaternion",
        "warn",
        "Quaternions that are set have length 1.",
        "Pictures, matrices and distances come out scaled or turned.",
    ),
    Rule(
        "quaternion-order",
        "warn",
        "Quaternions are in the order w, x, y, z.",
        "Bodies lie on their sides or upside down (x, y, z, w is SciPy's and ROS's order).",
    ),
    OUTLIER_RULES["bodies-stay"],
    # --- evaluate --------------------------------------------------------------------------------------------
    Rule(
        "success-at-reset",
        "stop",
        "evaluate() does not report success right after a reset.",
        "Episodes end before the policy acts, and the success rate counts them.",
        "evaluate",
    ),
    Rule(
        "success-and-fail",
        "warn",
        "success and fail are never true together.",
        "An episode counts as both.",
        "evaluate",
    ),
    Rule(
        "success-flickers",
        "warn",
        "success holds for some steps once it is true.",
        "Whether an episode counts depends on the step at which it is looked at.",
        "evaluate",
    ),
    Rule(
        "success-stays-possible",
        "warn",
        "evaluate() has an entry success (or fail) if the reward is sparse.",
        "The sparse reward is made of them: without them it is always 0.",
        "evaluate",
    ),
    Rule(
        "entry-name",
        "warn",
        "An entry of evaluate() that ManiSkill reads is spelt as it reads it.",
        "'succes' is passed on as any other entry, and no episode ever succeeds.",
        "evaluate",
    ),
    Rule(
        "info-rows",
        "warn",
        "Every entry of evaluate() has a row for each env.",
        "Vectorised wrappers and loggers cannot slice it by env, and fail or drop it.",
        "evaluate",
    ),
    OUTLIER_RULES["entries-finite"],
    # --- rewards ---------------------------------------------------------------------------------------------
    OUTLIER_RULES["reward-finite"],
    Rule(
        "reward-changes",
        "warn",
        "A dense reward changes while the robot moves.",
        "There is nothing to learn from.",
        "compute_dense_reward",
    ),
    OUTLIER_RULES["reward-normalized"],
    Rule(
        "reward-ratio",
        "warn",
        "The normalized dense reward is the dense reward divided by a constant.",
        "The two modes train different tasks.",
        "compute_normalized_dense_reward",
    ),
    Rule(
        "reward-order",
        "warn",
        "At success the dense reward is not lower than elsewhere in the same episode.",
        "Policies learn to avoid success.",
        "compute_dense_reward",
    ),
    Rule(
        "reward-needs-success",
        "warn",
        "The largest normalized reward is given at success only.",
        "Policies learn to wait where they earn as much as at success.",
        "compute_dense_reward",
    ),
    # --- reproducibility -------------------------------------------------------------------------------------
    Rule(
        "same-seed",
        "stop",
        "The same seed gives the same state after a reset, whatever came before.",
        "Runs, demonstrations and bugs cannot be reproduced.",
    ),
    Rule(
        "same-for-any-batch",
        "warn",
        "What is built for a seed does not depend on the number of envs.",
        "A demonstration that was recorded with one env shows other objects when it is replayed among many.",
        "_load_scene",
    ),
    Rule(
        "state-restores",
        "warn",
        "The state dict restores evaluate(), reward and observation.",
        "Replayed demonstrations, state-based resets and planners see another goal than the recorded one.",
        "get_state_dict",
    ),
    Rule(
        "actions-replay",
        "warn",
        "The same actions from the same seed give the same episode.",
        "Demonstrations cannot be replayed.",
        "step",
    ),
    # --- observations ----------------------------------------------------------------------------------------
    OUTLIER_RULES["observation-finite"],
    Rule(
        "observation-constant",
        "warn",
        "Numbers of an observation differ between episodes or steps.",
        "They carry no information, and normalisers divide by their zero variance.",
        "_get_obs_extra",
    ),
    Rule(
        "observation-huge",
        "warn",
        "Numbers of an observation are below 1000.",
        "They drown all others in a network without normalisation; most often a hidden body or a wrong unit.",
        "_get_obs_extra",
    ),
    Rule(
        "ground-truth",
        "warn",
        "In visual modes _get_obs_extra leaves out the state of objects (if self.obs_mode_struct.use_state).",
        "A policy from pictures is told what it should see, and cannot run on a real robot.",
        "_get_obs_extra",
    ),
    Rule(
        "hidden-goal",
        "warn",
        "A goal that is hidden from pictures is in _get_obs_extra.",
        "The policy cannot know what to do.",
        "_get_obs_extra",
    ),
    # --- cameras ---------------------------------------------------------------------------------------------
    Rule(
        "camera-sees",
        "warn",
        "Each object of the task is seen by a sensor camera, and each fixed sensor camera sees one.",
        "What a policy must act on is not in its pictures.",
        "_default_sensor_configs",
    ),
    Rule(
        "camera-background",
        "warn",
        "A sensor camera looks at a scene: at most half of its pixels are empty background.",
        "Depth is 0 there, and pixels are spent on nothing.",
        "_default_sensor_configs",
    ),
    Rule(
        "camera-pose",
        "warn",
        "A camera's quaternion has length 1.",
        "The picture is turned and zoomed, and extrinsics are scaled: look_at straight down or up does this (tilt the view a little).",
        "_default_sensor_configs",
    ),
    Rule(
        "camera-names",
        "warn",
        "Sensor cameras of the task and of its robot have different names.",
        "The last one of a name replaces the others silently.",
        "_default_sensor_configs",
    ),
    Rule(
        "camera-size",
        "warn",
        "A sensor camera has at most 512 x 512 pixels.",
        "Thousands of envs do not fit the GPU's memory.",
        "_default_sensor_configs",
    ),
    Rule(
        "ray-traced",
        "warn",
        "No camera is ray traced: shader_pack is minimal or default.",
        'render() of several envs raises "ray tracing shaders do not work with parallel rendering".',
        "_default_human_render_camera_configs",
    ),
    # --- solved by planning (--solve) ------------------------------------------------------------------------
    Rule(
        "reward-exploited",
        "warn",
        "An episode without success earns less than a successful one.",
        "A policy learns what pays as much, and never solves the task.",
        "compute_dense_reward",
    ),
    Rule(
        "reward-flat",
        "warn",
        "While the task is unsolved, some actions earn more than others.",
        "Nothing leads on: training stays where the reward is flat.",
        "compute_dense_reward",
    ),
    Rule(
        "reward-stuck",
        "warn",
        "While the task is unsolved, some actions earn more than is earned already.",
        "A policy learns to stop there: what leads on costs reward first.",
        "compute_dense_reward",
    ),
    Rule(
        "reward-against",
        "warn",
        "The reward does not fall on the way to success.",
        "A policy has to learn against its reward, and most turn back.",
        "compute_dense_reward",
    ),
    Rule(
        "success-lost",
        "warn",
        "A solved task stays solved while its reward is sought.",
        "Success depends on the step at which it is looked at, and the reward leads away from it.",
        "evaluate",
    ),
    Rule(
        "failing-pays",
        "warn",
        "Failing early does not earn more than going on.",
        "A policy learns to end the episode as soon as it can.",
        "compute_dense_reward",
    ),
    # --- time ------------------------------------------------------------------------------------------------
    Rule(
        "loop-over-envs",
        "warn",
        "Hooks that run at every step do not loop over envs in Python.",
        "At 4096 envs the loop takes longer than the simulation.",
        "evaluate",
    ),
    Rule(
        "device-copies",
        "warn",
        "Hooks that run at every step leave tensors on their device (.cpu(), .item(), float(tensor), if tensor:).",
        "The GPU has to stop for each of them, in every step.",
        "evaluate",
    ),
    Rule(
        "foreign-device",
        "warn",
        "Tensors are made on self.device (with torch.device(self.device), or device=self.device).",
        "A GPU raises 'Expected all tensors to be on the same device'.",
        "_initialize_episode",
    ),
)
CHECK_RULES: Mapping[str, Rule] = {rule.id: rule for rule in _TABLE}
"""Those that `checks` looks at, beyond the rules of GPU simulation."""
SOLVE_RULES = frozenset(
    ("reward-exploited", "reward-flat", "reward-stuck", "reward-against", "success-lost", "failing-pays")
)
"""Those of them that need planned episodes, which take minutes: off unless they are asked for."""
RULES: Mapping[str, Rule] = {**core_rules.RULES, **CHECK_RULES}
"""All, by id."""


def did_you_mean(rule: str) -> str:
    """`` (did you mean reward-rows?)`` for an id that no rule has; empty where none is near."""
    close = difflib.get_close_matches(rule.lower().replace("_", "-"), RULES, n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else ""


def degree_of_each(
    select: Collection[str] = (),
    ignore: Collection[str] = (),
    choice: Degree | None = None,
    solve: bool = False,
) -> dict[str, Degree]:
    """The degree of each rule.

    Args:
        select: only these rules; all others are off. Empty for all.
        ignore: rules that are off.
        choice: the degree of all others; None for each rule's own.
        solve: whether `SOLVE_RULES` are among all; else they are off unless `select` names them.

    Raises:
        ValueError: an id that no rule has.
    """
    for rule in (*select, *ignore):
        if rule not in RULES:
            raise ValueError(
                f"no rule is called {rule!r}{did_you_mean(rule)}; `workbench help rules` lists them"
            )
    chosen = set(select or RULES) - set(ignore)
    if not solve and not select:
        chosen -= SOLVE_RULES
    return {rule.id: (choice or rule.degree) if rule.id in chosen else "off" for rule in RULES.values()}


def core_rules_of(degrees: Mapping[str, Degree]) -> list[str]:
    """The rules of GPU simulation that are not off."""
    return [rule for rule in core_rules.RULES if degrees[rule] != "off"]
