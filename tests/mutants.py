"""Share of seeded mutants of a room that its tests kill: `python -m tests.mutants motion --count 40`.

A mutant is the room with one operator, comparison, constant or `not` changed. The room's tests run once under coverage,
in a copy of the repository. Each mutant is then tested by the tests that execute its lines, fastest first. Survivors
are printed as FILE:LINE: CHANGE. Lines that run only in a compiled kernel or in another process count as not executed.
"""

import argparse
import ast
import copy
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import coverage
import hypothesis  # noqa: F401  the slow imports of the tests, which every fork finds done
import numba  # noqa: F401
import pytest
import scipy.stats  # noqa: F401
import torch  # noqa: F401

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = "r5dgs_core", "r5dgs_addon", "operators"
HANG = 60  # seconds, beside five times the time of all tests, after which the tests of a mutant count as failed
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


def places(source: str) -> list[tuple[ast.AST, range]]:
    """Nodes inside functions that can be mutated, each with the lines from the start of its statement to its end.

    Annotations and formatted strings are left out.
    """
    tree = ast.parse(source)
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    nodes = {node: None for function in functions for stmt in function.body for node in ast.walk(stmt)}
    whole = [node for node in nodes if isinstance(node, ast.AnnAssign | ast.JoinedStr)]
    left_out = {n for node in whole for n in ast.walk(getattr(node, "annotation", node))}
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]  # outer ones first
    starts = {node: statement.lineno for statement in statements for node in ast.walk(statement)}
    return [
        (node, range(starts[node], node.end_lineno + 1))
        for node in nodes
        if node not in left_out and mutated(node) is not None
    ]


def apply(source: str, node: ast.AST) -> tuple[str, str]:
    """The mutated source, and a description of the change."""
    new = ast.unparse(mutated(node))
    lines = source.encode().splitlines(keepends=True)
    start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    end = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    text = source.encode()
    return (
        text[:start] + (new if isinstance(node, ast.AugAssign) else f"({new})").encode() + text[end:]
    ).decode(), f"{ast.unparse(node)} -> {new}"


class Recorder:
    """Pytest plugin that records the lines that each test executes, by its own call or by its fixtures."""

    def __init__(self, room: Path):
        self.coverage = coverage.Coverage(data_file=None, config_file=False, source=[str(room)])
        self.seconds: dict[str, float] = {}
        self.users = defaultdict(set)  # tests that run the code of a context: a test, a fixture, or "" for the rest

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        self.coverage.switch_context(f"fixture {fixturedef.argname}")
        try:
            return (yield)
        finally:
            self.coverage.switch_context("")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        for context in ("", item.nodeid, *(f"fixture {name}" for name in item.fixturenames)):
            self.users[context].add(item.nodeid)
        self.coverage.switch_context(item.nodeid)
        start = time.process_time()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.process_time() - start
            self.coverage.switch_context("")

    def tests_by_line(self) -> dict[str, dict[int, list[str]]]:
        """For every file and line, the tests that execute it, fastest first."""
        data, every = self.coverage.get_data(), self.users[""]

        def tests(contexts: list[str]) -> list[str]:
            return sorted(set().union(*(self.users.get(c, every) for c in contexts)), key=self.seconds.get)

        return {
            file: {line: tests(contexts) for line, contexts in data.contexts_by_lineno(file).items()}
            for file in data.measured_files()
        }


def run_tests(folder: Path, tests: list[str], recorder: Recorder | None) -> None:
    """Run tests in a copy of the repository and end this process with pytest's status."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True  # bytecode is matched by time and size, which two mutants can share
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    if recorder:
        recorder.coverage.start()
    status = pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests], plugins=[recorder] if recorder else [])
    if recorder:
        recorder.coverage.stop()
        (folder / "tests_by_line.json").write_text(json.dumps(recorder.tests_by_line()))
    os._exit(status)


def passes(folder: Path, tests: list[str], seconds: float | None = None, recorder: Recorder | None = None) -> bool:
    """Return True if tests pass in a copy of the repository; False if one fails or they take too long."""
    process = multiprocessing.get_context("fork").Process(target=run_tests, args=(folder, tests, recorder))
    process.start()
    process.join(seconds)
    process.kill()
    process.join()
    return process.exitcode == 0


def main() -> None:
    """Mutate, test and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("room", type=Path, help="folder of r5dgs_core, with its folders")
    parser.add_argument("--files", default="*.py", help="pattern of the room's files")
    parser.add_argument("--tests", type=Path, help="folder or file of tests; default: tests/core/ROOM")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    tests = options.tests or Path("tests/core") / options.room
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        for part in (*PACKAGES, "tests", "benchmarks", "examples", "docs", "pyproject.toml"):
            source = ROOT / part
            (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / part)
        room = folder / "r5dgs_core" / options.room
        sources = {path: path.read_text(encoding="utf-8") for path in sorted(room.rglob(options.files))}
        found = [(path, *place) for path, source in sources.items() for place in places(source)]
        sample = random.Random(options.seed).sample(found, min(options.count, len(found)))
        start = time.monotonic()
        if not passes(folder, [str(tests)], recorder=Recorder(room)):
            parser.error(f"{tests}: expected tests that pass before anything is changed")
        seconds = HANG + 5 * (time.monotonic() - start)
        tests_by_line = json.loads((folder / "tests_by_line.json").read_text())
        killed = 0
        for path, node, lines in sample:
            by_line = tests_by_line.get(str(path), {})
            own = list(dict.fromkeys(test for line in lines for test in by_line.get(str(line), [])))
            text, change = apply(sources[path], node)
            path.write_text(text, encoding="utf-8")
            if own and not passes(folder, own, seconds):
                killed += 1
            else:
                place = f"{path.relative_to(folder)}:{node.lineno}"
                print(f"{place}: {change}" + ("" if own else " (no test executes this line)"), flush=True)
            path.write_text(sources[path], encoding="utf-8")
    print(f"{options.room}: {killed} of {len(sample)} mutants killed, seed {options.seed}")


if __name__ == "__main__":
    main()
