"""Makes `rebar`, which the original's pages import, a name of megastep's modules::

import megastep.compat
from rebar import arrdict, dotdict, recording
"""

import importlib.util
import sys
import types

from megastep import arrdict, dotdict, recording

if importlib.util.find_spec("rebar") is None:
    _rebar = types.ModuleType("rebar", __doc__)
    _rebar.__path__ = []
    for _module in arrdict, dotdict, recording:
        _name = _module.__name__.rpartition(".")[2]
        setattr(_rebar, _name, _module)
        sys.modules[f"rebar.{_name}"] = _module
    sys.modules["rebar"] = _rebar
