"""The page of checks names tests that exist."""

import re

import pytest

from tests.docs.pages import ROOT

ROWS = re.findall(r"^\|[^|]*\|([^|]+)\|[^|]+\| `([^`]+)` \|$", (ROOT / "docs" / "checks.md").read_text(), re.MULTILINE)


def test_every_check_has_a_row():
    text = (ROOT / "docs" / "checks.md").read_text()
    assert len(ROWS) == text.count("\n| ") - 1  # the head has no test; the rule below it begins without a space


@pytest.mark.parametrize("file", sorted({file for _, file in ROWS}))
def test_the_test_of_a_check_exists(file):
    assert list((ROOT / "tests").rglob(file)), file
