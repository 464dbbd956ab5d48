#!/usr/bin/env bash
# TensorBoard 2.21.0: a process that opens its eleventh event file in the second of the tenth has them read in
# the wrong order. Names end with a counter that is sorted as text, so 10 comes before 9, and what a
# resumed run discards and writes anew (purge_step) is undone: the old point is read last.
# Seen: counters 8 and 9 give the values of the second writer, 9 and 10 those of the first.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q tensorboard==2.21.0
"$folder/bin/python" -W ignore - <<'END'
import tempfile
from unittest import mock

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer import event_file_writer as files


def last_value(first_counter):
    folder = tempfile.mkdtemp()
    counter = files.AtomicCounter(first_counter)
    with mock.patch.object(files, "_global_uid", counter), mock.patch.object(files, "time") as time:
        time.time.return_value = 1e9  # both files are of one second
        for value in (1.0, 2.0):
            writer = files.EventFileWriter(folder)
            summary = Summary(value=[Summary.Value(tag="return", simple_value=value)])
            writer.add_event(Event(step=int(value), wall_time=value, summary=summary))
            writer.close()
    events = EventAccumulator(folder)
    events.Reload()
    return events.Scalars("return")[-1].value


print("counters 8 and 9:", last_value(8), "counters 9 and 10:", last_value(9))
assert last_value(8) == 2 and last_value(9) == 1
END
