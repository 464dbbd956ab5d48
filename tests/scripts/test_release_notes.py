"""The version is the same in every file that states it; release notes come from CHANGELOG.md."""

import re

import pytest
import release_notes


def test_files_state_one_version():
    versions = {
        name: re.search(pattern, (release_notes.ROOT / name).read_text(), re.M)[1]
        for name, pattern in release_notes.VERSIONS.items()
    }
    assert len({*versions.values()}) == 1, versions


@pytest.fixture
def root(tmp_path):
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1.2.0"\n')
    (tmp_path / "CITATION.cff").write_text("cff-version: 1.1.0\nversion: 1.2.0\n")
    (tmp_path / "CHANGELOG.md").write_text(
        "# Changelog\n\n## Unreleased\n\n## 1.2.0 (2030)\n\n### Fixed\n\n- A.\n\n## 1.1.0\n\n- B.\n"
    )
    return tmp_path


def test_notes_are_the_section_of_the_tag(root):
    assert release_notes.notes("v1.2.0", root) == "### Fixed\n\n- A."


@pytest.mark.parametrize("name", release_notes.VERSIONS)
def test_file_with_another_version_is_named(root, name):
    text = (root / name).read_text()
    (root / name).write_text(text.replace("1.2.0", "1.3.0"))
    with pytest.raises(ValueError, match=f"tag is v1.2.0, but {name} has version 1.3.0"):
        release_notes.notes("v1.2.0", root)
