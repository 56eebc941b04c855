"""What the modules of the package import and define, read once for all tests that ask."""

from __future__ import annotations

import ast
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path


@dataclass
class Outline:
    """What a module imports and defines, wherever in it.

    Attributes:
        imports: (module, name or None, line) of each import; those by `import_extra("s3fs", ...)`
            too.
        classes: name and number of annotated fields of each class.
        functions: name and names of the parameters of each function, without `self` and `cls`.
    """

    imports: list[tuple[str, str | None, int]] = field(default_factory=list)
    classes: list[tuple[str, int]] = field(default_factory=list)
    functions: list[tuple[str, list[str]]] = field(default_factory=list)


@cache
def outline(path: Path) -> Outline:
    """Return what a file imports and defines."""
    found = Outline()
    for node in ast.walk(ast.parse(path.read_text())):
        match node:
            case ast.Import(names=names):
                found.imports += [(alias.name, None, node.lineno) for alias in names]
            case ast.ImportFrom(module=module, names=names):
                found.imports += [(module or "", alias.name, node.lineno) for alias in names]
            case ast.Call(
                func=ast.Name(id="import_extra" | "import_module"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                found.imports.append((module, None, node.lineno))
            case ast.ClassDef(name=name, body=body):
                fields = sum(isinstance(part, ast.AnnAssign) for part in body)
                found.classes.append((name, fields))
            case ast.FunctionDef(name=name, args=args) | ast.AsyncFunctionDef(name=name, args=args):
                names = [one.arg for one in (*args.posonlyargs, *args.args, *args.kwonlyargs)]
                parameters = [one for one in names if one not in ("self", "cls")]
                found.functions.append((name, parameters))
    return found


def modules_of(path: Path) -> set[str]:
    """Return the full names of the modules that a file imports, and of the names from them."""
    return {
        module if name is None else f"{module}.{name}" for module, name, _ in outline(path).imports
    } | {module for module, *_ in outline(path).imports}
