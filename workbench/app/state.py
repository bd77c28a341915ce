"""The state of a session as one value, and how each event changes it."""

from __future__ import annotations

from dataclasses import dataclass, fields

from workbench.cameras import apply as of_studio
from workbench.cameras.events import StudioEffect, StudioEvent
from workbench.cameras.state import Studio
from workbench.checks import profile as of_profile
from workbench.checks import state as of_checks
from workbench.hands import reset_until as of_search
from workbench.hands import resets as of_resets
from workbench.hands import spawn as of_spawn
from workbench.hands import start_edit as of_start
from workbench.hands import state as of_hands
from workbench.live import apply as of_run
from workbench.live import policies as of_policies
from workbench.live.effects import Then
from workbench.live.events import Now, RunEffect, RunEvent
from workbench.live.run import Run
from workbench.page.command import Command
from workbench.record import state as of_recording
from workbench.record.saving_state import SaveEvent, SaveWanted
from workbench.rescore import state as of_rescoring
from workbench.solve import seeds as of_seeds
from workbench.solve import state as of_solver

SessionEvent = (
    RunEvent
    | of_recording.RecordingWanted
    | of_recording.RecordEvent
    | SaveWanted
    | SaveEvent
    | of_rescoring.RescoringUpdate
    | of_checks.CheckEvent
    | of_profile.ProfileEvent
    | of_seeds.SeedsEvent
    | of_solver.SolverEvent
    | of_policies.PoliciesListed
    | StudioEvent
    | of_hands.HandEvent
    | of_resets.ResetsEvent
    | of_search.SearchEvent
    | of_start.StartEvent
    | of_spawn.SpawnEvent
)
Effect = (
    RunEffect
    | of_recording.RecordEffect
    | of_rescoring.RescoreEffect
    | of_checks.CheckEffect
    | of_checks.KeepCheckAfterSave
    | of_profile.ProfileEffect
    | of_seeds.SeedsEffect
    | of_solver.SolverEffect
    | of_policies.ListPolicies
    | StudioEffect
    | of_resets.ResetsEffect
    | of_search.SearchEffect
    | of_start.StartEffect
    | of_spawn.SpawnEffect
    | Then
)
DOES: frozenset[type[Command]] = (
    of_run.DOES
    | of_recording.DOES
    | of_rescoring.DOES
    | of_checks.DOES
    | of_profile.DOES
    | of_seeds.DOES
    | of_solver.DOES
    | of_studio.DOES
    | of_hands.DOES
    | of_resets.DOES
    | of_search.DOES
    | of_start.DOES
    | of_spawn.DOES
)
"""Commands that `apply` handles."""


@dataclass(frozen=True)
class State:
    """State of a session. For the parts that an event does not change, the next state contains the same
    objects."""

    run: Run
    recording: of_recording.LiveRecording
    studio: Studio
    rescoring: of_rescoring.Rescoring = of_rescoring.Rescoring()
    """The history rescored with the new code."""
    checks: of_checks.Checks = of_checks.Checks()
    """The rules of the running version."""
    profile: of_profile.ProfileView = of_profile.ProfileView()
    """Time profile of a step of the running version."""
    seeds: of_seeds.SeedsView = of_seeds.SeedsView()
    """The job that solves the task from many seeds."""
    solving: of_solver.Solving = of_solver.Solving()
    """Plans for the action source *solve*."""
    policies: of_policies.KnownPolicies = of_policies.KnownPolicies()
    """Policies to choose from, for the action source *policy*."""
    hands: of_hands.Hands = of_hands.Hands()
    """A person who drives the robot."""
    resets: of_resets.ResetCloud = of_resets.ResetCloud()
    """Where resets put the bodies."""
    search: of_search.ResetSearch = of_search.ResetSearch()
    """The search for a first state that meets a condition."""
    start_edit: of_start.StartEdit = of_start.StartEdit()
    """The edit of the file that changes where episodes start."""
    spawn: of_spawn.SpawnBox = of_spawn.SpawnBox()
    """The range in which resets put a body."""


def apply(state: State, event: SessionEvent, now: Now) -> tuple[State, list[Effect]]:
    """The state after an event, and the effects to perform.

    Raises:
        Refused: the command makes no sense now; nothing has changed.
    """
    before, solved = state.run, state.solving.solved
    run, for_run = of_run.apply(before, event, now)
    recording, for_recording = of_recording.apply(state.recording, event, run, now, solved)
    rescoring, for_rescoring = of_rescoring.apply(state.rescoring, event, before, run)
    checks, for_checks = of_checks.apply(state.checks, event, before, run)
    profile, for_profile = of_profile.apply(state.profile, event, run)
    seeds, for_seeds = of_seeds.apply(state.seeds, event, run)
    solving, for_solver = of_solver.apply(state.solving, event, run)
    policies, for_policies = of_policies.apply(state.policies, event, run)
    studio, for_studio = of_studio.apply(state.studio, event, run, now)
    hands, for_hands = of_hands.apply(state.hands, event, run, recording.env_idx, recording.saving.requests)
    resets, for_resets = of_resets.apply(state.resets, event, run)
    search, for_search = of_search.apply(state.search, event, run)
    start, for_start = of_start.apply(state.start_edit, event, run)
    spawn, for_spawn = of_spawn.apply(state.spawn, event, run)
    new = State(
        run,
        recording,
        studio,
        rescoring,
        checks,
        profile,
        seeds,
        solving,
        policies,
        hands,
        resets,
        search,
        start,
        spawn,
    )
    same = all(getattr(new, part.name) is getattr(state, part.name) for part in fields(State))
    # Of two jobs with the same priority, the one that is started later runs first: rescoring is started
    # before the checks, so that the checks run first. Effects of the run come after the jobs: when a load is
    # done, the recording must continue before a recorded run is entered.
    for_jobs = [
        *for_recording,
        *for_rescoring,
        *for_checks,
        *for_profile,
        *for_seeds,
        *for_solver,
        *for_resets,
        *for_search,
        *for_start,
        *for_spawn,
    ]
    return state if same else new, [*for_jobs, *for_run, *for_policies, *for_studio, *for_hands]
