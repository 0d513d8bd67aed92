"""Functions compiled by Numba whose first start does not wait for Numba: their LLVM code comes with the package.

Three quarters of the time in which Numba compiles are Python: types are inferred, LLVM's intermediate code is written.
That is the same on every machine, so `tools/precompile.py` does it once and keeps the result, not yet optimised, in a
`Bundle`'s file. Here LLVM makes machine code of it for the CPU at hand, in the steps in which Numba does, and puts it
into Numba's own cache on disk, from which Numba loads it as if it had compiled it. A file that does not fit (other
sources, another Numba, Python or type of machine) is not used: then Numba compiles, which takes longer and gives the
same results.
"""

from __future__ import annotations

import functools
import hashlib
import json
import pickle
import platform
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

import llvmlite
import llvmlite.binding
import numba
from numba.core.caching import FunctionCache
from numba.core.sigutils import normalize_signature

FOLDER = Path(__file__).parent
ABOUT, LIBRARIES = "about.json", "libraries"

Library = tuple[bytes, tuple[int, ...]]
"""One function's code before optimisation, as bitcode, and which libraries are linked to it."""


class Bundle:
    """Compiled functions of some source files, and the file that has their code.

    Args:
        name: Of the file, below this folder.
        sources: All files that decide what the functions compute.

    Attributes:
        dispatchers: What `njit` returned, for those who make the file.
    """

    def __init__(self, name: str, sources: Iterable[Path]) -> None:
        self.path = FOLDER / f"{name}.zip"
        self._sources = sorted(sources)
        self.dispatchers: list[Any] = []
        self._modules: dict[int, Any] = {}

    def njit(self, function: Callable[..., Any], **options: Any) -> Any:
        """As `numba.njit(cache=True, **options)`; what the cache lacks is taken from the file, if that fits."""
        dispatcher: Any = numba.njit(**options)(function)
        if not numba.config.DISABLE_JIT:
            dispatcher._cache = _Cache(function, self)
            self.dispatchers.append(dispatcher)
        return dispatcher

    def about(self) -> dict[str, str]:
        """What a file must say of itself to be used: all that the code depends on."""
        digest = hashlib.sha256()
        for path in self._sources:
            digest.update(f"{path.name} ".encode() + path.read_bytes())
        return {
            "numba": numba.__version__,
            "llvmlite": llvmlite.__version__,
            "python": ".".join(platform.python_version_tuple()[:2]),
            "machine": llvmlite.binding.get_process_triple(),
            "sources": digest.hexdigest(),
        }

    @functools.cached_property
    def fits(self) -> bool:
        """Whether the file is there, whole, and made for these sources, libraries and type of machine."""
        try:
            with zipfile.ZipFile(self.path) as file:
                return bool(json.loads(file.read(ABOUT)) == self.about()) and file.testzip() is None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return False

    def compiled(self, function: Callable[..., Any], types: tuple[Any, ...], codegen: Any) -> tuple[Any, ...] | None:
        """What Numba would keep on disk of a function for some types of arguments; None when it is not in the file.

        Args:
            codegen: Numba's, for the CPU at hand.
        """
        if not self.fits:
            return None
        try:
            versions: dict[tuple[Any, ...], tuple[Any, ...]] = pickle.loads(self._read(function.__qualname__))
            number, *rest = versions[types]
        except KeyError:
            return None
        module = self._optimised(number, codegen)
        name = str(module.name)
        return (name, "object", (codegen._tm.emit_object(module), _linkable(module).as_bitcode())), *rest

    def _read(self, member: str) -> bytes:
        with zipfile.ZipFile(self.path) as file:
            return file.read(member)

    @functools.cached_property
    def _libraries(self) -> list[Library]:
        return cast(list[Library], pickle.loads(self._read(LIBRARIES)))

    def _optimised(self, number: int, codegen: Any) -> Any:
        """The optimised module of a library: as of `CPUCodeLibrary.finalize` of Numba."""
        if number not in self._modules:
            bitcode, linked = self._libraries[number]
            module = llvmlite.binding.parse_bitcode(bitcode)
            for other in linked:
                module.link_in(_linkable(self._optimised(other, codegen)), preserve=True)
            library = codegen.create_library(module.name)
            library._final_module = module
            library._optimize_final_module()
            self._modules[number] = module
        return self._modules[number]


class _Cache(FunctionCache):  # type: ignore[misc]
    """Numba's cache on disk of one function, filled from a bundle."""

    def __init__(self, function: Callable[..., Any], bundle: Bundle) -> None:
        super().__init__(function)
        self._bundle = bundle

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function of a signature, or None."""
        found = super().load_overload(sig, target_context)
        if found is None:
            codegen = target_context.codegen()
            compiled = self._bundle.compiled(self._py_func, normalize_signature(sig)[0], codegen)
            if compiled is not None:
                self._impl.locator.ensure_cache_path()
                self._cache_file.save(self._index_key(sig, codegen), compiled)
                found = super().load_overload(sig, target_context)
        return found


def _linkable(module: Any) -> Any:
    """A copy that may be linked to several modules: as of `CPUCodeLibrary._get_module_for_linking` of Numba."""
    copy = module.clone()
    for function in copy.functions:
        if not function.is_declaration and function.linkage == llvmlite.binding.Linkage.external:
            function.linkage = "linkonce_odr"
    return copy
