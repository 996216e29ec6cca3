"""Data is never code: no pickle, no eval, no shell, no loading of weights that could hold objects."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(p for folder in ("vipe_core", "services", "benchmarks") for p in (ROOT / folder).rglob("*.py"))

MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "xmlrpc"}
BUILTINS = {"eval", "exec", "compile", "__import__"}
METHODS = {"read_pickle", "to_pickle", "unsafe_load", "full_load", "extractall"}


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """(dotted name, call) of every call by name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def keyword(call: ast.Call, name: str) -> str | None:
    return next((ast.unparse(k.value) for k in call.keywords if k.arg == name), None)


def problems(source: str) -> list[str]:
    tree = ast.parse(source)
    found = []
    for node in ast.walk(tree):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        found += [f"imports {name}" for name in names if name.partition(".")[0] in MODULES]
    for name, call in calls(tree):
        last = name.rpartition(".")[2]
        if name in BUILTINS or last in METHODS:
            found.append(f"calls {name}")
        if name in ("np.load", "numpy.load") and keyword(call, "allow_pickle") != "False":
            found.append("np.load without allow_pickle=False")
        if name == "torch.load" and keyword(call, "weights_only") != "True":
            found.append("torch.load without weights_only=True")
        if name in ("yaml.load", "os.system", "os.popen") or keyword(call, "shell") == "True":
            found.append(f"calls {name}")
    return found


def test_no_file_does() -> None:
    found = {str(path.relative_to(ROOT)): problems(path.read_text()) for path in FILES}
    assert {name: wrong for name, wrong in found.items() if wrong} == {}
    assert len(found) > 100


@pytest.mark.parametrize(
    "source",
    [
        "import pickle", "from cloudpickle import loads", "np.load(p)", "np.load(p, allow_pickle=True)", "eval(x)",
        "torch.load(p)", "torch.load(p, weights_only=False)", "yaml.load(x)", "tar.extractall(p)",
        "run(x, shell=True)", "pd.read_pickle(p)",
    ],
)  # fmt: skip
def test_the_search_finds_what_it_looks_for(source: str) -> None:
    assert problems(source)
