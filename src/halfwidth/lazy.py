"""Packages whose public names are loaded when first used, so that importing them stays fast."""

import importlib
import sys
import types
from collections.abc import Mapping
from typing import Any


class LazyPackage(types.ModuleType):
    """A package that knows where each public name lives; made by `lazy`."""

    _home: Mapping[str, str]

    def __getattr__(self, name: str) -> Any:
        home = self.__dict__["_home"]
        if name not in home:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        module = importlib.import_module(f"{self.__name__}.{home[name]}")
        value = module if home[name] == name and not hasattr(module, name) else getattr(module, name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # The import system binds every submodule it loads to its package; a public function keeps its name although
        # the module that holds it is called the same.
        if not (name in self.__dict__["_home"] and isinstance(value, types.ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return list(self.__all__)


def lazy(package: str, home: Mapping[str, str]) -> None:
    """Give a package its public names.

    Parameters
    ----------
    package : str
        ``__name__`` of the package.
    home : mapping of str to str
        Public names and the module of each, from the package on; a subpackage is its own home.
    """
    module = sys.modules[package]
    module.__dict__["_home"] = home
    module.__class__ = LazyPackage
