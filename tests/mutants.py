"""Share of seeded mutants of a room that its tests kill: `python -m tests.mutants motion --count 40`.

A mutant is the room with one operator, comparison, constant or `not` changed. Each is tested in a copy of the
repository by the tests of its own room, those of the mutated file first. Survivors are printed as FILE:LINE: CHANGE.
"""

import argparse
import ast
import copy
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HANG = 900  # seconds after which the tests of a mutant count as failed
SWAPS = {
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Mod: ast.Mult},
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.And: ast.Or, ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd},
}


def mutated(node: ast.AST) -> ast.AST | None:
    """The node changed in one place; None if it is of no kind that is changed."""
    new = copy.deepcopy(node)
    if isinstance(new, ast.BinOp | ast.BoolOp | ast.AugAssign) and type(new.op) in SWAPS:
        new.op = SWAPS[type(new.op)]()
    elif isinstance(new, ast.Compare) and type(new.ops[0]) in SWAPS:
        new.ops[0] = SWAPS[type(new.ops[0])]()
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, ast.Not | ast.USub):
        return new.operand
    elif isinstance(new, ast.Constant) and isinstance(new.value, bool):
        new.value = not new.value
    elif isinstance(new, ast.Constant) and isinstance(new.value, int | float):
        new.value += 1
    else:
        return None
    return new


def places(source: str) -> list[ast.AST]:
    """Nodes inside functions that can be mutated; annotations and formatted strings are left out."""
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    nodes = {node: None for function in functions for stmt in function.body for node in ast.walk(stmt)}
    whole = [node for node in nodes if isinstance(node, ast.AnnAssign | ast.JoinedStr)]
    left_out = {n for node in whole for n in ast.walk(getattr(node, "annotation", node))}
    return [node for node in nodes if node not in left_out and mutated(node) is not None]


def apply(source: str, node: ast.AST) -> tuple[str, str]:
    """The mutated source, and the change in words."""
    new = ast.unparse(mutated(node))
    lines = source.encode().splitlines(keepends=True)
    start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    text = source.encode()
    return (
        text[:start] + (new if isinstance(node, ast.AugAssign) else f"({new})").encode() + text[end:]
    ).decode(), f"{ast.unparse(node)} -> {new}"


def passes(folder: str, tests: list[str]) -> bool:
    """Return True if tests pass in a copy of the repository; False if one fails or they hang."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        return subprocess.run(command, cwd=folder, capture_output=True, timeout=HANG).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def main() -> None:
    """Mutate, test and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("room", help="folder of r5dgs_core with tests in tests/core")
    parser.add_argument("--files", default="*.py", help="pattern of the room's files")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    room = Path("r5dgs_core") / options.room
    found = [
        (path.relative_to(ROOT), k)
        for path in sorted((ROOT / room).glob(options.files))
        for k in range(len(places(path.read_text(encoding="utf-8"))))
    ]
    sample = random.Random(options.seed).sample(found, min(options.count, len(found)))
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        for part in ("r5dgs_core", "tests", "benchmarks", "examples", "docs", "pyproject.toml"):
            source = ROOT / part
            (shutil.copytree if source.is_dir() else shutil.copy)(source, Path(folder) / part)
        tests = Path("tests/core") / options.room
        if not passes(folder, [str(tests)]):
            parser.error(f"{tests}: expected tests that pass before anything is changed")
        for path, k in sample:
            original = (ROOT / path).read_text(encoding="utf-8")
            node = places(original)[k]
            text, change = apply(original, node)
            (Path(folder) / path).write_text(text, encoding="utf-8")
            own = [str(p.relative_to(ROOT)) for p in sorted((ROOT / tests).glob(f"test_{path.stem}*.py"))]
            if all(passes(folder, given) for given in (own, [str(tests)]) if given):
                survivors.append(f"{path}:{node.lineno}: {change}")
            (Path(folder) / path).write_text(original, encoding="utf-8")
    print(f"{options.room}: {len(sample) - len(survivors)} of {len(sample)} mutants killed, seed {options.seed}")
    print("\n".join(survivors))


if __name__ == "__main__":
    main()
