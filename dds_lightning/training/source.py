"""The signature of a class, read from its source: help and typos need not wait for what it imports, such as torch."""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
from pathlib import Path
from typing import Any, NamedTuple

import docstring_parser

PLAIN = ("typing", "collections.abc", "typing_extensions", "pathlib")
"""Modules of which annotations may use the real objects."""


class Parameter(NamedTuple):
    """One parameter of a class.

    Attributes:
        name: Its name.
        annotation: Its type; `inspect.Parameter.empty` where the source alone does not say it.
        default: Its default; `inspect.Parameter.empty` where it has none or the source alone does not say it.
        text: What the docstring says about it.
    """

    name: str
    annotation: Any
    default: Any
    text: str


def parameters_of(address: str, method: str = "__init__") -> dict[str, Parameter]:
    """Read the parameters of a class, those that `**keywords` pass on to another class included.

    Args:
        address: As "package.file:Class".
        method: The method whose parameters are read.
    """
    module, _, name = address.partition(":")
    node = _file(module).class_named(name)
    return _parameters(_file(module), node, method) if node else {}


def summary_of(address: str) -> str:
    """First line of the docstring of a class."""
    module, _, name = address.partition(":")
    node = _file(module).class_named(name)
    return (ast.get_docstring(node) or "").partition("\n")[0] if node else ""


def classes_in(package: str) -> dict[str, str]:
    """The classes that a package offers: name -> address as "package.file:Class"."""
    file = _file(package)
    offered = file.assigned.get("__all__")
    names = ast.literal_eval(offered) if offered is not None else (*file.imports, *file.classes)
    return {name: address for name in names if name[0].isupper() and (address := file.address_of(name))}


def _parameters(file: _File, node: ast.ClassDef, method: str) -> dict[str, Parameter]:
    texts = _texts(node)
    function = next((one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == method), None)
    if function is None:  # a dataclass, or one that inherits it
        fields = [one for one in node.body if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)]
        return {
            name: Parameter(name, file.value(one.annotation), file.value(one.value), texts.get(name, ""))
            for one in fields
            if (name := one.target.id)  # type: ignore[union-attr]
        }
    texts |= _texts(function)
    arguments = function.args
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults = [*[None] * (len(positional) - len(arguments.defaults)), *arguments.defaults]
    found = {
        one.arg: Parameter(one.arg, file.value(one.annotation), file.value(default), texts.get(one.arg, ""))
        for one, default in zip([*positional, *arguments.kwonlyargs], [*defaults, *arguments.kw_defaults], strict=True)
        if one.arg != "self"
    }
    for call in ast.walk(function) if arguments.kwarg else ():
        passed = isinstance(call, ast.Call) and any(
            one.arg is None and ast.unparse(one.value) == arguments.kwarg.arg  # type: ignore[union-attr]
            for one in call.keywords
        )
        if passed and isinstance(call.func, ast.Name) and (address := file.address_of(call.func.id)):  # type: ignore[attr-defined]
            found |= parameters_of(address)
    return found


def _texts(node: ast.ClassDef | ast.FunctionDef) -> dict[str, str]:
    described = docstring_parser.parse(ast.get_docstring(node) or "").params
    return {one.arg_name: one.description or "" for one in described}


class _File:
    """The top level of one source file."""

    def __init__(self, module: str) -> None:
        self.imports: dict[str, tuple[str, str]] = {}
        self.assigned: dict[str, ast.expr] = {}
        self.classes: dict[str, ast.ClassDef] = {}
        path = _path(module)
        for node in ast.parse(path.read_text(encoding="utf-8")).body if path else ():
            if isinstance(node, ast.ImportFrom) and node.module:
                self.imports |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                self.assigned[node.targets[0].id] = node.value
            elif isinstance(node, ast.ClassDef):
                self.classes[node.name] = node
        self.module = module

    def class_named(self, name: str) -> ast.ClassDef | None:
        return self.classes.get(name)

    def address_of(self, name: str) -> str | None:
        """Where a class that this file uses is defined."""
        if name in self.classes:
            return f"{self.module}:{name}"
        return ":".join(self.imports[name]) if name in self.imports else None

    def value(self, node: ast.expr | None) -> Any:
        """A type or constant; `inspect.Parameter.empty` where this needs more than the source."""
        if node is None or any(isinstance(one, ast.Call | ast.Lambda) for one in ast.walk(node)):
            return inspect.Parameter.empty
        try:
            return eval(compile(ast.Expression(node), self.module, "eval"), {}, _Names(self))  # noqa: S307 - no calls
        except Exception:  # a name that only an import would bring
            return inspect.Parameter.empty


class _Names(dict[str, Any]):
    """The names of a file, looked up when an annotation uses them."""

    def __init__(self, file: _File) -> None:
        super().__init__()
        self.file = file

    def __missing__(self, name: str) -> Any:
        if name in self.file.assigned:
            found = self.file.value(self.file.assigned[name])
        elif name in self.file.imports:
            module, original = self.file.imports[name]
            if module in PLAIN:
                return getattr(importlib.import_module(module), original)
            return _Names(_file(module))[original]
        else:
            raise KeyError(name)  # a builtin, perhaps
        if found is inspect.Parameter.empty:
            raise NameError(name)
        return found


@functools.cache
def _file(module: str) -> _File:
    return _File(module)


def _path(module: str) -> Path | None:
    """File of a module, without importing the packages that it lies in."""
    top, *inner = module.split(".")
    spec = importlib.util.find_spec(top)
    if spec is None:
        return None
    roots = spec.submodule_search_locations
    for root in map(Path, roots or ()):
        for path in (root.joinpath(*inner).with_suffix(".py"), root.joinpath(*inner, "__init__.py")):
            if path.is_file():
                return path
    return Path(spec.origin) if not inner and spec.origin and not roots else None
