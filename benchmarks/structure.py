"""Print how the package is built: sizes, imports between packages, names used twice, prints.

Usage: python benchmarks/structure.py [ROOT]
ROOT is a checkout (default: this one). Imports under ``if TYPE_CHECKING`` are left out of the graph,
because they do not run; imports inside functions count.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path

COUNTED = (tokenize.NAME, tokenize.OP, tokenize.NUMBER)


def num_tokens(text: str) -> int:
    """Return the number of names, operators and numbers of Python source."""
    return sum(t.type in COUNTED for t in tokenize.generate_tokens(io.StringIO(text).readline))


def running_nodes(tree: ast.AST) -> list[ast.AST]:
    """Return all nodes of a module but those under ``if TYPE_CHECKING``."""
    found: list[ast.AST] = []
    open_nodes = [tree]
    while open_nodes:
        node = open_nodes.pop()
        found.append(node)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            open_nodes += node.orelse
        else:
            open_nodes += ast.iter_child_nodes(node)
    return found


def imported_packages(tree: ast.AST, packages: set[str]) -> set[str]:
    """Return the packages below ``dyngs`` that a module imports when it runs."""
    found = set()
    for node in running_nodes(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "dyngs" and len(parts) > 1 and parts[1] in packages:
                found.add(parts[1])
    return found


def reached(graph: dict[str, set[str]], start: str) -> set[str]:
    """Return the packages that ``start`` imports, directly or by way of others."""
    found: set[str] = set()
    open_names = [start]
    while open_names:
        for name in graph[open_names.pop()] - found:
            found.add(name)
            open_names.append(name)
    return found


def circles(graph: dict[str, set[str]]) -> list[frozenset[str]]:
    """Return the groups of packages that import each other, directly or by way of others."""
    reach = {name: reached(graph, name) for name in graph}
    groups = {frozenset(b for b in reach[a] if a in reach[b]) for a in graph if a in reach[a]}
    return sorted(groups, key=len)


def longest_chain(graph: dict[str, set[str]]) -> list[str]:
    """Return the longest chain of packages of which each imports the next; a circle is one link."""
    group_of = {name: name for name in graph}
    for group in circles(graph):
        group_of |= dict.fromkeys(group, "(" + " ".join(sorted(group)) + ")")
    links: defaultdict[str, set[str]] = defaultdict(set)
    for name, imported in graph.items():
        links[group_of[name]] |= {group_of[n] for n in imported} - {group_of[name]}

    @cache
    def chain(start: str) -> tuple[str, ...]:
        return (start, *max((chain(n) for n in sorted(links[start])), key=len, default=()))

    return list(max((chain(name) for name in sorted(set(group_of.values()))), key=len))


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parents[1]
    files = sorted((root / "dyngs").rglob("*.py"))
    trees = {path.relative_to(root / "dyngs"): ast.parse(path.read_text("utf-8")) for path in files}
    packages = {name.parts[0].removesuffix(".py") for name in trees} - {"__init__", "__main__"}
    graph: dict[str, set[str]] = {name: set() for name in packages}
    tokens: Counter[str] = Counter()
    classes: defaultdict[str, list[str]] = defaultdict(list)
    constants = prints = kind_tests = 0
    for name, tree in trees.items():
        package = name.parts[0].removesuffix(".py")
        tokens[package] += num_tokens((root / "dyngs" / name).read_text("utf-8"))
        if package in graph:
            graph[package] |= imported_packages(tree, packages) - {package}
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                classes[node.name].append(name.as_posix())
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                prints += called == "print" and package != "cli"
                is_test = called == "isinstance" and len(node.args) > 1
                kind_tests += is_test and bool(re.search(r"Model\b", ast.unparse(node.args[1])))
        for node in getattr(tree, "body", []):
            targets = node.targets if isinstance(node, ast.Assign) else []
            constants += any(re.fullmatch(r"_?[A-Z][A-Z0-9_]+", ast.unparse(t)) for t in targets)
    for name in sorted(packages):
        print(f"{tokens[name]:8,}  {name}: {', '.join(sorted(graph[name]))}")
    twice = {name: where for name, where in classes.items() if len(where) > 1}
    folders = {path.parent for path in files}
    chain = longest_chain(graph)
    print(
        f"tokens {sum(tokens.values()):,}, files {len(files)}, folders {len(folders)}, packages {len(packages)}"
    )
    print(f"longest chain of imports ({len(chain)}): {' > '.join(chain)}")
    print(f"circles: {[sorted(group) for group in circles(graph)] or 'none'}")
    print(f"class names used twice: {len(twice)} {sorted(twice)}")
    print(
        f"module constants {constants}, isinstance on kinds {kind_tests}, prints outside cli {prints}"
    )


if __name__ == "__main__":
    main()
