"""The page of all results is what the folders of the benchmarks say."""

import runpy
from pathlib import Path

COLLECT = Path(__file__).parents[1] / "benchmarks" / "collect.py"


def test_the_page_of_all_results_is_up_to_date():
    module = runpy.run_path(str(COLLECT))
    text = module["PAGE"].read_text()
    assert text == module["page"](), "run python benchmarks/collect.py"
    # Figures and tables of every benchmark with some of its own.
    for folder in COLLECT.parent.glob("*/results.md"):
        assert f"\n## {folder.parent.name}\n" in text
    for line in text.splitlines():
        if line.startswith("!["):
            assert (COLLECT.parent / line.split("(")[1].rstrip(")")).is_file()
