"""Users' Python files as modules, each once in a process, and the message types in them."""

import importlib
import importlib.util
import sys
import zlib
from contextlib import redirect_stdout
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from caneflow.messages import Sample
from caneflow.runtime.errors import DataflowError
from caneflow.runtime.wording import one_line

OURS = "caneflow."  # modules that every process can import by name

_sources: dict[Path, bytes] = {}  # what was in a file when its module was made


def module_of(file: Path) -> ModuleType:
    """The module in `file` (an absolute path): the one that is imported already, under whatever name.

    `import NAME` in a file beside it finds the same module, so a process has one class of each name. A file that was
    edited since is read again. Raises whatever the file raises.
    """
    source = file.read_bytes()
    imported = _imported_from(file)
    if imported is not None and _sources.get(file, source) == source:
        return imported
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    name = f"caneflow_user_{zlib.crc32(bytes(file)):08x}_{file.stem}"  # the same in each process: snapshots hold it
    names = [name, file.stem] if _is_found(file) else [name]
    module = _fresh(name, file)
    before = {each: sys.modules.get(each) for each in names}
    sys.modules.update(dict.fromkeys(names, module))  # before it runs: what it imports may import it
    try:
        module.__spec__.loader.exec_module(module)  # type: ignore[union-attr]  # made with one
    except BaseException:
        for each, old in before.items():
            if old is None:
                del sys.modules[each]
            else:
                sys.modules[each] = old
        raise
    _sources[file] = source
    return module


def run_as_main(file: Path) -> None:
    """Run `file` as `python FILE` does; who imports it by its name finds what runs."""
    module = _fresh("__main__", file)
    loader = module.__spec__.loader  # type: ignore[union-attr]  # made with one
    module.__spec__ = None  # as a script has it
    launcher, sys.modules["__main__"] = sys.modules["__main__"], module
    sys.modules.setdefault(file.stem, module)
    loader.exec_module(module)  # type: ignore[union-attr]
    del launcher  # kept until here: its functions may still be registered for the end


def place_of(kind: type[Sample]) -> str:
    """Where another process finds the message type: "module:Class", or "/path/file.py:Class" for a user's own."""
    file = None if kind.__module__.startswith(OURS) else getattr(sys.modules.get(kind.__module__), "__file__", None)
    return f"{kind.__module__ if file is None else Path(file).resolve()}:{kind.__qualname__}"


def kind_at(place: str) -> type[Sample]:
    """The message type at a place as `place_of` gives it; raises DataflowError when there is none."""
    where, _, name = place.rpartition(":")
    try:
        found: object = _imported(Path(where)) if where.endswith(".py") else importlib.import_module(where)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError) as error:
        raise DataflowError(f"no message type {place}: {one_line(error)}") from error
    if not (isinstance(found, type) and issubclass(found, Sample)):
        raise DataflowError(f"{place} is not a message type; expected a class derived from Sample")
    return found


def messages_in(file: Path) -> list[type[Sample]]:
    """The message types that the Python file at an absolute path defines or imports; raises DataflowError."""
    found = vars(_imported(file)).values()
    kinds = (kind for kind in found if isinstance(kind, type) and issubclass(kind, Sample) and kind.schema)
    return list(dict.fromkeys(kinds))


class _Fresh(SourceFileLoader):
    """Compiles the file each time: what is cached may be older than an edit within the same second."""

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


def _fresh(name: str, file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, file, loader=_Fresh(name, str(file)))
    assert spec is not None
    return importlib.util.module_from_spec(spec)


def _imported(file: Path) -> ModuleType:
    try:
        with redirect_stdout(sys.stderr):  # what a file prints is not an answer of ours
            return _member(file)
    except (Exception, SystemExit) as error:  # a user's file may do anything while it is imported
        raise DataflowError(f"{file} cannot be imported: {type(error).__name__}: {one_line(error)}") from error


def _member(file: Path) -> ModuleType:
    """The module in `file`; of a package, if it lies in one, so that what it imports relatively is found."""
    if _imported_from(file) is not None or not (file.parent / "__init__.py").is_file():
        return module_of(file)
    names, folder = [file.stem], file.parent
    while (folder / "__init__.py").is_file():
        names.insert(0, folder.name)
        folder = folder.parent
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    return importlib.import_module(".".join(names))


def _imported_from(file: Path) -> ModuleType | None:
    for module in list(sys.modules.values()):
        path = getattr(module, "__file__", None)
        if isinstance(path, str) and path.endswith(file.name) and Path(path).resolve() == file:
            return module
    return None


def _is_found(file: Path) -> bool:
    """Whether `import` takes the name of `file` for this file: not for one of another folder, or of a library."""
    if file.stem in sys.modules:
        path = getattr(sys.modules[file.stem], "__file__", None)
        return isinstance(path, str) and Path(path).resolve() == file
    try:
        spec = importlib.util.find_spec(file.stem)
    except (ImportError, ValueError):
        return False
    return spec is not None and spec.origin is not None and Path(spec.origin).resolve() == file
