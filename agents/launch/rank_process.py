"""The process of one rank that `launcher` started."""

import os
import sys
import traceback
import warnings
from pathlib import Path

from megastep import workers
from megastep.agents import console
from megastep.agents.errors import shortened
from megastep.agents.factory import check, settings
from megastep.agents.launch import endings, train
from megastep.agents.runs import typed_json


def main() -> int:
    """Trains as one of the ranks that `launcher` started.

    Returns:
        The exit code: 0 if this rank's ending is final, otherwise the ranks may be restarted.
    """
    facts = typed_json.loads(Path(os.environ[endings.JOB], endings.SETTINGS).read_text())
    sys.argv[:], sys.orig_argv[:] = facts["argv"], facts["command"]
    workers.end_with_parent(facts["parent"])
    console.open_streams()
    console.prefix = facts["prefix"]
    warnings.showwarning = console.warn
    folder = None

    def work() -> None:
        nonlocal folder
        folder = train.run(check.check(settings.Train, facts["settings"]))

    try:
        ending, code = endings.ending_of(work)._replace(folder=folder and str(folder)), 0
    except Exception as error:
        traceback.print_exc()
        ending = endings.Ending(1, f"{type(error).__name__}: {shortened(error, 400)}")
        code = 1
    if ending.text or ending.folder:
        endings.report_ending(ending)
    return code
