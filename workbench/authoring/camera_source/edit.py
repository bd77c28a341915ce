"""A plan of an edit: the cameras that the author's files make as they stand, the call to change, and the proof."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import PurePath

from workbench.authoring.camera_source.cameras import PARAMETERS, CameraCall, Run
from workbench.authoring.camera_source.disk import FileChange, SourceEdit, check_own
from workbench.authoring.camera_source.hooks import snippet
from workbench.authoring.source.changes import Changes
from workbench.authoring.source.names import Project
from workbench.authoring.source.text import RefusedEdit, SourceFile, arguments
from workbench.core.camera_data import CameraKey, CameraSettings, differences, why_no_camera


class CameraEdit(Changes):
    """Raises RefusedEdit for a file that is not Python, and for hooks that fail."""

    def __init__(self, sources: Mapping[str, str], run: Run) -> None:
        super().__init__(Project(sources))
        for path in sources:
            self.project.file(path)
        self._run, self.ran = run, run(sources)

    def call(self, key: CameraKey) -> CameraCall:
        """What makes a camera. Raises RefusedEdit where that is not to be found in the author's files."""
        uid = key[1]
        if key not in self.ran.cameras:
            raise RefusedEdit(
                f"as the files stand they make no {key[0]} camera {uid!r}: another makes it, or they were edited since"
            )
        run = self.ran.cameras[key]
        if run.site is not None:
            check_own(run.site.file)
        if run.trace is None:
            if run.site is None:
                raise RefusedEdit(f"what makes the camera {uid!r} is no CameraConfig(...) in your files")
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
            raise RefusedEdit(f"what makes the camera {uid!r} is no call")
        return CameraCall(file, node, key, arguments(node, PARAMETERS), run, run.trace)

    def proven(self, first: SourceFile, key: CameraKey | None, expected: CameraKey | None) -> SourceEdit:
        """The edit with all replacements, run: it leaves all cameras as they were but `key`, in whose place there is
        `expected`, of which the edit says what it came out as.

        Args:
            first: what the author thinks of, where several files change.

        Raises:
            RefusedEdit: another camera is changed, or there is another one more or less.
        """
        files = {file.path: file for file, _ in self.replacements}
        if not files:
            raise RefusedEdit("the change is smaller than what is written (0.1 mm, 0.01 degree)")
        made: list[FileChange] = []
        for file in sorted(files.values(), key=lambda file: (file is not first, file.path)):
            check_own(file.path)
            mine = [change for of, change in self.replacements if of is file]
            made.append(FileChange(file.path, file.text, file.replaced(mine)))
        before = self.ran.cameras
        after = self._run({**self.project.texts, **{change.file: change.new_text for change in made}}).cameras
        for other in before.keys() - {key}:
            old, new = before[other], after.get(other)
            if new is None or new.mount != old.mount or (old.settings is None) != (new.settings is None):
                raise RefusedEdit(f"the change would be one of the camera {other[1]} as well")
            if (
                old.settings is not None
                and new.settings is not None
                and differences(old.settings, new.settings)
            ):
                raise RefusedEdit(f"the change would be one of the camera {other[1]} as well")
        if after.keys() != before.keys() - {key} | ({expected} if expected is not None else set()):
            raise RefusedEdit("the file could not be changed without changing what else it does")
        found = None if expected is None else after[expected]
        if found is not None and key is not None and key in before and found.mount != before[key].mount:
            raise RefusedEdit("the change would put the camera on another mount")
        settings = None if found is None else found.settings
        return SourceEdit(**vars(made[0]), notes=tuple(self.notes), settings=settings, others=tuple(made[1:]))


@contextmanager
def planning(
    sources: Mapping[str, str],
    run: Run,
    uid: str = "",
    settings: CameraSettings | None = None,
    more: Sequence[str] = (),
) -> Iterator[CameraEdit]:
    """What is refused within it comes with the camera as text to copy, where there are `settings` for one."""
    try:
        yield CameraEdit(sources, run)
    except RefusedEdit as refused:
        refused.snippet = "" if settings is None else snippet(uid, settings, more=more)
        raise


def check_camera(settings: CameraSettings) -> None:
    """Raises RefusedEdit for what is no camera: it never reaches a file, nor a text to copy."""
    why = why_no_camera(settings)
    if why is not None:
        raise RefusedEdit(why)
