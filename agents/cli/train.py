"""The command that trains a policy. `train --help` lists the choices; `run(cfg)` is the same from
Python.
"""

import functools

from megastep.agents.cli import command, scripts
from megastep.agents.launch.train import run as run

#: Runs the script with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.TRAIN)
