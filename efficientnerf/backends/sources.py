"""Which sources a module of this package depends on: its own, and those of all modules that it imports, directly or by others, and of their packages.

Imports are read from the syntax trees, those within functions too. Names that are computed (`importlib.import_module`) are not found: no kernel has any.
"""

import ast
import functools
import hashlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = "efficientnerf"
_NAME = re.compile(rf"{PACKAGE}(?:\.\w+)*".encode(), re.ASCII)
_IMPORT = re.compile(rb"\bimport\b")
_STATEMENT = re.compile(rb"\n(?=[^\s)])")  # what follows begins at the margin
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")  # of statements


class _Source(NamedTuple):
    digest: bytes
    imported: frozenset[str]


class Sources:
    """The package below a folder, each file as it was when it was first read."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._found: dict[str, _Source] = {}

    def module_of(self, path: Path) -> str | None:
        """The module in a file; None for a file of no module of the package."""
        if path.suffix != ".py" or not path.is_relative_to(self._root / PACKAGE):
            return None
        parts = path.relative_to(self._root).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def has(self, module: str) -> bool:
        """Whether there is a file of the module."""
        return module in self._files

    def modules_below(self, package: str) -> list[str]:
        """The modules of a package and of those in it; none where there is no such package."""
        return [name for name in self._files if name.startswith(f"{package}.")] if package in self._packages else []

    def key(self, modules: Iterable[str]) -> str:
        """16 hexadecimal digits that stand for these modules, and for all sources that they depend on."""
        digest = hashlib.sha256()
        for name in sorted(self._depended_on(modules)):
            digest.update(name.encode() + b"\n" + self._found[name].digest)
        return digest.hexdigest()[:16]

    def changed_since(self, modules: Iterable[str], seconds: float) -> bool:
        """Whether a source that these modules depend on was removed, written, or put in its place after a time."""
        try:
            found = [path.stat() for name in self._depended_on(modules) for path in self._files[name]]
        except OSError:
            return True
        return any(max(status.st_mtime, status.st_ctime) > seconds for status in found)

    def modules_named(self, data: bytes) -> set[str]:
        """The modules whose names, or those of what is in them, stand in a pickle."""
        found = set()
        for match in set(_NAME.findall(data)):
            name = match.decode("ascii")
            while not self.has(name) and "." in name:
                name = name.rpartition(".")[0]
            found.add(name)
        return found

    def _depended_on(self, modules: Iterable[str]) -> set[str]:
        found, left = set(), list(modules)
        while left:
            name = left.pop()
            if name not in found:
                found.add(name)
                if name not in self._found:
                    self._found[name] = self._read(name)
                left += self._found[name].imported
        return found

    @functools.cached_property
    def _files(self) -> dict[str, list[Path]]:
        """Of each module; two of one that a package of the same name hides."""
        found: dict[str, list[Path]] = {}
        for path in sorted((self._root / PACKAGE).rglob("*.py")):
            found.setdefault(self.module_of(path) or "", []).append(path)
        return found

    @functools.cached_property
    def _packages(self) -> set[str]:
        return {name.rpartition(".")[0] for name in self._files}

    def _read(self, module: str) -> _Source:
        digest, imported = hashlib.sha256(), set()
        for path in self._files[module]:
            content = path.read_bytes()
            digest.update(f"{path.relative_to(self._root).as_posix()} {len(content)}\n".encode() + content)
            package = module if path.name == "__init__.py" else module.rpartition(".")[0]
            imported |= {name for name in self._imported(content, package) if name.split(".")[0] == PACKAGE}
        with_packages = {".".join(name.split(".")[: n + 1]) for name in imported | {module} for n in range(name.count(".") + 1)}
        return _Source(digest.digest(), frozenset(with_packages & self._files.keys()))

    def _imported(self, content: bytes, package: str) -> Iterator[str]:
        """Names of modules, and of what is taken from them. A package that is imported by itself stands for all that is in it: attributes lead there."""
        for node in _imports(_tree(content).body):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    yield alias.name
                    yield from self.modules_below(alias.name if alias.asname else alias.name.split(".")[0])
            else:
                above = package.split(".")[: package.count(".") + 2 - node.level] if node.level else []
                origin = ".".join([*above, *([node.module] if node.module else [])])
                for alias in node.names:
                    name = origin if alias.name == "*" else f"{origin}.{alias.name}"
                    yield name
                    yield from self.modules_below(name)


def _tree(content: bytes) -> ast.Module:
    """Of a source up to the statement with its last `import`, which is most often short; of all where that statement goes on."""
    last = max((match.end() for match in _IMPORT.finditer(content)), default=0)
    end = _STATEMENT.search(content, last)
    try:
        return ast.parse(content[: end.start() + 1 if end else None])
    except SyntaxError:
        return ast.parse(content)


def _imports(statements: list[ast.stmt]) -> Iterator[ast.Import | ast.ImportFrom]:
    for node in statements:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        for name in _BLOCKS:
            yield from _imports(getattr(node, name, []))
