"""A planned edit of a camera, verified by running the new text."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import PurePath

from workbench.cameras.edit.hook_cameras import PARAMETERS, CameraCall, RunHooks
from workbench.cameras.edit.hook_text import snippet
from workbench.envs.camera_data import CameraKey, CameraSettings, differences, why_no_camera
from workbench.source.definitions import Project
from workbench.source.parsed import RefusedEdit, SourceFile, arguments
from workbench.source.traced_edits import Changes
from workbench.task.write_edits import FileChange, SourceEdit, check_own


class CameraEdit(Changes):
    """Plans an edit of the author's files. Raises RefusedEdit if a file is not Python or the hooks fail."""

    def __init__(self, sources: Mapping[str, str], run: RunHooks) -> None:
        super().__init__(Project(sources))
        for path in sources:
            self.project.file(path)
        self._run, self.hook_cameras = run, run(sources)

    def call(self, key: CameraKey) -> CameraCall:
        """The call that makes a camera. Raises RefusedEdit if the call is not in the author's files."""
        uid = key[1]
        if key not in self.hook_cameras.cameras:
            raise RefusedEdit(
                f"your files make no {key[0]} camera {uid!r}: other code makes it, or the files were edited "
                "since the load"
            )
        run = self.hook_cameras.cameras[key]
        if run.site is not None:
            check_own(run.site.file)
        if run.trace is None:
            if run.site is None:
                raise RefusedEdit(f"no CameraConfig(...) in your files makes the camera {uid!r}")
            if run.site.file not in self.project.texts:
                raise RefusedEdit(
                    f"the camera {uid!r} is made in {run.site.file}, line {run.site.line}, which is not one of your files"
                )
            raise RefusedEdit(
                f"line {run.site.line} of {PurePath(run.site.file).name} made the camera {uid!r}, but there is no "
                "CameraConfig(...) for it: it is made in a function or class of its own"
            )
        file, node = self.find(run.trace.at)
        if not isinstance(node, ast.Call):
            raise RefusedEdit(f"the camera {uid!r} is not made by a call of CameraConfig")
        return CameraCall(file, node, key, arguments(node, PARAMETERS), run, run.trace)

    def verified(self, first: SourceFile, key: CameraKey | None, expected: CameraKey | None) -> SourceEdit:
        """All replacements as one edit. Runs the new text to verify that the camera `key` becomes `expected`,
        and that no other camera changes.

        Args:
            first: the file to name first if several files change.
            key: the camera to change; None if the edit adds a camera.
            expected: key of the resulting camera; None if the edit removes the camera.

        Raises:
            RefusedEdit: no text changes, the camera's mount would change, or another camera would change,
                appear or disappear.
        """
        files = {file.path: file for file, _ in self.replacements}
        if not files:
            raise RefusedEdit(
                "the change is smaller than the precision of the written numbers (0.1 mm, 0.01 degree)"
            )
        made: list[FileChange] = []
        for file in sorted(files.values(), key=lambda file: (file is not first, file.path)):
            check_own(file.path)
            mine = [change for of, change in self.replacements if of is file]
            made.append(FileChange(file.path, file.text, file.replaced(mine)))
        before = self.hook_cameras.cameras
        after = self._run({**self.project.texts, **{change.file: change.new_text for change in made}}).cameras
        for other in before.keys() - {key}:
            old, new = before[other], after.get(other)
            if new is None or new.mount != old.mount or (old.settings is None) != (new.settings is None):
                raise RefusedEdit(f"the change would also change the camera {other[1]}")
            if (
                old.settings is not None
                and new.settings is not None
                and differences(old.settings, new.settings)
            ):
                raise RefusedEdit(f"the change would also change the camera {other[1]}")
        if after.keys() != before.keys() - {key} | ({expected} if expected is not None else set()):
            raise RefusedEdit("the change would add or remove other cameras than requested")
        found = None if expected is None else after[expected]
        if found is not None and key is not None and key in before and found.mount != before[key].mount:
            raise RefusedEdit("the change would put the camera on another mount")
        settings = None if found is None else found.settings
        return SourceEdit(**vars(made[0]), notes=tuple(self.notes), settings=settings, others=tuple(made[1:]))


@contextmanager
def planning(
    sources: Mapping[str, str],
    run: RunHooks,
    uid: str = "",
    settings: CameraSettings | None = None,
    more: Sequence[str] = (),
) -> Iterator[CameraEdit]:
    """Context with a `CameraEdit`. A RefusedEdit that is raised in the context gets a snippet for the author
    to copy: a camera with `settings`."""
    try:
        yield CameraEdit(sources, run)
    except RefusedEdit as refused:
        refused.snippet = "" if settings is None else snippet(uid, settings, more=more)
        raise


def check_camera(settings: CameraSettings) -> None:
    """Raise RefusedEdit if `settings` are not valid for a camera."""
    why = why_no_camera(settings)
    if why is not None:
        raise RefusedEdit(why)
