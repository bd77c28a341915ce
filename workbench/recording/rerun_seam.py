"""What rerun 0.41 must be asked for by names that are not quite public, because it leaks or hangs otherwise.

A `RecordingStream` has two threads. Rerun ends them when the last reference to the stream is gone, but
only when told to look. Its ``save(default_blueprint=...)`` makes a second stream for the blueprint,
which refers to itself through its own memory sink and so is never let go of: two threads and 0.4 MB an
episode for as long as the process lives (measured). And the thread that ``save`` writes with ends at
the first write that fails, after which a flush waits for its answer for ever: a full disk would not
fail, it would hang (seen, with the file size limited).

So rerun never gets to write a file. It encodes recording and blueprint in memory, both streams are kept
in hand until then and cut off from their sinks afterwards, and the bytes are the caller's.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import TypeVar

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings

T = TypeVar("T")


def encode_recording(
    application_id: str, blueprint: rrb.Blueprint, fill: Callable[[rr.RecordingStream], T]
) -> tuple[bytes, T]:
    """The ``.rrd`` bytes of a new recording that `fill` fills, with its default blueprint, and what `fill` gave."""
    # Rerun derives a default id from the process, so two episodes of one process would be taken for one.
    recording = rr.RecordingStream(application_id, recording_id=uuid.uuid4().hex)
    layout = rr.RecordingStream._from_native(
        rerun_bindings.new_blueprint(
            application_id=application_id, make_default=False, make_thread_default=False, default_enabled=True
        )
    )
    content, arrangement = (stream.memory_recording().storage for stream in (recording, layout))
    try:
        layout.set_time("blueprint", sequence=0)
        blueprint._log_to_stream(layout)
        # The blueprint's messages alone are not enough: this adds the one that says to use them.
        rerun_bindings.send_blueprint(arrangement, False, True, recording.to_native())
        result = fill(recording)
        return content.drain_as_bytes(), result
    finally:
        for stream, sink in ((recording, content), (layout, arrangement)):
            sink.drain_as_bytes()  # what is still in a sink when it is cut off gives a warning
            stream.disconnect()


def release_streams() -> None:
    """End the threads of every stream that nothing refers to any more. Streams in use are left alone."""
    rerun_bindings.flush_and_cleanup_orphaned_recordings()
