"""The page that collects all results: benchmarks/RESULTS.md, from the folders' own tables.

    python benchmarks/collect.py [--check]

`--check` writes nothing and fails where the page is not what the folders say.
"""

import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE / "RESULTS.md"


def questions() -> list[tuple[str, str, str]]:
    """Folder, question and command of every row of README.md's table."""
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+?) \|$", (HERE / "README.md").read_text(), re.M)
    folders = {path.parent.name for path in HERE.glob("*/run.py")} | {"sealed"}
    listed = {name for name, _, _ in rows}
    if folders != listed:
        raise ValueError(f"README.md and the folders differ: {sorted(folders ^ listed)}")
    return rows


def section(name: str, question: str, command: str) -> list[str]:
    """A folder's tables, one level down, and its figures."""
    lines = [f"## {name}", "", question, "", f"Command: {command}", ""]
    folder = _newest_seed() if name == "sealed" else HERE / name
    tables = sorted(folder.glob("results*.md"), key=lambda table: table.stem)
    for table in tables:
        text = table.read_text().rstrip()
        # Long lists (every case of a benchmark) stay in the folder.
        head = re.split(r"^## (?:By hidden effect|What went wrong)", text, flags=re.M)[0].rstrip()
        if len(head) < len(text):
            head += f"\n\n(Case by case: `{table.relative_to(HERE)}`.)"
        lines += [re.sub(r"^(#+) ", r"##\1 ", head, flags=re.M), ""]
    if not tables:
        files = sorted(path.name for path in (HERE / name).glob("*.json"))
        lines += [f"Numbers: {', '.join(f'`{name}/{file}`' for file in files)}.", ""]
    missed = HERE / name / "missed.md"
    lines += [f"#{missed.read_text().rstrip()}", ""] if missed.exists() else []
    figures = sorted(folder.glob("*.png"))
    lines += [f"![{path.stem}]({path.relative_to(HERE)})" for path in figures]
    return [*lines, ""] if figures else lines


def _newest_seed() -> Path:
    """The sealed set whose hash was published last, among those that are opened."""
    published = (HERE / "sealed" / "hashes.md").read_text()
    opened = (table.parent for table in (HERE / "sealed" / "seeds").glob("*/results.md"))
    return max(opened, key=lambda folder: published.find(f"| {folder.name} |"))


def page() -> str:
    """The whole page."""
    lines = [
        "# Results of all benchmarks",
        "",
        "Collected by `python benchmarks/collect.py` from what each benchmark wrote. Two cores",
        "where nothing else is said.",
        "",
    ]
    for row in questions():
        lines += section(*row)
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    if sys.argv[1:] == ["--check"]:
        if PAGE.read_text() != page():
            sys.exit(f"{PAGE} is not what the folders say: run python benchmarks/collect.py")
        return
    PAGE.write_text(page())
    print(f"written {PAGE}")


if __name__ == "__main__":
    main()
