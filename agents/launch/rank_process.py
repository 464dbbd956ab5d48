"""The process of one rank that `launcher` started."""

import os
import signal
import sys
import threading
import traceback
import warnings
from pathlib import Path

from megastep import workers
from megastep.agents import console
from megastep.agents.distributed import environment
from megastep.agents.errors import shortened
from megastep.agents.launch import endings, launcher, rank, signals
from megastep.agents.runs import typed_json


def main() -> int:
    """Trains as one rank.

    Returns:
        The exit code: 0 if this rank's ending is final, otherwise torchrun may restart the ranks.
    """
    info, job = environment.rank_info(), Path(os.environ[launcher.JOB])
    assert info is not None
    for number in signals.SIGNALS:  # nothing to save yet
        signal.signal(number, lambda number, frame: os._exit(128 + number))
    (job / f"pid-{info.attempt}-{info.rank}").write_text(str(os.getpid()))
    if (job / launcher.STOPPED).exists():
        return 0
    facts = typed_json.loads((job / launcher.SETTINGS).read_text())
    sys.argv[:], sys.orig_argv[:] = facts["argv"], facts["command"]
    workers.end_with_parent(facts["parent"])
    console.open_streams()
    console.prefix = facts["prefix"]
    threading.excepthook = console.warn_of_thread
    warnings.showwarning = console.warn
    from megastep.agents.factory import check, settings
    from megastep.agents.launch import train

    folder = None

    def work() -> None:
        nonlocal folder
        folder = train.run(check.check(settings.Train, facts["settings"]))

    try:
        ending = endings.ending_of(work)._replace(folder=folder and str(folder))
        code = 0
    except Exception as error:
        traceback.print_exc()
        text = f"{type(error).__name__}: {shortened(error, 400)}"
        ending, code = endings.Ending(1, text), 1
    if ending.text or ending.folder:
        rank.report_ending(ending)
    return code
