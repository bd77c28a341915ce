"""All questions that a worker answers."""

from __future__ import annotations

from typing import get_args

from workbench.cameras.questions import CameraQuestion
from workbench.checks.questions import CheckGroup, ProfileStep
from workbench.hands.questions import ReadStart, SampleReset
from workbench.live.messages import Load, PlaceCamera, Reset, WarmUp
from workbench.live.questions_without_task import DrawTask, ListTasks, MakeScene
from workbench.record.questions import CaptureMoment
from workbench.rescore.verdict import Rescore, RescoreMoments
from workbench.solve.questions import PlanActions

QUESTIONS = (
    Load, Reset, PlaceCamera, WarmUp, *get_args(CameraQuestion), CheckGroup, ProfileStep, PlanActions, RescoreMoments, CaptureMoment,
    ReadStart, Rescore, SampleReset, MakeScene, ListTasks, DrawTask,
)  # fmt: skip
"""All types that a `Call` may contain."""
