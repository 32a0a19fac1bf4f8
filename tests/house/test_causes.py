"""No code of ours can follow causes in a circle, or make one.

`pipeline.errors.causes` alone follows an error's causes. An error is raised `from` another only if it is made for that:
one that existed before may be the other one itself, or hold it among its causes.
"""

from __future__ import annotations

import ast
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.errors import InputError, RunError, UnreadableInputError, causes
from service.client.transport import _certificate_fault
from service.disk import has_no_space

ROOT = Path(__file__).resolve().parents[2]
WALKER = "pipeline/errors.py"
LINKS = {"__cause__", "__context__"}
SOURCES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for folder in ("pipeline", "service")
    for path in sorted((ROOT / folder).rglob("*.py"))
}


def readers_of_links(sources: dict[str, str]) -> Iterator[str]:
    """Where code reads the cause of an error by itself."""
    for name, text in sources.items():
        if name != WALKER and any(link in text for link in LINKS):
            for node in ast.walk(ast.parse(text)):
                by_name = isinstance(node, ast.Attribute) and node.attr in LINKS
                by_text = isinstance(node, ast.Constant) and node.value in LINKS
                if by_name or by_text:
                    yield f"{name}:{node.lineno}"


def raisers_of_old_errors(sources: dict[str, str]) -> Iterator[str]:
    """Where an error is raised from another and is not certain to be a new one."""
    trees = {name: ast.parse(text) for name, text in sources.items()}
    functions: dict[str, list[ast.FunctionDef]] = {}
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                functions.setdefault(node.name, []).append(node)
    for name, tree in trees.items():
        for scope in ast.walk(tree):
            if not isinstance(scope, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            for node in ast.walk(scope):
                if isinstance(node, ast.Raise) and _names_a_cause(node) and not _is_new(node.exc, scope, functions):
                    yield f"{name}:{node.lineno}"


def _names_a_cause(node: ast.Raise) -> bool:
    """Whether a statement is `raise … from …`, other than from None."""
    return node.cause is not None and not (isinstance(node.cause, ast.Constant) and node.cause.value is None)


def _is_new(made: ast.expr | None, scope: ast.AST, functions: dict[str, list[ast.FunctionDef]], depth: int = 3) -> bool:
    """Whether an expression makes an error: calls a class, or a function all of whose results are new, or None."""
    if isinstance(made, ast.Constant):
        return made.value is None
    if isinstance(made, ast.Name):
        values = [n.value for n in ast.walk(scope) if isinstance(n, ast.Assign) and _binds(n, made.id)]
        return depth > 0 and bool(values) and all(_is_new(value, scope, functions, depth - 1) for value in values)
    if not isinstance(made, ast.Call):
        return False
    called = made.func
    if isinstance(called, ast.Call):  # type(error)(…)
        return isinstance(called.func, ast.Name) and called.func.id == "type"
    word = called.attr if isinstance(called, ast.Attribute) else called.id if isinstance(called, ast.Name) else ""
    if word.lstrip("_")[:1].isupper() or word == "cls":
        return True
    found = [function for function in functions.get(word, []) if _gives_an_error(function)]
    results = [n.value for function in found for n in ast.walk(function) if isinstance(n, ast.Return)]
    return depth > 0 and bool(results) and all(_is_new(value, scope, functions, depth - 1) for value in results)


def _binds(node: ast.Assign, name: str) -> bool:
    return any(isinstance(target, ast.Name) and target.id == name for target in node.targets)


def _gives_an_error(function: ast.FunctionDef) -> bool:
    return function.returns is not None and "Error" in ast.unparse(function.returns)


def test_only_one_function_follows_the_causes_of_an_error() -> None:
    assert list(readers_of_links(SOURCES)) == []


def test_an_error_that_is_raised_from_another_is_a_new_one() -> None:
    assert list(raisers_of_old_errors(SOURCES)) == []


@pytest.mark.parametrize(
    "walker",
    [
        "while at is not None:\n    at = at.__cause__ or at.__context__",
        "def f(error):\n    return f(error.__cause__)",
        "at = getattr(error, '__context__')",
    ],
)
def test_another_walker_is_found(walker: str) -> None:
    assert list(readers_of_links({"pipeline/other.py": walker}))


@pytest.mark.parametrize(
    ("statement", "found"),
    [
        ("raise fault from fault", True),
        ("raise fault.cause from fault", True),
        ("raise fault.of(1) from fault", True),
        ("kept = fault\n        raise kept from fault", True),
        ("raise held() from fault", True),
        ("raise made() from fault", False),
        ("again = made()\n        raise again from fault", False),
        ("raise type(fault)(1) from fault", False),
        ("raise errors.InputError(1) from fault", False),
        ("raise fault.of(1) from None", False),
    ],
)
def test_a_circle_that_could_be_made_is_found(statement: str, found: bool) -> None:
    source = (
        "def of(self, name) -> InputError:\n    if name:\n        return self\n    return InputError(name)\n"
        "def held() -> InputError:\n    return HELD\n"
        "def made() -> InputError | None:\n    if x:\n        return None\n    return InputError(1)\n"
        f"def f():\n    try:\n        pass\n    except InputError as fault:\n        {statement}\n"
    )
    assert bool(list(raisers_of_old_errors({"pipeline/other.py": source}))) == found


def circle(*errors: BaseException) -> BaseException:
    """Errors of which each is the cause of the one before it, and the first that of the last."""
    for error, cause in zip(errors, (*errors[1:], errors[0]), strict=True):
        error.__cause__ = cause
    return errors[0]


def test_a_circle_of_causes_is_walked_once() -> None:
    one, two, three = ValueError(1), KeyError(2), OSError(3)
    assert list(causes(circle(one, two, three))) == [one, two, three]
    assert list(causes(circle(one))) == [one]


def test_a_circle_through_what_was_being_handled_is_walked_once() -> None:
    inner, outer = ValueError("inner"), KeyError("outer")
    outer.__cause__ = inner

    def handle() -> None:
        try:
            raise outer
        except KeyError:
            raise inner from None

    with pytest.raises(ValueError, match="inner"):
        handle()
    assert inner.__context__ is outer  # and the cause of that is the first one again
    assert list(causes(inner)) == [inner, outer]


def test_those_who_look_for_a_cause_end_in_a_circle() -> None:
    assert not has_no_space(circle(RunError("a"), ValueError("b")))
    assert has_no_space(circle(RunError("a"), OSError(28, "No space left on device")))
    assert _certificate_fault(circle(RunError("a"), ValueError("b"))) is None


@pytest.mark.parametrize("kind", [InputError, UnreadableInputError])
def test_an_error_by_another_name_is_always_a_new_one(kind: type[InputError]) -> None:
    fault = kind("a.laz", "a.laz is odd", "Mend a.laz")
    same, other = fault.of("a.laz", "a.laz"), fault.of("b.laz", "a.laz")
    assert same is not fault
    assert (str(same), type(same)) == (str(fault), kind)
    assert str(other) == "b.laz: b.laz is odd. Mend b.laz"
    assert str(pickle.loads(pickle.dumps(same))) == str(fault)
