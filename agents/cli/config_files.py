"""Limits for configuration files, which are checked before YAML makes objects of them: a small file
may stand for more than there is memory, or never end.
"""

import yaml
from hydra.errors import ConfigCompositionException

from megastep.agents.errors import shortened

#: Of one file: bytes, values with those that aliases repeat, and levels of brackets or blanks.
MAX_BYTES, MAX_VALUES, MAX_DEPTH = 2**18, 20_000, 40
#: The loader written in C reads what takes the one written in Python seconds.
LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
TAGS = (None, "!", *(f"tag:yaml.org,2002:{n}" for n in ("str int float bool null seq map".split())))


def check(path: str) -> None:
    """Checks a file of a configuration.

    Raises:
        ConfigCompositionException: it is no regular file, is too large or too deeply nested, or is
            no YAML.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES:,} bytes")
        _check_events(content.decode())
    except OSError as error:
        raise ConfigCompositionException(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, yaml.YAMLError) as error:
        raise ConfigCompositionException(f"{path} is refused: {shortened(error)}") from None


def _check_events(text) -> None:
    """Raises ValueError for a text that exceeds the limits, without recursion."""
    sizes, n_values = {}, 0  # numbers of values by anchor; None while the anchor's node is read
    open_nodes = []  # (anchor, number of values before it)
    for event in yaml.parse(text, LOADER):
        anchor = getattr(event, "anchor", None)
        if isinstance(event, yaml.AliasEvent):
            if sizes.get(anchor, 0) is None:
                raise ValueError(f"{anchor!r} contains itself")
            n_values += sizes.get(anchor, 0)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, n_before = open_nodes.pop()
            sizes[anchor] = n_values - n_before
        elif isinstance(event, yaml.NodeEvent):
            if (tag := getattr(event, "tag", None)) not in TAGS:
                raise ValueError(f"it has the tag {tag!r}")
            if isinstance(event, yaml.ScalarEvent):
                sizes[anchor] = 1
                if event.value.count("${") > MAX_DEPTH:
                    raise ValueError(f"a value has more than {MAX_DEPTH} interpolations")
            else:
                sizes[anchor] = None
                open_nodes.append((anchor, n_values))
            n_values += 1
        if len(open_nodes) > MAX_DEPTH:
            raise ValueError(f"it has more than {MAX_DEPTH} levels")
        if n_values > MAX_VALUES:
            raise ValueError(f"it has more than {MAX_VALUES:,} values")
