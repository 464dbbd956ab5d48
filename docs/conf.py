"""Builds the site with Sphinx: `make docs` writes it to docs/_build."""

import os
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]

import docstrings  # noqa: E402
import reference  # noqa: E402

from megastep.agents import package  # noqa: E402

# The repository of edit links and of links to files outside docs/, such as
# https://github.com/NAME/megastep. Without one, such files are named and not linked.
REPOSITORY = next(
    (
        re.sub(r"\.git$", "", os.environ[name])
        for name in ("MEGASTEP_REPOSITORY", "READTHEDOCS_GIT_CLONE_URL")
        if os.environ.get(name, "").startswith("https://")
    ),
    "",
)

project = "megastep"
author = copyright = "the megastep authors"
release = version = package.version().split()[-1]

extensions = ["myst_nb", "sphinx.ext.linkcode"]
exclude_patterns = ["_build", "play", "jupyter_execute"]
# Notebooks run in an empty folder, with the package of this repository.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 600  # seconds a cell
nb_merge_streams = True
os.environ.pop("MPLBACKEND", None)  # a notebook's own shows figures
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["misc.highlighting_failure"]
html_theme = "furo"
html_title = "megastep"
html_static_path = []
html_extra_path = [path.name for path in [ROOT / "docs/play"] if path.exists()]  # pages to play
html_theme_options = {"source_repository": f"{REPOSITORY}/", "source_branch": "main"}
html_theme_options |= {"source_directory": "docs/"}
html_theme_options = html_theme_options if REPOSITORY else {}
html_copy_source = False
toc_object_entries = False  # hundreds, which every page's sidebar would be searched for


def linkcode_resolve(domain, info):
    """Returns where the source of a name is, on its line."""
    path, line = docstrings.source_of(info["module"], info["fullname"])
    return f"{REPOSITORY}/blob/main/{path}#L{line}" if REPOSITORY and path else None


def prepare(app, name, source):
    """Puts generated blocks into a page, and the repository before files outside docs/."""
    folder = (ROOT / "docs" / name).parent

    def linked(match):
        path, _, anchor = match[2].partition("#")
        target = (folder / path).resolve()
        if target.is_relative_to(ROOT / "docs") or not path:
            return match[0]
        kind = "tree" if target.is_dir() else "blob"
        url = f"{REPOSITORY}/{kind}/main/{target.relative_to(ROOT)}{anchor and '#' + anchor}"
        return f"[{match[1]}]({url})" if REPOSITORY else match[1]

    text = reference.expand(source[0])
    if name.startswith("notebooks/"):
        text += f"\n{{nb-download}}`{name.rpartition('/')[2]}.ipynb` holds this page as it ran.\n"
    if name == "decisions/README":  # a page for each, which its own links lead to
        text += "\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"
    if name == "gallery":
        text = re.sub(r"!\[([^\]]*)\]\(images/([\w-]+)\.png\)", film, text)
    source[0] = re.sub(r"\[([^\]]*)\]\((?!\w+:|#)([^)\s]+)\)", linked, text)


def film(match):
    """Returns the film in place of a picture, if there is one."""
    if not (ROOT / f"docs/play/{match[2]}.mp4").exists():
        return match[0]
    return (
        f'<video src="{match[2]}.mp4" aria-label="{match[1]}" style="max-width: 100%" '
        "autoplay loop muted playsinline controls></video>"
    )


def setup(app):
    app.connect("source-read", prepare)
