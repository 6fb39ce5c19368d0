"""Code lines and files by package, held to a ceiling that is only ever lowered: `python tests/size.py` (`make size`).

A code line holds a token that is neither a comment nor part of a docstring. The ceilings are in `tests/size.json`; the
exit status is 1 where one is exceeded.
"""

import ast
import io
import json
import sys
import tokenize
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
CEILINGS = ROOT / "tests" / "size.json"
PRODUCT = ("planner", "mrac_jax", "analysis")
LAYOUT = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


class Size(NamedTuple):
    """Python files, code lines, and lines with comments."""

    files: int
    lines: int
    comments: int


def size_of(text: str) -> Size:
    """The size of one source."""
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            docstrings |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    code: set[int] = set()
    comments: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comments.add(token.start[0])
        elif token.type not in LAYOUT:
            code |= set(range(token.start[0], token.end[0] + 1))
    return Size(1, len(code - docstrings), len(comments))


def total(sizes: list[Size]) -> Size:
    """Their sum."""
    return Size(*map(sum, zip(*sizes, strict=True))) if sizes else Size(0, 0, 0)


def main() -> int:
    """Print the table; 1 if a ceiling is exceeded, else 0."""
    sizes = {
        name: total([size_of(path.read_text(encoding="utf-8")) for path in (ROOT / name).rglob("*.py")])
        for name in (*PRODUCT, "tests")
    }
    sizes["product"] = total([sizes[name] for name in PRODUCT])
    table = [f"{'':10}{'files':>7}{'code lines':>12}{'comments a hundred':>20}"]
    for name, size in sizes.items():
        table.append(f"{name:10}{size.files:7}{size.lines:12,}{100 * size.comments / max(size.lines, 1):20.1f}")
    above = [
        f"{name}: {getattr(sizes[name], what):,} {what}, ceiling {ceiling:,}"
        for name, ceilings in json.loads(CEILINGS.read_text(encoding="utf-8")).items()
        for what, ceiling in ceilings.items()
        if getattr(sizes[name], what) > ceiling
    ]
    table += [f"too large: {line}; delete before adding" for line in above]
    sys.stdout.write("\n".join(table) + "\n")
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main())
