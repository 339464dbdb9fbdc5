"""Forbidden in source files: turning data into code, and passing text to a shell."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(
    path
    for folder in ("udrl", "proto", "services", "experiments", "benchmarks", "docs")
    for path in (ROOT / folder).rglob("*.py")
)

#: Modules that read or write objects as code.
MODULES = {"cloudpickle", "code", "copyreg", "dill", "jsonpickle", "marshal", "pickle", "shelve"}
#: Calls by the last part of their name, as attributes of any object.
CALLS = {
    "compile", "create_subprocess_shell", "eval", "exec", "getoutput", "getstatusoutput", "popen",
    "system",
}  # fmt: skip
#: Calls by their full name: these unpickle.
LOADERS = {"torch.load", "torch.jit.load", "np.load", "numpy.load", "joblib.load", "yaml.load"}


def offences(source: str) -> Iterator[str]:
    """Yield the forbidden parts of a source file."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names=names):
                modules = [name.name for name in names]
            case ast.ImportFrom(module=str(module)):
                modules = [module]
            case _:
                modules = []
        yield from (f"imports {m}" for m in modules if m.split(".")[0] in MODULES)
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        if called.split(".")[-1] in CALLS and called not in {"re.compile", "platform.system"}:
            yield f"calls {called}"
        if called in LOADERS:
            yield f"calls {called}"
        for keyword in node.keywords:
            truth = not (isinstance(keyword.value, ast.Constant) and not keyword.value.value)
            if keyword.arg in ("shell", "allow_pickle") and truth:
                yield f"passes {keyword.arg} to {called}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_unpickling_no_eval_no_shell(path: Path) -> None:
    assert list(offences(path.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle", "from pickle import loads", "import marshal as m", "eval(x)",
        "builtins.exec(x)", "os.system(x)", "os.popen(x)", "subprocess.run(x, shell=True)",
        "subprocess.run(x, shell=maybe)", "torch.load(x)", "np.load(x, allow_pickle=True)",
        "subprocess.getoutput(x)", "from cloudpickle.x import y",
    ],
)  # fmt: skip
def test_forbidden_code_is_found(source: str) -> None:
    assert list(offences(source))


@pytest.mark.parametrize(
    "source", ["re.compile(x)", "subprocess.run(x, shell=False)", "np.frombuffer(x)", "evaluate(x)"]
)
def test_allowed_code_is_not_found(source: str) -> None:
    assert not list(offences(source))
