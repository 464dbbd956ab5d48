#!/usr/bin/env bash
# TensorBoard 2.21.0: `EventAccumulator` keeps 10,000 points of a curve and drops a random rest without a
# word; a notebook that averages a long run's scalars averages a sample of them.
# `size_guidance={"scalars": 0}` keeps all.
# Seen: of 12,000 points 10,000 are read, the first and the last among them.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q tensorboard==2.21.0
"$folder/bin/python" -W ignore - <<'END'
import tempfile

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.event_file_writer import EventFileWriter

folder = tempfile.mkdtemp()
writer = EventFileWriter(folder)
for step in range(12_000):
    value = Summary.Value(tag="return", simple_value=step)
    writer.add_event(Event(step=step, summary=Summary(value=[value])))
writer.close()


def steps(**options):
    events = EventAccumulator(folder, **options)
    events.Reload()
    return [event.step for event in events.Scalars("return")]


default, everything = steps(), steps(size_guidance={"scalars": 0})
print(len(default), "of", len(everything))
assert len(default) == 10_000 and len(everything) == 12_000
assert default[0] == 0 and default[-1] == 11_999
END
