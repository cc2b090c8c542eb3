"""The figures of README and docs: one record per script in docs/records, and what the pages print of it.

    python tools/figures.py                   # rerun all cheap records and show what moved (make figures)
    python tools/figures.py hidden_spring     # rerun some, cheap or not
    python tools/figures.py hidden_spring --write   # rerun, keep the new numbers, and renew the pages

A record is a JSON file. It says how its numbers were measured (`script`, `arguments` of its `main`, or a `command`),
what they are (`values` of `main` by name, and the `tables` that it prints: headers and rows), how far they may move
(`tolerance`, relative, by a part of the name, which for cells is that of column and row; "" is the rest), and
what pages print of them (`printed`). A phrase of `printed` takes values as {name|format} or {name*factor|format}, and
cells of the tables as {row ; column|format}; shares [%] that are better the larger take the format .2down, which rounds
them down; other numbers in it are settings. Rows are known by their numbers, so
pages may name them in other words. `source` is "measured" if the numbers come from a run by this tool, and
"transcribed" if some were copied from a page: --write gives such a record new tables, and "measured" once its phrases
take values. Numbers that nobody measured (settings, limits, versions) are the phrases of `constants.json`.
"""

import argparse
import ast
import contextlib
import importlib
import importlib.util
import inspect
import io
import json
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from orthocas.tools.display import percent

ROOT = Path(__file__).resolve().parent.parent
RECORDS = ROOT / "docs" / "records"
CHEAP = 120.0  # CPU seconds
UNREAD = ("docs/reference/references.md", "docs/changelog.md")  # pages and DOIs of papers; no page of its own

NUMBER = re.compile(r"(?<![\w.^_])[-+]?\d(?:[\d,]*\d)?(?:\.\d+)?(?:e[-+]?\d+)?(?![\w^]|\.\d)")
UNITS = (
    r"%|°|deg|degrees?|rad|us|ms|ns|s|min|h|seconds?|minutes?|hours?|mm|cm|m|kg|N|J|W|Hz|kHz|[KMG]iB|times|boxes|parts"
)
UNIT = re.compile(rf"(?:[ -]?(?:{UNITS}))(?!\w)")
UNPRINTED = re.compile(  # what is no text: front matter, blocks of code, headers of tables, code, formulas, targets
    "|".join(
        [
            r"\A---\n.*?\n---\n",
            r"^( *)```.*?^\1```$",
            r"^ *\|[^\n]*\|\n(?= *\|[ :|-]+\|$)",
            r"`[^`]*`",
            r"\$\$.*?\$\$|\$(?:[^$\n]|\n(?!\n))+\$",
            r"\]\([^)]*\)|!\[[^\]]*\]",
            r"^#+ [^\n]*$|<!--.*?-->",
        ]
    ),
    re.DOTALL | re.MULTILINE,
)
LINE = re.compile(r"^ *\|.*\|$", re.MULTILINE)  # of a table
TARGET = re.compile(r"\]\([^)]*\)")  # of a link, which may move
NUMERIC_CELL = re.compile(r"[\s\d.,e/%→±°x*+-]+")
TAKEN = re.compile(r"\{([^{}|]+?)(?:\*([\d.e+-]+))?\|([^{}]+)\}")


@dataclass(frozen=True)
class Record:
    """The numbers of one script, and what pages print of them."""

    name: str
    source: str  #: "measured", "transcribed" or "constants"
    command: str = ""  #: what measures the numbers, from the repository root
    script: str = ""  #: file whose `main` this tool calls; "" for a command that prints its values as JSON (`--json`)
    results: str = ""  #: folder of the repository where a run of hours leaves what the tables are made of
    arguments: Mapping[str, Any] = field(default_factory=dict)  #: of `main`
    cpu_seconds: float | None = None  #: of the run; None if it was not timed
    tolerance: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    tables: Sequence[Sequence[str]] = ()  #: the header of each, "" if it has none, and its rows
    printed: Sequence[str] = ()

    @property
    def cheap(self) -> bool:
        """Whether `make figures` reruns it."""
        return self.source == "measured" and self.cpu_seconds is not None and self.cpu_seconds <= CHEAP

    @property
    def phrases(self) -> list[str]:
        """What pages print, with the values filled in."""
        return [TAKEN.sub(self._filled, phrase) for phrase in self.printed]

    @property
    def used(self) -> set[str]:
        """The names of the values that are printed."""
        return {name for phrase in self.printed for name, _, _ in TAKEN.findall(phrase)}

    def _filled(self, found: re.Match[str]) -> str:
        name, factor, form = found.groups()
        if form.endswith("down"):
            share = round(self.values[name] * float(factor or 1) / 100, 12)  # without the rounding of the division
            return percent(share, int(form[1:-4]))[:-1]
        return re.sub(r"e([-+])0(\d)", r"e\1\2", f"{self.values[name] * float(factor or 1):{form}}").replace("e+", "e")

    @property
    def rows(self) -> list[tuple[str, str]]:
        """The rows of all tables, each with its header."""
        return [(table[0], row) for table in self.tables for row in table[1:]]

    def allowed(self, name: str) -> float:
        """Relative tolerance of a value: that of the longest part of the name which has one."""
        parts = [part for part in self.tolerance if part in name]
        return self.tolerance[max(parts, key=len)] if parts else 0.0


def records() -> dict[str, Record]:
    """All records by name."""
    return {path.stem: Record(path.stem, **json.loads(path.read_text())) for path in sorted(RECORDS.glob("*.json"))}


def pages() -> dict[str, str]:
    """The text of README and of all pages of the site, by their paths."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = {str(path.relative_to(ROOT)): path.read_text() for path in paths}
    return {name: text for name, text in texts.items() if name not in UNREAD}


def figures(page: str) -> list[tuple[int, int]]:
    """Where the page prints numbers that need a record, as spans of the text.

    These are numbers with a decimal point, an exponent or a unit, and all numbers in cells of tables that hold nothing
    else and are not the label of their row. Code, formulas, targets of links, headings and headers of tables do not
    count.
    """
    text = UNPRINTED.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), page)
    numeric = [span for line in LINE.finditer(text) for span in _numeric_cells(line)]
    return [span for span in (found.span() for found in NUMBER.finditer(text)) if _counts(text, span, numeric)]


def _numeric_cells(line: re.Match[str]) -> Iterator[tuple[int, int]]:
    for cell in list(re.finditer(r"(?<=\|)[^|]*(?=\|)", line[0]))[1:]:
        if NUMERIC_CELL.fullmatch(cell[0]) and cell[0].strip("- "):
            yield line.start() + cell.start(), line.start() + cell.end()


def _counts(text: str, span: tuple[int, int], numeric: Sequence[tuple[int, int]]) -> bool:
    number = text[slice(*span)]
    if re.search(r"\.|e", number) or UNIT.match(text, span[1]):
        return True
    return any(start <= span[0] < end for start, end in numeric)


def places(page: str, phrase: str) -> list[tuple[int, int]]:
    """Where a page has the phrase, whatever its line breaks and targets of links; not within a longer number."""
    if on_one_line(phrase) not in on_one_line(page):  # much faster than the search below
        return []
    words = r"\s+".join(re.escape(word) for word in TARGET.sub("]()", phrase).split()).replace(
        r"\]\(\)", r"\]\([^)]*\)"
    )
    return [found.span() for found in re.finditer(rf"(?<![\d.])(?<!\d,){words}(?![\d]|[.,]\d|e[-+]?\d)", page)]


@cache
def on_one_line(page: str) -> str:
    """A page with single spaces, and without the targets of its links."""
    return " ".join(TARGET.sub("]()", page).split())


def numbers(text: str) -> list[str]:
    """The numbers of a text, in order."""
    return NUMBER.findall(text)


def says_nothing(phrase: str) -> bool:
    """Whether a phrase is numbers and units alone, which would explain any such number."""
    words = re.sub(rf"\b(?:{UNITS})\b", " ", phrase)
    return re.search(r"[^\W\d_]{3}", words) is None


def key(row: str) -> tuple[str, ...]:
    """What tells a row of a table from others: its numbers; with one alone, or none, its text."""
    found = numbers(row)
    return tuple(found) if len(found) > 1 else (row.strip(),)


def unrecorded(page: str, known: Sequence[Record]) -> list[str]:
    """Figures of a page that no record explains, each with its line."""
    covered = [span for record in known for phrase in record.phrases for span in places(page, phrase)]
    rows = {key(row) for record in known for _, row in record.rows}
    covered += [line.span() for line in LINE.finditer(page) if key(line[0]) in rows]
    missing = [span for span in figures(page) if not any(start <= span[0] and span[1] <= end for start, end in covered)]
    return [
        f"line {page.count(chr(10), 0, start) + 1}: {page[max(0, start - 30) : end + 15]!r}" for start, end in missing
    ]


# Measuring


def measured(record: Record) -> Record:
    """The record with the numbers of a new run: what `main` returns, and the tables that it prints."""
    before = _cpu_seconds()
    found, output = called(record) if record.script else (json.loads(ran(record)), "")
    spent = float(f"{_cpu_seconds() - before:.2g}")
    printed = tables(output)
    every = dict(cells(printed)) | (dict(flat(found)) if isinstance(found, Mapping) else {})
    values = {name: every[name] for name in sorted(record.used)}
    copied = record.source == "transcribed" and not all(TAKEN.search(phrase) for phrase in record.printed)
    source = "transcribed" if copied else "measured"  # phrases with copied numbers need values first
    return replace(record, source=source, values=values, tables=printed, cpu_seconds=spent)


def called(record: Record) -> tuple[Any, str]:
    """What `main` of the script returns and prints; files go to a folder that is removed."""
    module, output = imported(record.script), io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(output):
        out = {"out": Path(folder)} if "out" in inspect.signature(module.main).parameters else {}
        return module.main(**out, **record.arguments), output.getvalue()


def ran(record: Record) -> str:
    """What a command with `--json` prints."""
    words = shlex.split(record.command)
    return subprocess.run([sys.executable, *words[1:]], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout


def imported(script: str) -> Any:
    """A script as a module, with the modules beside it."""
    path = ROOT / script
    sys.path.insert(0, str(path.parent))
    return importlib.import_module(path.stem)


def flat(found: Mapping[Any, Any], above: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of nested mappings, with 6 digits, by their joined names."""
    for key, value in found.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{above}{key}, ")
        elif isinstance(value, int | float):
            yield f"{above}{key}", float(f"{value:.6g}")


def cells(found: Sequence[Sequence[str]]) -> Iterator[tuple[str, float]]:
    """Numbers in cells of tables as "row ; column"; of several in a cell, the others as "row ; column ; 2".

    A row is named by its first cell, and by the next ones too where several rows of its table share it.
    """
    for header, *lines in found:
        columns, rows = _cells(header), [_cells(line) for line in lines]
        width = next((w for w in range(1, len(columns)) if len({tuple(row[:w]) for row in rows}) == len(rows)), 1)
        for row in rows:
            for column, cell in zip(columns, row, strict=False):
                for k, number in enumerate(numbers(cell), 1):
                    name = f"{' / '.join(row[:width])} ; {column}"
                    yield name if k == 1 else f"{name} ; {k}", _number(number)


def tables(output: str) -> list[list[str]]:
    """The tables in Markdown of an output: the header of each, or "", and its rows."""
    found: list[list[str]] = [[""]]
    for line in filter(LINE.fullmatch, output.splitlines()):
        if re.fullmatch(r"[| :-]+", line):
            found.append([found[-1].pop()])
        else:
            found[-1].append(line.strip())
    return [table for table in found if len(table) > 1]


def _cpu_seconds() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def moved(old: Record, new: Record) -> list[str]:
    """What differs by more than its tolerance, in words."""
    names = sorted(set(old.values) | set(new.values))
    pairs = [(name, old.values.get(name), new.values.get(name)) for name in names]
    found = [
        f"{name}: {a} -> {b}" for name, a, b in pairs if a is None or b is None or not _close(a, b, old.allowed(name))
    ]
    if len(old.rows) != len(new.rows):
        return [*found, f"{len(old.rows)} -> {len(new.rows)} rows of tables"]
    headers = {row: header for header, row in old.rows}
    pairs = paired(old.rows, new.rows)
    lost = [f"{row}\n      -> no such row" for _, row in old.rows if row not in {a for a, _ in pairs}]
    return found + lost + [f"{a}\n      -> {b}" for a, b in pairs if not _row_close(headers[a], a, b, old)]


def _row_close(header: str, a: str, b: str, record: Record) -> bool:
    """Whether all numbers of a row stay within the tolerance of their cells."""
    names, before, after = (_cells(line) for line in (header, a, b))
    if len(before) != len(after) or any(len(numbers(x)) != len(numbers(y)) for x, y in zip(before, after, strict=True)):
        return False
    for x, y, column in zip(before, after, [*names, *[""] * len(before)], strict=False):
        pairs = zip(numbers(x), numbers(y), strict=True)
        if not all(_close(_number(u), _number(v), record.allowed(f"{column} {before[0]}")) for u, v in pairs):
            return False
    return True


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip()[1:-1].split("|")]


def _number(word: str) -> float:
    return float(word.replace(",", ""))


def _close(a: float, b: float, relative: float) -> bool:
    return bool(np.isclose(a, b, rtol=relative, atol=0, equal_nan=True))


# Writing


def write(record: Record) -> None:
    """Keep a record."""
    plain = {
        name: value for name, value in asdict(record).items() if name != "name" and value not in ("", {}, (), [], None)
    }
    (RECORDS / f"{record.name}.json").write_text(json.dumps(plain, indent=1, ensure_ascii=False) + "\n")


def renew(old: Record, new: Record) -> None:
    """Give all pages the new numbers, where they print the old ones."""
    changes = [(a, b) for a, b in zip(old.phrases, new.phrases, strict=True) if a != b]
    for name, page in pages().items():
        text = page
        for before, after in changes:
            for start, end in reversed(places(text, before)):
                text = text[:start] + renumbered(text[start:end], after) + text[end:]
        rows = {key(a): b for a, b in paired(old.rows, new.rows) if len(numbers(a)) == len(numbers(b)) > 1}
        text = LINE.sub(lambda line, rows=rows: renumbered(line[0], rows.get(key(line[0]), line[0])), text)
        if text != page:
            (ROOT / name).write_text(text)


def paired(old: Sequence[tuple[str, str]], new: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Rows of old and new tables that belong together: by their labels, in order where these are not unique.

    Labels hold numbers, such as the share of a branch, and these move too: then what is left of them is compared.
    """
    matches: dict[int, int] = {}
    for same in (label, lambda row: NUMBER.sub("#", label(row))):
        waiting: dict[str, list[int]] = {}
        for k in sorted(set(range(len(new))) - set(matches.values())):
            waiting.setdefault(same(new[k][1]), []).append(k)
        for k, (_, row) in enumerate(old):
            if k not in matches and waiting.get(same(row)):
                matches[k] = waiting[same(row)].pop(0)
    return [(old[k][1], new[matches[k]][1]) for k in sorted(matches)]


def label(row: str) -> str:
    """The cells before the first one that is a number, or the first cell."""
    cells = _cells(row)
    count = next((i for i, cell in enumerate(cells) if NUMERIC_CELL.fullmatch(cell)), len(cells))
    return " | ".join(cells[: max(1, count)])


def renumbered(text: str, after: str) -> str:
    """The text with the numbers of another one, in order."""
    new = iter(numbers(after))
    return NUMBER.sub(lambda found: next(new, found[0]), text)


def main(names: Sequence[str], keep: bool) -> int:
    """Rerun records, and show what moved; the number of records with moved figures, or that failed."""
    known, count, failed = records(), 0, list[str]()
    chosen = [known[name] for name in names] or [r for r in known.values() if r.cheap]
    missing = {record.name: why for record in chosen if (why := find_missing(record))}
    for name, why in missing.items():
        print(f"{name} is left out: {why}", flush=True)
    for record in [record for record in chosen if record.name not in missing]:
        print(f"{record.name}: {record.command}", flush=True)
        # What fails says why, and does not stop the others.
        try:
            new = measured(record)
        except Exception:
            traceback.print_exc()
            failed.append(record.name)
            continue
        changes = moved(record, new)
        print("".join(f"  moved: {change}\n" for change in changes), end="", flush=True)
        count += bool(changes)
        if keep:
            write(new)
            renew(record, new)
    print(f"{count} records with figures that moved by more than their tolerance")
    if failed:
        print(f"{len(failed)} failed: {', '.join(failed)}")
    return count + len(failed)


def find_missing(record: Record) -> str:
    """What the script of a record needs that is not here, and how to get it; "" if nothing is missing."""
    if not (record.script and (ROOT / record.script).exists()):
        return ""
    folder, text = (ROOT / record.script).parent, (ROOT / record.script).read_text()
    # Programs by their names as words of a command, packages also where they are loaded late, by name.
    for program in dict.fromkeys(re.findall(r'"(cmake|arm-none-eabi-gcc|qemu-system-arm)"', text)):
        if shutil.which(program) is None:
            return f"it needs the program {program}"
    for name in dict.fromkeys(_list_imports(text)):
        if name == "browser" and imported("benchmarks/browser.py").PROGRAM is None:
            return "it needs the browser chromium (apt install chromium)"
        own = (folder / f"{name}.py").exists() or (folder / name).is_dir()
        if not own and importlib.util.find_spec(name) is None:
            return f"it needs the package {name} (pip install -e '.[bench,peers,dask]')"
    return ""


def _list_imports(text: str) -> Iterator[str]:
    """Packages of all import statements of a script, and of `import_module("...")`."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module") and node.args:
            yield from re.findall(r"^'(\w+)", ast.unparse(node.args[0]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="records; default: all that are cheap")
    parser.add_argument("--write", action="store_true", help="keep the new numbers, and give them to the pages")
    options = parser.parse_args()
    sys.exit(min(1, main(options.names, options.write)))
