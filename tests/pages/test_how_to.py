"""Every how-to page runs as printed: its blocks of Python and shell, in order, in one process and an empty folder."""

import sys
from pathlib import Path

import pytest
from pages import HOW_TO, read_page

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("page", HOW_TO)
def test_blocks_of_the_page_run_as_printed(page: str, tmp_path: Path) -> None:
    read_page(page, sys.executable, tmp_path)
