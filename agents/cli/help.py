"""What `--help` prints."""


def help_text(script: str, text: str, groups: dict[str, list[str]]) -> str:
    """The help of a script: what it does, its groups with their members, its options."""
    width = max(len(group) for group in groups)
    members = "\n".join(
        f"  {group:<{width}}  {', '.join(options)}" for group, options in groups.items()
    )
    return f"""{text}

python {script}.py [-m] [key=value ...]

Groups, chosen with group=member:
{members}

  -m, --multirun  run every combination of comma-separated values, one after the other: -m seed=1,2
  -c, --cfg job   print the composed configuration and stop
  -h, --help      this text"""
