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
    tables = sorted((HERE / name).glob("results*.md"), key=lambda table: (_age(table), table.stem))
    # Of the sealed sets the last one.
    for table in tables[-1:] if name == "sealed" else tables:
        text = table.read_text().rstrip()
        # Long lists (every case of a benchmark) stay in the folder.
        head = re.split(r"^## (?:By hidden effect|What went wrong)", text, flags=re.M)[0].rstrip()
        if len(head) < len(text):
            head += f"\n\n(Case by case: `{name}/{table.name}`.)"
        lines += [re.sub(r"^(#+) ", r"##\1 ", head, flags=re.M), ""]
    if not tables:
        files = sorted(path.name for path in (HERE / name).glob("*.json"))
        lines += [f"Numbers: {', '.join(f'`{name}/{file}`' for file in files)}.", ""]
    missed = HERE / name / "missed.md"
    lines += [f"#{missed.read_text().rstrip()}", ""] if missed.exists() else []
    newest = [path for path in sorted((HERE / name).glob("*.png")) if _shown(name, path, tables)]
    lines += [f"![{path.stem}]({name}/{path.name})" for path in newest]
    return [*lines, ""] if newest else lines


def _age(table: Path) -> int:
    """Sealed sets in the order of their hashes."""
    seed = table.stem.removeprefix("results-")
    return (HERE / "sealed" / "hashes.md").read_text().find(f"| {seed} |")


def _shown(name: str, figure: Path, tables: list[Path]) -> bool:
    """Of the sealed sets those of the last one."""
    if name != "sealed" or not tables:
        return True
    return figure.name.startswith(tables[-1].stem.removeprefix("results-"))


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
