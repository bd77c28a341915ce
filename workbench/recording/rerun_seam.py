"""What rerun 0.41 must be asked for by names that are not quite public, because it leaks otherwise.

A `RecordingStream` has two threads. Rerun ends them when the last reference to the stream is gone, but
only when told to look (`flush_and_cleanup_orphaned_recordings`). And ``save(default_blueprint=...)``
makes a second stream for the blueprint, which refers to itself through its own memory sink and so is
never let go of: two threads and 0.4 MB an episode, for as long as the process lives (measured). Here
that stream is kept in hand, and cut off from its sink when the blueprint has been written.
"""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings


def save_to(recording: rr.RecordingStream, path: Path, blueprint: rrb.Blueprint) -> None:
    """Send what `recording` is given from now on to `path`, after `blueprint` as the default one.

    Raises:
        RuntimeError: the file cannot be written.
    """
    stream = rr.RecordingStream._from_native(
        rerun_bindings.new_blueprint(
            application_id=rr.get_application_id(recording) or "",
            make_default=False,
            make_thread_default=False,
            default_enabled=True,
        )
    )
    try:
        stream.set_time("blueprint", sequence=0)
        blueprint._log_to_stream(stream)
        rerun_bindings.save(
            path=str(path), default_blueprint=stream.memory_recording().storage, recording=recording.to_native()
        )
    finally:
        stream.disconnect()


def release_streams() -> None:
    """End the threads of every stream that nothing refers to any more. Streams in use are left alone."""
    rerun_bindings.flush_and_cleanup_orphaned_recordings()
